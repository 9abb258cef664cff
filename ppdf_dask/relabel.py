"""New classes into a layered LAZ file: one layer of each chunk is made anew, all else is carried over byte by byte.

In point formats 6 to 8 each attribute is compressed on its own (`ppdf_dask.layers`). The classification layer depends
on nothing but the classes and, for its contexts, the return numbers and the scanner channel; no other layer depends on
it (LASzip 3). So records that are zero but for these give, once compressed, the very layer that the whole records would
give. What is carried over cannot change, and is neither decoded nor encoded.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable, Iterator
from itertools import zip_longest
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from ppdf_dask.errors import TileError
from ppdf_dask.lasheader import Header, Reject, read_header
from ppdf_dask.layers import CLASSES, LayeredChunk, chunks
from ppdf_dask.reader import Labels, at_once
from ppdf_dask.tiles import shown

Bytes = npt.NDArray[np.uint8]
Labelled = Iterable[tuple[Labels, Bytes]]
"""All points of a file, in order, with the classes to write; whole chunks at a time."""

_LAYERED = (6, 7, 8)
_RETURNS, _FLAGS, _CLASS, _POINT14 = 14, 15, 16, 30
"""Bytes of a record of point formats 6 to 10 and its length without colours (LAS 1.4 R15, table 15)."""

CHANNEL = 0b0011_0000
"""Bits of the flags that tell the scanner channel."""

_LAYERS = 9
_EVLR_START = 235
"""Byte of the header that says where the EVLRs begin (LAS 1.4 R15, table 3)."""

_LARGE = 16 << 20
"""Bytes before or behind the points that are copied at once; files with more are copied block by block."""

_UNTIDY = {"chunk-table", "trailing"}
"""What a header is warned of that a copy by bytes would hand on."""


def can_relabel(header: Header, most_points: int) -> bool:
    """Tell whether a file can be written again this way; others are decoded and encoded in full.

    Parameters
    ----------
    header : Header
        Of the source.
    most_points : int
        A chunk with more would need too much memory.
    """
    laszip = header.laszip
    if laszip is None or not laszip.layered or laszip.chunk_size is None or header.version != "1.4":
        return False
    tidy = not _UNTIDY.intersection(code for code, _ in header.warnings)
    apart = header.evlr_count == 0 or header.evlrs[0] > laszip.table
    small = max(header.offset_to_points, header.evlrs[1] - header.evlrs[0]) <= _LARGE
    usual = small and header.point_format in _LAYERED and not header.copc and not header.waveforms
    return usual and tidy and apart and header.point_count > 0 and laszip.chunk_size <= most_points


def whole_chunks(header: Header) -> int:
    """Return the points of as many whole chunks as are decoded at once."""
    assert header.laszip is not None
    assert header.laszip.chunk_size is not None
    return at_once(header) // header.laszip.chunk_size * header.laszip.chunk_size


def relabel(source: str, header: Header, target: Path, labelled: Labelled) -> None:
    """Write a file again with new classes.

    Parameters
    ----------
    source, header : str, Header
        A file for which `can_relabel` holds.
    target : Path
        The new file.
    labelled : iterable
        All points with their classes.

    Raises
    ------
    TileError
        When the source's chunks are not what its header says.
    """
    import lazrs

    laszip = header.laszip
    assert laszip is not None
    with open(source, "rb") as old, target.open("wb") as new:
        new.write(old.read(header.offset_to_points) + bytes(8))
        heads, table = _chunks(old, header, source), []
        for labels, classes in labelled:
            firsts = classes[:: laszip.chunk_size]
            for first, layer in zip(firsts, _class_layers(header, labels, classes), strict=True):
                chunk = next(heads)
                size = new.write(_transplant(_raw(old, chunk), chunk, int(first), layer))
                table.append((chunk.points, size))
        begin = new.tell()
        lazrs.write_chunk_table(new, table, lazrs.LazVlr(laszip.record))
        evlrs = new.tell()
        old.seek(header.evlrs[0])
        new.write(old.read(header.evlrs[1] - header.evlrs[0]))
        new.seek(header.offset_to_points)
        new.write(struct.pack("<q", begin))
        if header.evlr_count:
            new.seek(_EVLR_START)
            new.write(struct.pack("<Q", evlrs))


def differs(source: str, header: Header, target: Path) -> str:
    """Compare a written file with its source, byte by byte but for the classes; both are read again.

    Returns
    -------
    str
        What differs; empty when only classes may.
    """
    import lazrs

    try:
        new_header = read_header(str(target))
    except Reject as reject:
        return reject.message
    with open(source, "rb") as old, target.open("rb") as new:
        heads = (old.read(header.offset_to_points), new.read(new_header.offset_to_points))
        if _without(heads[0], _EVLR_START, 8) != _without(heads[1], _EVLR_START, 8):
            return "its header differs"
        sizes = []
        for ours, theirs in zip_longest(_chunks(new, new_header, str(target)), _chunks(old, header, source)):
            if ours is None or theirs is None:
                return "its number of chunks differs"
            sizes.append(ours.end - ours.position)
            if _all_but_classes(new, ours) != _all_but_classes(old, theirs):
                return f"its chunk at byte {ours.position} differs"
        assert header.laszip is not None
        new.seek(header.offset_to_points)
        try:
            table = lazrs.read_chunk_table(new, lazrs.LazVlr(header.laszip.record))
        except lazrs.LazrsError as error:
            return f"its chunk table cannot be read: {error}"
        if [size for _, size in table] != sizes:
            return "its chunk table differs"
        old.seek(header.evlrs[0])
        new.seek(new_header.evlrs[0])
        lengths = [h.evlrs[1] - h.evlrs[0] for h in (header, new_header)]
        if lengths[0] != lengths[1] or old.read(lengths[0]) != new.read(lengths[1]):
            return "its EVLRs differ"
    return ""


def _chunks(file: BinaryIO, header: Header, name: str) -> Iterator[LayeredChunk]:
    assert header.laszip is not None
    assert header.laszip.chunk_size is not None
    left = header.point_count
    for chunk in chunks(file, header.laszip, header.record_length, header.offset_to_points + 8, shown(name)):
        if chunk.points != min(left, header.laszip.chunk_size):
            raise TileError(
                f"{name} is corrupt at byte {chunk.position}: a chunk of {chunk.points} points; get it anew"
            )
        left -= chunk.points
        yield chunk


def _raw(file: BinaryIO, chunk: LayeredChunk) -> bytes:
    file.seek(chunk.position)
    return file.read(chunk.end - chunk.position)


def _class_layers(header: Header, labels: Labels, classes: Bytes) -> Iterator[bytes]:
    """Compress classes; yield the layer of each chunk."""
    import lazrs

    assert header.laszip is not None
    assert header.laszip.chunk_size is not None
    bare = np.zeros((labels.n, _POINT14), np.uint8)
    bare[:, _RETURNS] = labels.returns
    bare[:, _FLAGS] = labels.flags & CHANNEL
    bare[:, _CLASS] = classes
    for begin in range(0, len(bare), header.laszip.chunk_size):
        file = io.BytesIO()
        compressor = lazrs.LasZipCompressor(file, lazrs.LazVlr.new_for_compression(6, 0, True))
        compressor.compress_many(bare[begin : begin + header.laszip.chunk_size])
        compressor.done()
        sizes = struct.unpack_from(f"<{_LAYERS}I", file.getbuffer(), 8 + _POINT14 + 4)
        start = 8 + _POINT14 + 4 + 4 * _LAYERS + sum(sizes[:CLASSES])
        yield bytes(file.getbuffer()[start : start + sizes[CLASSES]])


def _transplant(raw: bytes, chunk: LayeredChunk, first: int, layer: bytes) -> bytes:
    """Return a chunk with another first class and another layer of classes."""
    begin, end = chunk.classes
    size = chunk.head - 4 * (len(chunk.layers) - CLASSES)
    return b"".join(
        (
            raw[:_CLASS],
            bytes((first,)),
            raw[_CLASS + 1 : size],
            struct.pack("<I", len(layer)),
            raw[size + 4 : begin],
            layer,
            raw[end:],
        )
    )


def _all_but_classes(file: BinaryIO, chunk: LayeredChunk) -> bytes:
    return _transplant(_raw(file, chunk), chunk, 0, b"")


def _without(data: bytes, begin: int, length: int) -> bytes:
    return data[:begin] + data[begin + length :]
