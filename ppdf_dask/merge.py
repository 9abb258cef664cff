"""Masks back into the user's own tiles: every point, in its order, only `classification` changed.

The file is decoded again in full, each point asks the mask of its chunk, and the result goes to a temporary name,
is decoded once more and compared, and only then gets its own name.
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
from ppdf_dask.reader import BATCH, Batch, Decoder
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
        ``points``, ``ground`` (points of the ground class), ``changed``, ``bytes`` and the ``classes`` histogram.

    Raises
    ------
    TileError
        The source is damaged or changed, or the written file does not read back as it was meant.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    # Short, for the target's own name may be as long as names can be.
    part = target.with_name(f".{zlib.crc32(target.name.encode()):08x}.{os.getpid()}.part")
    try:
        meant = _copy(job, part, ground_of, compress=target.suffix != ".las")
        _verify(part, meant)
        if job.tile.version == "1.0":
            _set_minor_version(part, 0)
        os.replace(part, target)
    except (LaspyException, OSError) as error:
        raise TileError(f"{shown(job.tile.path)} could not be written to {target}: {error}") from error
    finally:
        with suppress(FileNotFoundError):
            part.unlink()
    return {**meant.record(), "bytes": target.stat().st_size}


class _Histogram:
    """Counts and running checksums of classes and whole records: what was meant against what was written."""

    def __init__(self) -> None:
        self.points, self.changed, self.crc, self.records = 0, 0, 0, 0
        self.classes = np.zeros(256, np.int64)

    def add(self, classes: npt.NDArray[np.uint8], records: npt.NDArray[Any]) -> None:
        self.points += len(classes)
        self.records = zlib.crc32(np.ascontiguousarray(records).view(np.uint8).data, self.records)
        self.classes += np.bincount(classes, minlength=256)
        self.crc = zlib.crc32(np.ascontiguousarray(classes).tobytes(), self.crc)

    def record(self) -> dict[str, Any]:
        histogram = {str(k): int(self.classes[k]) for k in np.flatnonzero(self.classes)}
        return {
            "points": self.points,
            "changed": self.changed,
            "classes": histogram,
            "crc32": self.crc,
            "records_crc32": self.records,
        }


def _copy(job: TileJob, part: Path, ground_of: GroundOf, *, compress: bool) -> _Histogram:
    decoder, meant = Decoder.of(job.tile, job.unit_xy, job.unit_z, job.params.classes, job.params.returns), _Histogram()
    job.tile.check_unchanged()
    backend = laspy.LazBackend.Lazrs
    with _opened(job.tile.path) as file, laspy.open(file, closefd=False, laz_backend=backend) as source:
        header = plain_header(source.header)
        with laspy.open(part, "w", header=header, laz_backend=backend, do_compress=compress) as out:
            for points in source.chunk_iterator(BATCH):
                batch = decoder.measure(points.array, meant.points)
                classes = new_classes(batch.classification, batch.eligible, ground_of(batch), job.params.classes)
                meant.changed += int((classes != batch.classification).sum())
                points.classification = classes
                out.write_points(points)
                meant.add(classes, points.array)
            evlrs = [v for v in source.evlrs or [] if v.user_id != "copc"]
            if evlrs:
                out.write_evlrs(laspy.vlrs.vlrlist.VLRList(evlrs))
    job.tile.check_unchanged()
    if meant.points != job.tile.point_count:
        raise TileError(f"{shown(job.tile.path)} holds {meant.points} points, its header says {job.tile.point_count}")
    return meant


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
    """Count points and classes of a written file again: the checksums among them as in its record.

    Raises
    ------
    TileError
        When it cannot be decoded.
    """
    try:
        return _count(path).record()
    except (KeyboardInterrupt, SystemExit):
        raise
    # The decompressor may panic on a broken stream, which is not an Exception.
    except BaseException as error:
        raise TileError(f"{shown(str(path))} cannot be decoded: {error}") from None


def _verify(part: Path, meant: _Histogram) -> None:
    found = _count(part)
    if (found.points, found.crc, found.records) != (meant.points, meant.crc, meant.records):
        raise TileError(
            f"{part} does not read back as written ({found.points} of {meant.points} points); "
            "check the disk and run again"
        )


def _count(path: Path) -> _Histogram:
    found = _Histogram()
    with _opened(path) as file, laspy.open(file, closefd=False, laz_backend=laspy.LazBackend.Lazrs) as reader:
        for points in reader.chunk_iterator(BATCH):
            found.add(np.asarray(points.classification, np.uint8), points.array)
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
