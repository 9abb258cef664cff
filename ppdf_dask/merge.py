"""Masks back into the user's own tiles: every point, in its order, only `classification` changed.

Each point asks the mask of its chunk. The result goes to a temporary name, is read again and compared, and only then
gets its own name. Of layered files (formats 6 to 8) one layer is made anew and everything else carried over as bytes
(`ppdf_dask.relabel`); all others are decoded, encoded and decoded again in full.
"""

from __future__ import annotations

import io
import os
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import laspy
import numpy as np
import numpy.typing as npt
from laspy.errors import LaspyException

from ppdf_dask.classes import new_classes
from ppdf_dask.errors import StoreError, TileError
from ppdf_dask.lasheader import Header
from ppdf_dask.reader import BATCH, CLASSES, FLAGS, PLACES, Batch, Decoder, header_of, records
from ppdf_dask.relabel import can_relabel, differs, relabel
from ppdf_dask.store import RunStore
from ppdf_dask.tiler import TileJob, owners
from ppdf_dask.tiles import shown

Bools = npt.NDArray[np.bool_]
GroundOf = Callable[[Batch], Bools]


@dataclass(frozen=True)
class MergeJob:
    """What a worker needs to write one source file again.

    Attributes
    ----------
    tile : TileJob
        As the file was cut.
    target : str
        Path of the classified file.
    made_by : str or None
        Fingerprint the classifications must carry; None: any.
    """

    tile: TileJob
    target: str
    made_by: str | None = None


def write_tile(store: RunStore, job: MergeJob) -> dict[str, Any]:
    """Write one classified tile of a run; see `rewrite`."""
    masks = _Masks(store, job.tile, job.made_by)
    record = rewrite(job.tile, Path(job.target), masks.ground)
    masks.check_used_up()
    return record


def rewrite(job: TileJob, target: Path, ground_of: GroundOf) -> dict[str, Any]:
    """Copy a file with new classes.

    Parameters
    ----------
    job : TileJob
        The source.
    target : Path
        The result; LAS when its name ends in ``.las``, else LAZ.
    ground_of : callable
        Gives for each batch, in file order, the mask of its points found ground.

    Returns
    -------
    dict
        ``points``, ``changed``, the ``classes`` histogram, ``bytes`` and ``crc32`` of the file.

    Raises
    ------
    TileError
        The source is damaged or changed, or the written file does not read back as it was meant.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    # Short, for the target's own name may be as long as names can be.
    part = target.with_name(f".{zlib.crc32(target.name.encode()):08x}.{os.getpid()}.part")
    header, compress = header_of(job.tile), target.suffix != ".las"
    job.tile.check_unchanged()
    try:
        if compress and can_relabel(header, BATCH):
            meant = _relabel(job, header, part, ground_of)
        else:
            meant = _copy(job, header, part, ground_of, compress=compress)
        job.tile.check_unchanged()
        if job.tile.version == "1.0":
            _set_minor_version(part, 0)
        crc = crc32_of(part)
        os.replace(part, target)
    except (LaspyException, OSError) as error:
        raise TileError(f"{shown(job.tile.path)} could not be written to {target}: {error}") from error
    finally:
        with suppress(FileNotFoundError):
            part.unlink()
    return {**meant.record(), "bytes": target.stat().st_size, "crc32": crc}


def crc32_of(path: Path) -> int:
    """Return the checksum of a file's bytes."""
    found = 0
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            found = zlib.crc32(block, found)
    return found


class _Histogram:
    """Counts and running checksums of classes and whole records: what was meant against what was written."""

    def __init__(self) -> None:
        self.points, self.changed, self.crc, self.records = 0, 0, 0, 0
        self.classes = np.zeros(256, np.int64)

    def add(self, classes: npt.NDArray[np.uint8], records: npt.NDArray[Any] | None = None) -> None:
        self.points += len(classes)
        self.classes += np.bincount(classes, minlength=256)
        self.crc = zlib.crc32(np.ascontiguousarray(classes).data, self.crc)
        if records is not None:
            self.records = zlib.crc32(np.ascontiguousarray(records).view(np.uint8).data, self.records)

    def record(self) -> dict[str, Any]:
        histogram = {str(k): int(self.classes[k]) for k in np.flatnonzero(self.classes)}
        return {"points": self.points, "changed": self.changed, "classes": histogram}

    def check(self, part: Path, *, whole: bool) -> None:
        """Decode a file, its classes or all of it, and refuse it when that is not what was meant."""
        try:
            found = _count(part, whole=whole)
        except TileError as error:
            raise _not_as_written(part, str(error)) from error
        if (found.points, found.crc, found.records) != (self.points, self.crc, self.records):
            raise _not_as_written(part, f"{found.points} of {self.points} points")


class _Labels:
    """Gives records their classes and keeps count of them."""

    def __init__(self, job: TileJob, header: Header, ground_of: GroundOf) -> None:
        self._decoder = Decoder.make(header, (job.unit_xy, job.unit_z), job.params.classes, job.params.returns)
        self._job, self._ground_of, self.meant = job, ground_of, _Histogram()

    def of(self, records: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        """Return the classes of the next records of the file."""
        batch = self._decoder.measure(records, self.meant.points, heights=False)
        classes = new_classes(batch.classification, batch.eligible, self._ground_of(batch), self._job.params.classes)
        self.meant.changed += int((classes != batch.classification).sum())
        self.meant.add(classes)
        return classes


def _relabel(job: TileJob, header: Header, part: Path, ground_of: GroundOf) -> _Histogram:
    """Replace the layer of classes, then look at what was written: its bytes, and the classes as they decode."""
    assert header.laszip is not None
    assert header.laszip.chunk_size is not None
    labels = _Labels(job, header, ground_of)
    dtype = np.dtype((np.void, header.record_length))
    size = BATCH // header.laszip.chunk_size * header.laszip.chunk_size
    raw = (np.frombuffer(data, dtype) for data in records(job.tile, header, size, PLACES | CLASSES | FLAGS))
    relabel(job.tile.path, header, part, ((some, labels.of(some)) for some in raw))
    job.tile.check_unchanged()
    trouble = differs(job.tile.path, header, part)
    if trouble:
        raise _not_as_written(part, trouble)
    labels.meant.check(part, whole=False)
    return labels.meant


def _copy(job: TileJob, header: Header, part: Path, ground_of: GroundOf, *, compress: bool) -> _Histogram:
    """Decode and encode everything, decode what was written and compare."""
    labels, backend = _Labels(job, header, ground_of), laspy.LazBackend.Lazrs
    meant = labels.meant
    with _opened(job.tile.path) as file, laspy.open(file, closefd=False, laz_backend=backend) as source:
        plain = plain_header(source.header)
        with laspy.open(part, "w", header=plain, laz_backend=backend, do_compress=compress) as out:
            for points in source.chunk_iterator(BATCH):
                points.classification = labels.of(points.array)
                out.write_points(points)
                meant.records = zlib.crc32(np.ascontiguousarray(points.array).view(np.uint8).data, meant.records)
            evlrs = [v for v in source.evlrs or [] if v.user_id != "copc"]
            if evlrs:
                out.write_evlrs(laspy.vlrs.vlrlist.VLRList(evlrs))
    if meant.points != job.tile.point_count:
        raise TileError(f"{shown(job.tile.path)} holds {meant.points} points, its header says {job.tile.point_count}")
    meant.check(part, whole=True)
    return meant


def _not_as_written(part: Path, why: str) -> TileError:
    return TileError(f"{part} does not read back as written ({why}); check the disk and run again")


class _AsVersion11(io.FileIO):
    """A LAS 1.0 file that calls itself 1.1, for laspy does not know 1.0; the two differ in reserved fields only."""

    def readinto(self, buffer: Any, /) -> int:
        start = self.tell()
        got = super().readinto(buffer)
        if start <= _MINOR_VERSION < start + got:
            buffer[_MINOR_VERSION - start] = 1
        return got


_MINOR_VERSION = 25
"""Byte of the header that tells LAS 1.0 from 1.4."""


def _opened(path: str | Path) -> BinaryIO:
    with open(path, "rb") as file:
        old = file.read(_MINOR_VERSION + 1)[_MINOR_VERSION:] == b"\0"
    return io.BufferedReader(_AsVersion11(path)) if old else open(path, "rb")


def _set_minor_version(path: Path, minor: int) -> None:
    with path.open("r+b") as file:
        file.seek(_MINOR_VERSION)
        file.write(bytes([minor]))


def plain_header(header: laspy.LasHeader) -> laspy.LasHeader:
    """Return the header for the result: the same but for the COPC index, which describes the old order of bytes."""
    kept = [v for v in header.vlrs if v.user_id != "copc"]
    header.vlrs = laspy.vlrs.vlrlist.VLRList(kept)
    return header


def class_counts(path: Path) -> dict[str, Any]:
    """Count points and classes of a written file again, as in its record.

    Raises
    ------
    TileError
        When it cannot be decoded.
    """
    return _count(path, whole=False).record()


def _count(path: Path, *, whole: bool) -> _Histogram:
    """Decode a written file: its classes, or all of its records."""
    found, chosen = _Histogram(), laspy.DecompressionSelection.all()
    if not whole:
        chosen = laspy.DecompressionSelection.base() | laspy.DecompressionSelection.CLASSIFICATION
    backend = laspy.LazBackend.Lazrs
    try:
        with (
            _opened(path) as file,
            laspy.open(file, closefd=False, laz_backend=backend, decompression_selection=chosen) as reader,
        ):
            for points in reader.chunk_iterator(BATCH):
                found.add(np.asarray(points.classification, np.uint8), points.array if whole else None)
    except (KeyboardInterrupt, SystemExit):
        raise
    # The decompressor may panic on a broken stream, which is not an Exception.
    except BaseException as error:
        raise TileError(f"{shown(str(path))} cannot be decoded: {error}") from None
    return found


class _Masks:
    """The masks of the chunks a file touches, each read once, walked through in file order."""

    def __init__(self, store: RunStore, job: TileJob, made_by: str | None = None) -> None:
        self._store, self._job, self._made_by = store, job, made_by
        self._masks: dict[str, Bools] = {}
        self._used: dict[str, int] = {}

    def ground(self, batch: Batch) -> Bools:
        found = np.zeros(batch.n, np.bool_)
        seen = np.flatnonzero(batch.eligible)
        for ix, iy, index in owners(self._job.grid, batch.x[seen], batch.y[seen]):
            chunk = self._job.grid.chunk(ix, iy).id
            if chunk not in self._masks:
                masks = self._store.read_classification(chunk, self._made_by)
                self._masks[chunk] = masks.get(self._job.source, np.zeros(0, np.bool_))
                self._used[chunk] = 0
            begin = self._used[chunk]
            self._used[chunk] = end = begin + len(index)
            if end > len(self._masks[chunk]):
                raise self._mismatch(chunk)
            found[seen[index]] = self._masks[chunk][begin:end]
        return found

    def check_used_up(self) -> None:
        for chunk, mask in self._masks.items():
            if self._used[chunk] != len(mask):
                raise self._mismatch(chunk)

    def _mismatch(self, chunk: str) -> StoreError:
        return StoreError(
            f"the classification of chunk {chunk} has another number of points of {shown(self._job.tile.path)} than "
            "the file; was the file changed during the run? Run again with --overwrite"
        )
