"""The header of a LAS or LAZ file, read with plain fixed-size reads and checked before anything is allocated.

Every length and position a file claims is compared with the size of the file first, so a lying header costs a few
kilobytes, never more. Layouts: LAS 1.4 R15 specification (ASPRS, 2019), sections 2.4 (public header), 2.5 (VLR), 2.6
(point formats), 2.7 (EVLR); laszip VLR and chunk table: LASzip (Isenburg, 2013), as written by LASzip and laz-rs.
"""

from __future__ import annotations

import math
import os
import stat
import struct
from dataclasses import dataclass, field
from typing import BinaryIO

RECORD_LENGTHS = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
"""Smallest record length of point formats 0 to 10, bytes."""

_HEADER_SIZES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375}
_VLR = struct.Struct("<H16sHH32s")
_EVLR = struct.Struct("<H16sHQ32s")
_MAX_RECORDS = 10_000
_MAX_CRS = 1 << 20
_LARGEST = 1e12
_POINT10, _POINT14 = 6, 10  # LASzip's kinds of items
_POINTS_PER_BYTE = 10_000  # identical points compress to about 100 per byte; nothing real comes near this

WKT, GEO_KEYS = 2112, 34735


class Reject(Exception):
    """A file that must not be used; carries a reason code and a sentence that says where and why.

    `box` is where the file says that its points are, lowest and highest x, y, z in its own units; None when its header
    does not say or cannot mean it.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.box: tuple[tuple[float, ...], tuple[float, ...]] | None = None


@dataclass(frozen=True)
class Laszip:
    """What the laszip VLR says: how points are compressed.

    Attributes
    ----------
    record : bytes
        The VLR's data, as the decompressor takes it.
    layered : bool
        True for chunks with one layer per attribute (point formats 6 to 10).
    chunk_size : int or None
        Points per chunk; None when chunks differ (COPC).
    layers : int
        Number of layers per chunk when `layered`.
    table : int
        Position of the chunk table, bytes from the start of the file.
    chunks : int
        Number of chunks the table claims.
    """

    record: bytes
    layered: bool
    chunk_size: int | None
    layers: int
    table: int
    chunks: int


@dataclass(frozen=True)
class Header:
    """A header whose claims agree with the file; coordinates are in the file's own units."""

    size: int
    mtime_ns: int
    version: str
    point_format: int
    record_length: int
    point_count: int
    first_returns: int
    offset_to_points: int
    end_of_points: int
    scales: tuple[float, float, float]
    offsets: tuple[float, float, float]
    mins: tuple[float, float, float]
    maxs: tuple[float, float, float]
    guid: str
    evlr_count: int
    evlrs: tuple[int, int]
    waveforms: int
    copc: bool
    laszip: Laszip | None
    wkt: bytes | None
    geo_keys: bytes | None
    wkt_first: bool
    warnings: tuple[tuple[str, str], ...]


@dataclass
class _Draft:
    """The parts of a header while they are read, each checked before the next is trusted."""

    file: BinaryIO
    size: int
    warnings: list[tuple[str, str]] = field(default_factory=list)
    laszip_record: bytes | None = None
    wkt: bytes | None = None
    geo_keys: bytes | None = None
    copc: bool = False

    def read(self, position: int, length: int, what: str) -> bytes:
        """Read exactly `length` bytes; the caller has bounded the length."""
        if position + length > self.size:
            raise Reject(
                "truncated", f"ends at byte {self.size}, inside {what} (bytes {position} to {position + length})"
            )
        self.file.seek(position)
        data = self.file.read(length)
        if len(data) != length:
            raise Reject("truncated", f"could not be read at byte {position} ({what})")
        return data


def read_header(path: str) -> Header:
    """Read and check a header.

    Parameters
    ----------
    path : str
        A file; its name's extension means nothing, the first four bytes do.

    Returns
    -------
    Header
        Every size and position in it lies inside the file.

    Raises
    ------
    Reject
        With the reason code, and the byte where the trouble is.
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise Reject("not-a-file", "is not a regular file")
        with open(path, "rb", buffering=1 << 14) as file:
            status = os.fstat(file.fileno())
            try:
                return _parse(_Draft(file, status.st_size), status.st_mtime_ns)
            except Reject as reject:
                file.seek(0)
                reject.box = _claimed_box(file.read(_HEADER_SIZES[0]))
                raise
    except PermissionError:
        raise Reject("permission", "may not be read (permission denied)") from None
    except FileNotFoundError:
        raise Reject("missing", "does not exist") from None
    except (OSError, ValueError) as error:
        raise Reject("unreadable", f"cannot be read: {error}") from None


def _parse(draft: _Draft, mtime_ns: int) -> Header:
    raw = _signature(draft)
    major, minor = raw[24], raw[25]
    if major != 1 or minor not in _HEADER_SIZES:
        raise Reject("version", f"is LAS version {major}.{minor}; versions 1.0 to 1.4 can be read")
    if len(raw) < _HEADER_SIZES[minor]:
        raw = draft.read(0, _HEADER_SIZES[minor], f"the header of LAS 1.{minor}")
    header_size, offset, vlr_count, format_byte, record_length, legacy_count = struct.unpack_from("<HIIBHI", raw, 94)
    if not _HEADER_SIZES[minor] <= header_size <= offset <= draft.size:
        raise Reject(
            "header-size",
            f"claims a header of {header_size} bytes and points from byte {offset} on; it is LAS 1.{minor} "
            f"({_HEADER_SIZES[minor]} bytes of header at least) and has {draft.size} bytes",
        )
    compressed, point_format = bool(format_byte & 0x80), format_byte & 0x3F
    _check_format(point_format, record_length, minor, draft)
    _read_vlrs(draft, header_size, offset, vlr_count)
    waveform, evlr_start, evlr_count = 0, 0, 0
    count, first_returns = int(legacy_count), int.from_bytes(raw[111:115], "little")
    if minor >= 3:
        (waveform,) = struct.unpack_from("<Q", raw, 227)
    if minor >= 4:
        evlr_start, evlr_count, count, first_returns = struct.unpack_from("<QIQQ", raw, 235)
        if legacy_count not in (0, count):
            draft.warnings.append(
                ("legacy-count", f"has two point counts, {count} and {legacy_count} (old field); the first one is used")
            )
    evlr_end = _read_evlrs(draft, offset, evlr_start, evlr_count)
    end = min(
        [draft.size]
        + ([evlr_start] if evlr_count else [])
        + ([waveform] if raw[6] & 0b10 and offset <= waveform <= draft.size and waveform else [])
    )
    laszip = None
    if compressed:
        laszip = _laszip(draft, offset, record_length, count)
        end = laszip.table
    else:
        _check_las_size(draft, offset, end, record_length, count)
    numbers = struct.unpack_from("<12d", raw, 131)
    scales, offsets = numbers[0:3], numbers[3:6]
    _check_scales(scales, offsets)
    encoding_wkt = bool(raw[6] & 0b10000)
    if draft.wkt is not None and point_format >= 6 and not encoding_wkt:
        draft.warnings.append(("wkt-bit", "stores its CRS as WKT without setting the WKT bit"))
    return Header(
        size=draft.size,
        mtime_ns=mtime_ns,
        version=f"1.{minor}",
        point_format=point_format,
        record_length=record_length,
        point_count=count,
        first_returns=first_returns if 0 < first_returns <= count else count,
        offset_to_points=offset,
        end_of_points=end,
        scales=scales,
        offsets=offsets,
        mins=(numbers[7], numbers[9], numbers[11]),
        maxs=(numbers[6], numbers[8], numbers[10]),
        guid=raw[8:24].hex(),
        evlr_count=evlr_count,
        evlrs=(evlr_start, evlr_end) if evlr_count else (0, 0),
        waveforms=waveform,
        copc=draft.copc,
        laszip=laszip,
        wkt=draft.wkt,
        geo_keys=draft.geo_keys,
        wkt_first=encoding_wkt or point_format >= 6,
        warnings=tuple(draft.warnings),
    )


def _claimed_box(head: bytes) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Return the bounds of a file that is broken behind its header, as far as 32-bit integers can reach them."""
    if len(head) < _HEADER_SIZES[0] or head[:4] != b"LASF":
        return None
    numbers = struct.unpack_from("<12d", head, 131)
    scales, offsets, high, low = numbers[0:3], numbers[3:6], numbers[6:12:2], numbers[7:12:2]
    for s, o, a, b in zip(scales, offsets, low, high, strict=True):
        if not all(map(math.isfinite, (s, o, a, b))) or not o - s * 2.0**31 <= a <= b <= o + s * 2.0**31:
            return None
    return low, high


def _signature(draft: _Draft) -> bytes:
    head = draft.file.read(375)
    if not head:
        raise Reject("empty", "is empty (0 bytes)")
    if head[:4] != b"LASF":
        looks = {b"PK": "a zip archive", b"\x1f\x8b": "a gzip file", b"<": "a web page or XML"}
        guess = next((f"; it looks like {text}" for magic, text in looks.items() if head.startswith(magic)), "")
        raise Reject("signature", f"is not LAS or LAZ: it does not begin with 'LASF'{guess}")
    if len(head) < 227:
        raise Reject("truncated", f"ends at byte {draft.size}, inside the header (227 bytes at least)")
    return head


def _check_format(point_format: int, record_length: int, minor: int, draft: _Draft) -> None:
    if point_format >= len(RECORD_LENGTHS):
        raise Reject("point-format", f"claims point format {point_format}; formats 0 to 10 exist")
    if record_length < RECORD_LENGTHS[point_format]:
        raise Reject(
            "record-length",
            f"claims {record_length} bytes per point; point format {point_format} needs {RECORD_LENGTHS[point_format]}",
        )
    if (point_format >= 6 and minor < 4) or (point_format in (4, 5) and minor < 3):
        draft.warnings.append(("format-version", f"uses point format {point_format}, too new for LAS 1.{minor}"))


def _read_vlrs(draft: _Draft, start: int, end: int, count: int) -> None:
    if count > _MAX_RECORDS or count * _VLR.size > end - start:
        raise Reject("vlr", f"claims {count} VLRs between bytes {start} and {end}, where they have no room")
    position = start
    for k in range(count):
        if position + _VLR.size > end:
            raise Reject("vlr", f"VLR {k} at byte {position} reaches beyond the start of the points, byte {end}")
        _, user, record_id, length, _ = _VLR.unpack(draft.read(position, _VLR.size, f"VLR {k}"))
        position += _VLR.size
        if position + length > end:
            raise Reject(
                "vlr", f"VLR {k} at byte {position} claims {length} bytes and reaches beyond the points, byte {end}"
            )
        _take_record(draft, user.split(b"\0")[0], record_id, position, length)
        position += length


def _read_evlrs(draft: _Draft, offset: int, start: int, count: int) -> int:
    """Look at all EVLRs; return the first byte after them."""
    if count == 0:
        return start
    if count > _MAX_RECORDS or not offset <= start <= draft.size or count * _EVLR.size > draft.size - start:
        raise Reject("evlr", f"claims {count} EVLRs from byte {start} on; it has {draft.size} bytes")
    position = start
    for k in range(count):
        _, user, record_id, length, _ = _EVLR.unpack(draft.read(position, _EVLR.size, f"EVLR {k}"))
        position += _EVLR.size
        if position + length > draft.size:
            raise Reject(
                "evlr", f"EVLR {k} at byte {position} claims {length} bytes; the file ends at byte {draft.size}"
            )
        _take_record(draft, user.split(b"\0")[0], record_id, position, length)
        position += length
    return position


def _take_record(draft: _Draft, user: bytes, record_id: int, position: int, length: int) -> None:
    if user == b"laszip encoded" and record_id == 22204 and length <= 0xFFFF:
        draft.laszip_record = draft.read(position, length, "the laszip VLR")
    elif user == b"copc" and record_id == 1:
        draft.copc = True
    elif user == b"LASF_Projection" and record_id in (WKT, GEO_KEYS):
        if length > _MAX_CRS:
            draft.warnings.append(("crs-size", f"has a CRS record of {length} bytes, which is not read"))
        elif record_id == WKT and draft.wkt is None:
            draft.wkt = draft.read(position, length, "the CRS record")
        elif record_id == GEO_KEYS and draft.geo_keys is None:
            draft.geo_keys = draft.read(position, length, "the GeoTIFF keys")


def _check_las_size(draft: _Draft, offset: int, end: int, record_length: int, count: int) -> None:
    room = end - offset
    if count * record_length > room:
        raise Reject(
            "count",
            f"claims {count} points of {record_length} bytes but holds {room // record_length} "
            f"(bytes {offset} to {end}); it was cut off or its header is wrong",
        )
    left = room - count * record_length
    if left >= record_length:
        raise Reject(
            "count",
            f"claims {count} points but has room for {room // record_length} (bytes {offset} to {end}); its header is "
            "wrong or something else follows the points",
        )
    if left:
        draft.warnings.append(("trailing", f"has {left} stray bytes after its points"))


def _laszip(draft: _Draft, offset: int, record_length: int, count: int) -> Laszip:
    record = draft.laszip_record
    if record is None or len(record) < 34:
        raise Reject("laszip-vlr", "is compressed but has no (complete) laszip VLR")
    compressor, coder = struct.unpack_from("<HH", record, 0)
    (chunk_size,) = struct.unpack_from("<I", record, 12)
    (items,) = struct.unpack_from("<H", record, 32)
    if compressor not in (2, 3) or coder != 0:
        raise Reject("laszip-vlr", f"uses LAZ compressor {compressor}, coder {coder}; 2 and 3 with coder 0 can be read")
    if len(record) < 34 + 6 * items or chunk_size == 0:
        raise Reject("laszip-vlr", f"has a broken laszip VLR ({items} items, chunks of {chunk_size} points)")
    kinds = [struct.unpack_from("<HHH", record, 34 + 6 * k) for k in range(items)]
    if sum(length for _, length, _ in kinds) != record_length:
        raise Reject("laszip-vlr", f"has a laszip VLR that does not add up to its {record_length} bytes per point")
    # Coordinates and classes are in the first item; a decompressor takes a list without it, and its layers for others.
    if kinds[0][0] != (_POINT14 if compressor == 3 else _POINT10):
        raise Reject("laszip-vlr", f"has a laszip VLR whose items begin with kind {kinds[0][0]}, which is no point")
    layers = sum({_POINT14: 9, 11: 1, 12: 2, 13: 1, 14: length}.get(kind, 0) for kind, length, _ in kinds)
    variable = chunk_size == 0xFFFFFFFF
    table, chunks = _chunk_table(draft, offset, record_length)
    room = table - offset - 8
    if count > chunks * (chunk_size if not variable else room * _POINTS_PER_BYTE) or count > room * _POINTS_PER_BYTE:
        raise Reject("count", f"claims {count} points; its {chunks} chunks in {room} bytes cannot hold them")
    if count == 0 and room >= record_length:
        raise Reject("count", f"claims to have no points but holds {room} bytes of them")
    if not variable and chunks > max(1, -(-count // chunk_size)):
        raise Reject("count", f"claims {count} points but has {chunks} chunks of {chunk_size}: there are more points")
    listed = _read_table(draft, offset, record, table)
    if variable and sum(points for points, _ in listed) != count:
        raise Reject("count", f"claims {count} points; its chunks hold {sum(points for points, _ in listed)}")
    length = sum(length for _, length in listed)
    if length > room:
        raise Reject("chunk-table", f"has a broken chunk table at byte {table}: its chunks are longer than the points")
    if length < room:
        draft.warnings.append(("chunk-table", f"has a chunk table that accounts for {length} of {room} bytes"))
    return Laszip(record, compressor == 3, None if variable else chunk_size, layers, table, chunks)


def _chunk_table(draft: _Draft, offset: int, record_length: int) -> tuple[int, int]:
    (table,) = struct.unpack("<q", draft.read(offset, 8, "the position of the chunk table"))
    if table == -1:
        (table,) = struct.unpack("<q", draft.read(draft.size - 8, 8, "the position of the chunk table"))
    if not offset + 8 <= table <= draft.size - 8:
        raise Reject(
            "chunk-table",
            f"says its chunk table is at byte {table}, outside bytes {offset + 8} to {draft.size}; it was cut off or "
            "never finished",
        )
    version, chunks = struct.unpack("<II", draft.read(table, 8, "the chunk table"))
    # Each chunk but an empty last one begins with one uncompressed point.
    if version != 0 or chunks > (table - offset - 8) // record_length + 1:
        raise Reject("chunk-table", f"has a broken chunk table at byte {table} (version {version}, {chunks} chunks)")
    return table, chunks


def _read_table(draft: _Draft, offset: int, record: bytes, table: int) -> list[tuple[int, int]]:
    """Return points (as far as the table knows them) and bytes of each chunk; the number of chunks is checked."""
    import lazrs

    draft.file.seek(offset)
    try:
        listed: list[tuple[int, int]] = lazrs.read_chunk_table(draft.file, lazrs.LazVlr(record))
    except (KeyboardInterrupt, SystemExit):
        raise
    # A panic of the decoder is not an Exception.
    except BaseException as error:
        raise Reject("chunk-table", f"has a chunk table at byte {table} that cannot be read: {error}") from None
    return listed


def _check_scales(scales: tuple[float, ...], offsets: tuple[float, ...]) -> None:
    for axis, scale, offset in zip("xyz", scales, offsets, strict=True):
        if not (math.isfinite(scale) and scale > 0):
            raise Reject("scale", f"has the {axis} scale {scale}, which must be a positive number")
        if not math.isfinite(offset):
            raise Reject("offset", f"has the {axis} offset {offset}, which must be a finite number")
        if scale * 2**31 + abs(offset) > _LARGEST:
            raise Reject("range", f"has an {axis} scale of {scale} and offset of {offset}: no place on Earth")
