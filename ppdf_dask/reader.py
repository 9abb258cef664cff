"""Streaming decode of one source file: batches of points on the job grid with the mask of those a filter sees.

Memory is bounded by the batch, whatever the file's size or claims. Coordinates go from the file's integers to
millimetres in integer arithmetic, so that files with different scales and offsets agree to the last bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from math import lcm
from typing import Any, BinaryIO, Literal

import numpy as np
import numpy.typing as npt

from ppdf_dask.classes import LEGACY_FORMATS, Bools, Bytes, Dims, eligible, fixed_ground, odd_returns
from ppdf_dask.crs import unit_fraction
from ppdf_dask.errors import TileError
from ppdf_dask.filters.cloud import to_grid
from ppdf_dask.lasheader import Header, Laszip, Reject, read_header
from ppdf_dask.layers import chunks
from ppdf_dask.params import ClassRules
from ppdf_dask.tiles import Tile, shown

Ints = npt.NDArray[np.int64]

BATCH = 1_000_000
"""Points decoded at once by default: about 100 MB at the peak."""

BATCH_BYTES = 100_000_000
"""Bytes of records decoded at once at most: records may be 64 kB long."""

PLACES, HEIGHTS, CLASSES, FLAGS, ALL = 0, 1, 2, 4, 2**32 - 1
"""Layers of formats 6 to 10 to decode, by the bits of LASzip's selective decompression; x, y and returns always are."""

_INT64 = 2**62


@dataclass(frozen=True)
class Labels:
    """What the new classes of consecutive points depend on, and how they are compressed (`ppdf_dask.relabel`).

    Attributes
    ----------
    returns, flags, classification : ndarray of uint8, shape (n,)
        Bytes 14 and 15 of each record, and its class.
    eligible : ndarray of bool, shape (n,)
        Seen by the filter.
    """

    returns: Bytes
    flags: Bytes
    classification: Bytes
    eligible: Bools

    @property
    def n(self) -> int:
        """Number of points."""
        return len(self.returns)


@dataclass(frozen=True)
class Batch:
    """Consecutive points of a file.

    Attributes
    ----------
    start : int
        Index of the first point in the file.
    x, y, z : ndarray of int64, shape (n,)
        Absolute millimetres on the job grid; z is empty where heights were not asked for.
    eligible, fixed : ndarray of bool, shape (n,)
        Seen by the filter; ground from the start (mode ``"refine"``).
    classification : ndarray of uint8, shape (n,)
        Classes as read.
    returns, flags : ndarray of uint8, shape (n,)
        Bytes 14 and 15 of each record.
    no_returns, odd_returns : int
        Points with return numbers 0 of 0, and with impossible ones.
    """

    start: int
    x: Ints
    y: Ints
    z: Ints
    eligible: Bools
    fixed: Bools
    classification: Bytes
    returns: Bytes
    flags: Bytes
    no_returns: int
    odd_returns: int

    @property
    def n(self) -> int:
        """Number of points."""
        return len(self.x)

    @property
    def labels(self) -> Labels:
        """What new classes depend on, without the places."""
        return Labels(self.returns, self.flags, self.classification, self.eligible)


def batches(
    tile: Tile,
    *,
    unit_xy: float,
    unit_z: float,
    rules: ClassRules,
    returns: Literal["last", "all"],
    size: int = BATCH,
) -> Iterator[Batch]:
    """Decode a tile from its first to its last point.

    Parameters
    ----------
    tile : Tile
        As scanned.
    unit_xy, unit_z : float
        Metres per unit of the file (`Survey.unit_xy`, `Survey.unit_z`).
    rules : ClassRules
        What makes a point eligible.
    returns : {"last", "all"}
        `RunParams.returns`.
    size : int
        Points per batch; the last one is smaller. Default: a million.

    Yields
    ------
    Batch
        In file order; the sum of their `n` is `tile.point_count`.

    Raises
    ------
    TileError
        When the file changed since the scan, is cut off, corrupt or holds another number of points than its header
        says; the message names the file and the point.
    """
    header = header_of(tile)
    decoder = Decoder.make(header, (unit_xy, unit_z), rules, returns)
    start = 0
    for raw in tile_records(tile, header, size, PLACES | HEIGHTS | CLASSES | FLAGS):
        batch = decoder.measure(np.frombuffer(raw, decoder.dtype), start)
        yield batch
        start += batch.n


@dataclass(frozen=True)
class Decoder:
    """From packed point records to what decides about them.

    Attributes
    ----------
    header : Header
        Of the file the records come from.
    dtype : numpy.dtype
        The part of a record that is read, as long as the whole record.
    axes : tuple of GridAxis
        x, y, z.
    rules : ClassRules
        What makes a point eligible.
    returns : {"last", "all"}
        `RunParams.returns`.
    """

    header: Header
    dtype: np.dtype[Any]
    axes: tuple[GridAxis, ...]
    rules: ClassRules
    returns: Literal["last", "all"]

    @classmethod
    def make(
        cls, header: Header, units: tuple[float, float], rules: ClassRules, returns: Literal["last", "all"]
    ) -> Decoder:
        """Make the decoder of a file; `units` are metres per horizontal and vertical unit."""
        axes = tuple(
            GridAxis.of(header.scales[k], header.offsets[k], unit) for k, unit in enumerate((units[0], *units))
        )
        return cls(header, _record_dtype(header), axes, rules, returns)

    @classmethod
    def of(
        cls, tile: Tile, unit_xy: float, unit_z: float, rules: ClassRules, returns: Literal["last", "all"]
    ) -> Decoder:
        """Make the decoder of a tile; raises TileError when its header is no longer readable."""
        return cls.make(header_of(tile), (unit_xy, unit_z), rules, returns)

    def measure(self, records: npt.NDArray[Any], start: int, *, heights: bool = True) -> Batch:
        """Measure consecutive records.

        Parameters
        ----------
        records : ndarray, shape (n,)
            Packed records, any structured type of the header's record length.
        start : int
            Index of the first one in the file.
        heights : bool
            Whether z is needed.

        Returns
        -------
        Batch
        """
        points = records.view(self.dtype)
        legacy = self.header.point_format in LEGACY_FORMATS
        dims = Dims.unpack(points["returns"], points["first"], None if legacy else points["second"])
        seen = eligible(dims, self.rules, self.returns, self.header.point_format)
        classes = dims.classification.copy()
        none, odd = odd_returns(dims)
        x, y = self.axes[0].to_mm(points["X"]), self.axes[1].to_mm(points["Y"])
        z = self.axes[2].to_mm(points["Z"] if heights else points["Z"][:0])
        fixed = fixed_ground(classes, seen, self.rules)
        returns, flags = points["returns"].copy(), points["first"].copy()
        return Batch(start, x, y, z, seen, fixed, classes, returns, flags, none, odd)


@dataclass(frozen=True)
class GridAxis:
    """Exact way from a file's integers to millimetres: micrometres are ``(i * step + shift) / parts``, rounded.

    The micrometre comes first because `to_grid` goes that way too: the mask of a run equals that of the same points
    given in metres.

    Attributes
    ----------
    step, shift, parts : int
        Scale and offset in micrometres as fractions over `parts`; `parts` is 0 when they do not fit 64-bit integers.
    scale, offset, unit : float
        For that case: the float path, which `to_grid` rounds to the same integers.
    """

    step: int
    shift: int
    parts: int
    scale: float
    offset: float
    unit: float

    @classmethod
    def of(cls, scale: float, offset: float, unit: float) -> GridAxis:
        """Make the conversion of one axis; scale and offset count as the decimals they are written as.

        Examples
        --------
        >>> axis = GridAxis.of(0.01, 500000.0, 1.0)
        >>> axis.to_mm(np.array([1, -1], np.int32)).tolist()
        [500000010, 499999990]
        """
        exact = unit_fraction(unit) * 1_000_000
        step, shift = Fraction(repr(float(scale))) * exact, Fraction(repr(float(offset))) * exact
        parts = lcm(step.denominator, shift.denominator)
        a, b = int(step * parts), int(shift * parts)
        if 2 * (2**31 * a + abs(b)) + parts >= _INT64:
            return cls(0, 0, 0, scale, offset, unit)
        return cls(a, b, parts, scale, offset, unit)

    def to_mm(self, values: npt.NDArray[np.int32]) -> Ints:
        """Return millimetres, half-way values rounded up, from the file's integers."""
        if self.parts == 0:
            metres = (values.astype(np.float64) * self.scale + self.offset) * float(unit_fraction(self.unit))
            return to_grid(metres)
        whole = values.astype(np.int64)
        if self.step % (1000 * self.parts) == 0 and self.shift % (1000 * self.parts) == 0:
            whole *= self.step // (1000 * self.parts)
            whole += self.shift // (1000 * self.parts)
            return whole
        whole *= 2 * self.step
        whole += 2 * self.shift + self.parts - 1  # a half micrometre goes down: it must not lift a half millimetre
        whole //= 2 * self.parts
        whole += 500
        whole //= 1000
        return whole


def header_of(tile: Tile) -> Header:
    """Read a tile's header again; raises TileError when it is no longer readable, or another one than at the scan."""
    tile.check_unchanged()
    try:
        header = read_header(tile.path)
    except Reject as reject:
        raise TileError(f"{shown(tile.path)}: {reject.message}") from None
    if header.point_count != tile.point_count or header.size != tile.size:
        raise TileError(f"{shown(tile.path)} changed since the scan; scan again and start a new run")
    return header


def _record_dtype(header: Header) -> np.dtype[Any]:
    """Return the part of a record that is read (LAS 1.4 R15, tables 7 and 15)."""
    names = ["X", "Y", "Z", "returns", "first"]
    formats = ["<i4", "<i4", "<i4", "u1", "u1"]
    offsets = [0, 4, 8, 14, 15]
    if header.point_format not in LEGACY_FORMATS:
        names, formats, offsets = [*names, "second"], [*formats, "u1"], [*offsets, 16]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": header.record_length})


def at_once(header: Header) -> int:
    """Return how many points are decoded at a time at most."""
    return max(1, min(BATCH, BATCH_BYTES // header.record_length))


def tile_records(tile: Tile, header: Header, size: int, wanted: int) -> Iterator[bytearray]:
    """Decode the packed records of a tile, see `records`; a tile that changes meanwhile is refused."""
    try:
        yield from records(tile.path, header, size, wanted)
    finally:
        tile.check_unchanged()


def records(path: str, header: Header, size: int, wanted: int) -> Iterator[bytearray]:
    """Decode the packed records of a file.

    Parameters
    ----------
    path, header : str, Header
        The file and its header, just read.
    size : int
        Points at a time at most; fewer when the records are so long that they would fill the memory.
    wanted : int
        The sum of `PLACES`, `HEIGHTS`, `CLASSES` and `FLAGS` as needed, or `ALL`: which layers of formats 6 to 10 are
        decoded; what is not may hold anything.

    Yields
    ------
    bytearray
        In file order; together all points the header promises.

    Raises
    ------
    TileError
        When the file is cut off, corrupt, or holds another number of points.
    """
    if header.point_count == 0:
        return
    size = min(size, at_once(header))
    with open(path, "rb") as file:
        if header.laszip is not None:
            _check_chunks(path, file, header, header.laszip)
            read = _decompressor(path, file, header, header.laszip, wanted)
        else:
            file.seek(header.offset_to_points)
            read = file.readinto
        for start in range(0, header.point_count, size):
            n = min(size, header.point_count - start)
            buffer = bytearray(n * header.record_length)
            got = _decode(path, read, buffer, start, n)
            if got is not None and got < len(buffer):
                raise TileError(
                    f"{shown(path)} ends at point {start + got // header.record_length} of {header.point_count}; "
                    "it was cut off: get it anew"
                )
            yield buffer


def _decode(path: str, read: Any, buffer: bytearray, start: int, n: int) -> int | None:
    try:
        got = read(buffer)
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    # The decompressor reports a broken stream as its own error, or panics, which is not an Exception.
    except BaseException as error:
        raise TileError(
            f"{shown(path)} cannot be decoded between points {start} and {start + n}: {error}; it is corrupt or "
            "cut off: get it anew"
        ) from None
    return None if got is None else int(got)


def _decompressor(path: str, file: BinaryIO, header: Header, laszip: Laszip, wanted: int) -> Any:
    import lazrs

    file.seek(header.offset_to_points)

    made: list[Any] = []

    def make(_: bytearray) -> None:
        made.append(lazrs.LasZipDecompressor(file, laszip.record, lazrs.DecompressionSelection(wanted)))

    _decode(path, make, bytearray(), 0, header.point_count)
    return made[0].decompress_many


def _check_chunks(path: str, file: BinaryIO, header: Header, laszip: Laszip) -> None:
    """Walk the heads of layered chunks: layer sizes must fill the file's points exactly, counts add up.

    So a lying size never reaches the decompressor, which would allocate it. Chunks of formats 0 to 5 have no head.
    """
    if not laszip.layered:
        return
    walk = chunks(file, laszip, header.record_length, header.offset_to_points + 8, shown(path))
    points = sum(chunk.points for chunk in walk)
    if points != header.point_count:
        raise TileError(f"{shown(path)} holds {points} points but its header says {header.point_count}; get it anew")
