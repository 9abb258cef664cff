"""Masks back into the user's own tiles: every point, in its order, only `classification` changed.

Each point asks the mask of its chunk. The result goes to a temporary name, is read again and compared, and only then
gets its own name. Of layered files (formats 6 to 8) one layer is made anew and everything else carried over as bytes
(`ppdf_dask.relabel`); all others are decoded, encoded and decoded again in full.
"""

from __future__ import annotations

import os
import secrets
import zlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lazrs
import numpy as np
import numpy.typing as npt

from ppdf_dask.classes import LEGACY_FORMATS, Bytes, check_writable, new_classes
from ppdf_dask.errors import StoreError, TileError
from ppdf_dask.kept import Groups, kept_labels
from ppdf_dask.lascopy import Surroundings
from ppdf_dask.lasheader import RECORD_LENGTHS, Header, Reject, read_header
from ppdf_dask.reader import (
    ALL,
    BATCH,
    CLASSES,
    FLAGS,
    PLACES,
    Batch,
    Decoder,
    Labels,
    at_once,
    header_of,
    records,
    tile_records,
)
from ppdf_dask.relabel import can_relabel, differs, relabel, whole_chunks
from ppdf_dask.store import RunStore
from ppdf_dask.tiler import TileJob, owners
from ppdf_dask.tiles import shown

Bools = npt.NDArray[np.bool_]
GroundOf = Callable[[Batch], Bools]
Kept = Iterable[tuple[Labels, Bools]]


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
    labels : int
        Batches of labels the tiler kept; 0: the file is decoded again.
    cut_by : str
        Fingerprint the labels must carry.
    """

    tile: TileJob
    target: str
    made_by: str | None = None
    labels: int = 0
    cut_by: str = ""


def write_tile(store: RunStore, job: MergeJob) -> dict[str, Any]:
    """Write one classified tile of a run; see `rewrite`."""
    masks = _Masks(store, job.tile, job.made_by)
    kept = kept_labels(store, job.tile.source, job.labels, job.cut_by)
    labelled = ((labels, masks.of(labels.eligible, groups)) for labels, groups in kept)
    return rewrite(job.tile, Path(job.target), masks.ground, labelled if job.labels else None, masks.check_used_up)


def rewrite(
    job: TileJob,
    target: Path,
    ground_of: GroundOf,
    kept: Kept | None = None,
    check: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Copy a file with new classes.

    Parameters
    ----------
    job : TileJob
        The source.
    target : Path
        The result; LAS when its name ends in ``.las``, else LAZ.
    ground_of : callable
        Gives for each batch, in file order, the mask of its points found ground.
    kept : iterable, optional
        Labels of all points, in batches of whole chunks (`whole_chunks`), and the mask of each batch; for files that
        `can_relabel`, which need not be decoded again then.
    check : callable, optional
        Called when all is written, before the file gets its name; what it raises keeps the name away.

    Returns
    -------
    dict
        ``points``, ``changed``, the ``classes`` histogram, ``bytes`` and ``crc32`` of the file.

    Raises
    ------
    TileError
        The source is damaged or changed, or the written file does not read back as it was meant.
    """
    check_writable(job.params.classes, job.tile.point_format, shown(job.tile.path))
    # Short, for the target's own name may be as long as names can be; at random, for containers share process numbers.
    part = target.with_name(f".{zlib.crc32(target.name.encode()):08x}.{secrets.randbits(32)}.part")
    header, compress = header_of(job.tile), target.suffix != ".las"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if compress and can_relabel(header, at_once(header)):
            meant = _relabel(job, header, part, kept or _decoded(job, header, ground_of))
        else:
            meant = _copy(job, header, part, ground_of, compress=compress)
        job.tile.check_unchanged()
        check()
        crc = crc32_of(part)
        os.replace(part, target)
    except (OSError, lazrs.LazrsError) as error:  # the encoder's own word for a full disk; decoding has sentences
        raise TileError(f"{shown(job.tile.path)} could not be written to {target}: {error}") from error
    finally:
        with suppress(FileNotFoundError, NotADirectoryError):
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
        self.points, self.changed, self.crc, self.records, self.around = 0, 0, 0, 0, 0
        self.classes = np.zeros(256, np.int64)

    def add(self, classes: npt.NDArray[np.uint8], records: npt.NDArray[Any] | None = None) -> None:
        self.points += len(classes)
        self.classes += np.bincount(classes, minlength=256)
        self.crc = zlib.crc32(np.ascontiguousarray(classes).data, self.crc)
        if records is not None:
            self.records = zlib.crc32(np.ascontiguousarray(records).view(np.uint8).data, self.records)

    def give(self, labels: Labels, ground: Bools, job: TileJob) -> Bytes:
        """Return the new classes of the next points of a file, and count them."""
        classes = new_classes(labels.classification, labels.eligible, ground, job.params.classes)
        self.changed += int((classes != labels.classification).sum())
        self.add(classes)
        return classes

    def record(self) -> dict[str, Any]:
        histogram = {str(k): int(self.classes[k]) for k in np.flatnonzero(self.classes)}
        return {"points": self.points, "changed": self.changed, "classes": histogram}

    def check(self, job: TileJob, part: Path, *, whole: bool) -> None:
        """Decode a file, its classes or all of it, and refuse it when that is not what was meant."""
        try:
            found = _count(part, whole=whole)
        except TileError as error:
            raise _not_as_written(job, part, str(error)) from error
        sums = (found.points, found.crc, found.records, found.around)
        if sums != (self.points, self.crc, self.records, self.around):
            raise _not_as_written(job, part, f"{found.points} of {self.points} points")


def _decoder(job: TileJob, header: Header) -> Decoder:
    return Decoder.make(header, (job.unit_xy, job.unit_z), job.params.classes, job.params.returns)


def _decoded(job: TileJob, header: Header, ground_of: GroundOf) -> Kept:
    """Decode a file again, without heights."""
    decoder, start = _decoder(job, header), 0
    for raw in tile_records(job.tile, header, whole_chunks(header), PLACES | CLASSES | FLAGS):
        batch = decoder.measure(np.frombuffer(raw, decoder.dtype), start, heights=False)
        start += batch.n
        yield batch.labels, ground_of(batch)


def _relabel(job: TileJob, header: Header, part: Path, kept: Kept) -> _Histogram:
    """Replace the layer of classes, then look at what was written: its bytes, and the classes as they decode."""
    meant = _Histogram()
    relabel(job.tile.path, header, part, ((labels, meant.give(labels, ground, job)) for labels, ground in kept))
    trouble = differs(job.tile.path, header, part)
    if trouble:
        raise _not_as_written(job, part, trouble)
    meant.check(job, part, whole=False)
    return meant


def _copy(job: TileJob, header: Header, part: Path, ground_of: GroundOf, *, compress: bool) -> _Histogram:
    """Decode and encode all points, carry over the bytes around them, decode what was written and compare."""
    decoder, meant = _decoder(job, header), _Histogram()
    with open(job.tile.path, "rb") as source, part.open("w+b") as out:
        around = Surroundings.of(source, header)
        meant.around = around.checksum(source)
        vlr = _laszip(header) if compress else None
        around.begin(out, header, None if vlr is None else bytes(vlr.record_data()))
        writer = None if vlr is None else lazrs.LasZipCompressor(out, vlr)
        for raw in tile_records(job.tile, header, BATCH, ALL):
            packed = np.frombuffer(raw, np.uint8)
            batch = decoder.measure(packed.view(decoder.dtype), meant.points, heights=False)
            _set_classes(packed, meant.give(batch.labels, ground_of(batch), job), header)
            _ = out.write(packed.data) if writer is None else writer.compress_many(packed)
            meant.records = zlib.crc32(packed.data, meant.records)
        if writer is not None:
            writer.done()
        out.seek(0, os.SEEK_END)
        around.end(out, source)
    meant.check(job, part, whole=True)
    return meant


def _laszip(header: Header) -> Any:
    extra = header.record_length - RECORD_LENGTHS[header.point_format]
    return lazrs.LazVlr.new_for_compression(header.point_format, extra)


def _class_bytes(packed: Bytes, header: Header) -> tuple[Bytes, int]:
    """Return the bytes of packed records that hold the class, and which bits of them (LAS 1.4 R15, tables 7, 15)."""
    legacy = header.point_format in LEGACY_FORMATS
    return packed.reshape(-1, header.record_length)[:, 15 if legacy else 16], 0b1_1111 if legacy else 0xFF


def _set_classes(packed: Bytes, classes: Bytes, header: Header) -> None:
    column, bits = _class_bytes(packed, header)
    column[...] = column & (bits ^ 0xFF) | classes


def _not_as_written(job: TileJob, part: Path, why: str) -> TileError:
    return TileError(
        f"{shown(job.tile.path)}: {part} does not read back as written ({why}); check the disk and run again"
    )


def class_counts(path: Path) -> dict[str, Any]:
    """Count points and classes of a written file again, as in its record.

    Raises
    ------
    TileError
        When it cannot be decoded.
    """
    return _count(path, whole=False).record()


def _count(path: Path, *, whole: bool) -> _Histogram:
    """Decode a written file: its classes, or all of its records and what surrounds them."""
    found = _Histogram()
    try:
        header = read_header(str(path))
    except Reject as reject:
        raise TileError(f"{shown(str(path))} {reject.message}") from None
    if whole:
        with path.open("rb") as file:
            found.around = Surroundings.of(file, header).checksum(file)
    for raw in records(str(path), header, BATCH, ALL if whole else CLASSES):
        packed = np.frombuffer(raw, np.uint8)
        column, bits = _class_bytes(packed, header)
        found.add(np.bitwise_and(column, np.uint8(bits)), packed if whole else None)
    return found


class _Masks:
    """The masks of the chunks a file touches, each read once, walked through in file order."""

    def __init__(self, store: RunStore, job: TileJob, made_by: str | None = None) -> None:
        self._store, self._job, self._made_by = store, job, made_by
        self._masks: dict[str, Bools] = {}
        self._used: dict[str, int] = {}

    def ground(self, batch: Batch) -> Bools:
        """Return the mask of a batch, whose points say where they lie."""
        grid, seen = self._job.grid, batch.eligible
        groups = [(grid.chunk(ix, iy).id, index) for ix, iy, index in owners(grid, batch.x[seen], batch.y[seen])]
        return self.of(seen, groups)

    def of(self, eligible: Bools, groups: Groups) -> Bools:
        """Return the mask of a batch, whose eligible points are grouped by the chunks that own them."""
        seen = np.zeros(int(eligible.sum()), np.bool_)
        for chunk, index in groups:
            if chunk not in self._masks:
                masks = self._store.read_classification(chunk, self._made_by)
                self._masks[chunk] = masks.get(self._job.source, np.zeros(0, np.bool_))
                self._used[chunk] = 0
            begin = self._used[chunk]
            self._used[chunk] = end = begin + len(index)
            if end > len(self._masks[chunk]):
                raise self._mismatch(chunk)
            seen[index] = self._masks[chunk][begin:end]
        found = np.zeros(len(eligible), np.bool_)
        found[eligible] = seen
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
