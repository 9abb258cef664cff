"""Source file to fragments: decode once, stream, cut into overlapping chunks.

A point belongs to the one chunk whose half-open core holds it, and lies in the buffers of the chunks around. Only
eligible points are stored. Within a fragment they keep the order of the file; that is the way back: the k-th
eligible point of a file inside a chunk is the k-th point of the file's fragment there (`owners` gives the same answer
when the file is decoded again for the merge), so no index needs to be stored.
"""

from __future__ import annotations

import base64
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.checksums import check_sha256
from ppdf_dask.errors import TileError
from ppdf_dask.filters.cloud import LIMIT
from ppdf_dask.grid import DENSITY_CELL, MM, ChunkGrid, Rect
from ppdf_dask.kept import Groups, keep_labels
from ppdf_dask.params import RunParams
from ppdf_dask.reader import BATCH, Batch, at_once, batches, header_of
from ppdf_dask.relabel import can_relabel, whole_chunks
from ppdf_dask.store import RunStore
from ppdf_dask.survey import Tile

Int64 = npt.NDArray[np.int64]
Int32 = npt.NDArray[np.int32]

SPILL_POINTS = 6_000_000
"""Buffered points (12 bytes each) above which fragments in the making go to a temporary folder."""

WORTH_KEEPING = 50_000
"""Points of a file from which on it takes less time, and objects, to keep labels than to decode it again."""


@dataclass(frozen=True)
class TileJob:
    """What a worker needs to cut one source file.

    Attributes
    ----------
    source : str
        The file's id in the store.
    tile : Tile
        Its header facts, as scanned.
    unit_xy, unit_z : float
        Metres per unit of the file's coordinates.
    params : RunParams
        Class rules and the returns to offer.
    grid : ChunkGrid
        How the survey is cut.
    buffer : int
        Width of the stored buffer, mm; at most the chunk size (a wider one is read from the neighbours' cores).
    """

    source: str
    tile: Tile
    unit_xy: float
    unit_z: float
    params: RunParams
    grid: ChunkGrid
    buffer: int

    def batches(self, size: int = BATCH) -> Iterator[Batch]:
        """Decode the file in order, `size` points at a time."""
        return batches(
            self.tile,
            unit_xy=self.unit_xy,
            unit_z=self.unit_z,
            rules=self.params.classes,
            returns=self.params.returns,
            size=size,
        )


def owners(grid: ChunkGrid, x: Int64, y: Int64) -> Iterator[tuple[int, int, Int64]]:
    """Group points by the chunk that owns them.

    Parameters
    ----------
    grid : ChunkGrid
        The chunks.
    x, y : ndarray of int64, shape (n,)
        Absolute millimetres.

    Yields
    ------
    ix, iy : int
        Column and row of a chunk.
    index : ndarray of int64
        The points it owns, ascending: each point appears in exactly one group.

    Examples
    --------
    >>> x = np.array([0, 5000, 4999, 0])
    >>> y = np.array([0, 0, 0, -1])
    >>> [(ix, iy, index.tolist()) for ix, iy, index in owners(ChunkGrid(5000), x, y)]
    [(0, -1, [3]), (0, 0, [0, 2]), (1, 0, [1])]
    """
    if len(x) == 0:
        return
    ix, iy = x // grid.size, y // grid.size
    x0, y0 = int(ix.min()), int(iy.min())
    rows = int(iy.max()) - y0 + 1
    key = (ix - x0) * rows + (iy - y0)
    last = int(key.max())
    if last == 0:
        yield x0, y0, np.arange(len(x))
        return
    # NumPy sorts 16-bit keys by counting, five times as fast.
    order = np.argsort(key.astype(np.uint16) if last < 1 << 16 else key, kind="stable")
    cuts = np.flatnonzero(np.diff(key[order])) + 1
    for index in np.split(order, cuts):
        k = int(key[index[0]])
        yield x0 + k // rows, y0 + k % rows, index


def neighbours(grid: ChunkGrid, buffer: int, x: Int64, y: Int64) -> Iterator[tuple[int, int, Int64]]:
    """Group points by the chunks in whose buffers (but not cores) they lie; `buffer` is at most the chunk size.

    Yields
    ------
    ix, iy : int
        Column and row of a chunk; the same chunk may come several times.
    index : ndarray of int64
        Points of its buffer, ascending.
    """
    if buffer == 0:
        return
    s = grid.size
    ax, ay = x % s, y % s
    west, east, south, north = ax < buffer, ax >= s - buffer, ay < buffer, ay >= s - buffer
    everywhere = np.ones(len(x), np.bool_)
    columns = ((-1, west), (0, everywhere), (1, east))
    rows = ((-1, south), (0, everywhere), (1, north))
    for dx, inside_x in columns:
        for dy, inside_y in rows:
            if dx == 0 and dy == 0:
                continue
            chosen = np.flatnonzero(inside_x & inside_y)
            for ix, iy, index in owners(grid, x[chosen], y[chosen]):
                yield ix + dx, iy + dy, chosen[index]


def cut(store: RunStore, job: TileJob) -> dict[str, Any]:
    """Cut one source file into fragments and write them.

    Returns
    -------
    dict
        ``points``, ``eligible``, measured ``bounds`` (mm), ``z`` range (mm), ``classes`` histogram of the file and
        ``chunks``: chunk id to ``[core points, occupied density cells, buffer points]``; ``labels``: how many batches
        of labels were kept for the merge (`ppdf_dask.kept`).

    Raises
    ------
    TileError
        Damaged or changed file; nothing of it counts until its record is published.
    """
    check_sha256(job.tile)
    facts, header = _Facts(), header_of(job.tile)
    keep = can_relabel(header, at_once(header)) and job.tile.point_count >= WORTH_KEEPING
    with tempfile.TemporaryDirectory(prefix="ppdf-tile-") as folder:
        spool = _Spool(Path(folder))
        cells: dict[str, npt.NDArray[np.bool_]] = {}
        for number, batch in enumerate(job.batches(whole_chunks(header) if keep else BATCH)):
            facts.add(batch)
            owners = _spread(job, batch, spool, cells)
            keep = keep and keep_labels(store, job.source, number, batch.labels, owners)
        counts: dict[str, list[int]] = {}
        for (chunk, part), points in spool.fragments():
            entry = counts.setdefault(chunk, [0, 0, 0])
            entry[2 if part == "buffer" else 0] = points.shape[1]
            attributes = {}
            if part == "core":
                entry[1] = int(cells[chunk].sum())
                attributes = {"density_cells": pack_cells(cells[chunk])}
            store.write_points(chunk, part, job.source, points, attributes)
    return facts.record() | {"chunks": dict(sorted(counts.items())), "labels": number + 1 if keep else 0}


def _spread(job: TileJob, batch: Batch, spool: _Spool, cells: dict[str, npt.NDArray[np.bool_]]) -> Groups:
    """Give the points to the chunks; return which of the batch's eligible points each one owns."""
    x, y, z = (values[batch.eligible] for values in (batch.x, batch.y, batch.z))
    found: Groups = []
    if len(x) == 0:
        return found
    if max(-int(z.min()), int(z.max())) > LIMIT:
        raise TileError(
            f"{job.tile.path}: a height of {max(-int(z.min()), int(z.max())) / MM:.0f} m cannot be stored; "
            f"the limit is {LIMIT / MM:.0f} m. Repair the file or classify its stray points as noise (7 or 18)."
        )
    rows = [x, y, z]
    if job.params.classes.mode == "refine":
        rows.append(batch.fixed[batch.eligible].astype(np.int64))
    side = job.grid.size // DENSITY_CELL
    for ix, iy, index in owners(job.grid, x, y):
        chunk = job.grid.chunk(ix, iy)
        points = _relative(rows, index, chunk.core)
        found.append((chunk.id, index))
        spool.add(chunk.id, "core", points)
        seen = cells.setdefault(chunk.id, np.zeros(side * side, np.bool_))
        seen[points[0] // DENSITY_CELL * side + points[1] // DENSITY_CELL] = True
    for ix, iy, index in neighbours(job.grid, job.buffer, x, y):
        chunk = job.grid.chunk(ix, iy)
        spool.add(chunk.id, "buffer", _relative(rows, index, chunk.core))
    return found


def _relative(rows: list[Int64], index: Int64, core: Rect) -> Int32:
    points = np.empty((len(rows), len(index)), np.int32)
    for k, values in enumerate(rows):
        points[k] = values[index] - (core.x0, core.y0, 0, 0)[k]
    return points


def pack_cells(cells: npt.NDArray[np.bool_]) -> str:
    """Pack a chunk's occupied density cells into text for an attribute."""
    return base64.b64encode(zlib.compress(np.packbits(cells).tobytes(), 6)).decode()


def unpack_cells(text: str) -> npt.NDArray[np.uint8]:
    """Return the packed bits of `pack_cells`; those of several sources are united by ``|``."""
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)


@dataclass
class _Facts:
    """What is measured while a file passes by."""

    points: int = 0
    eligible: int = 0
    bounds: Rect | None = None
    z: tuple[int, int] | None = None
    no_returns: int = 0
    odd_returns: int = 0
    classes: Int64 = field(default_factory=lambda: np.zeros(256, np.int64))

    def add(self, batch: Batch) -> None:
        self.points += len(batch.x)
        self.eligible += int(batch.eligible.sum())
        self.no_returns += batch.no_returns
        self.odd_returns += batch.odd_returns
        self.classes += np.bincount(batch.classification, minlength=256)
        if len(batch.x):
            here = Rect(int(batch.x.min()), int(batch.y.min()), int(batch.x.max()) + 1, int(batch.y.max()) + 1)
            low, high = int(batch.z.min()), int(batch.z.max())
            self.bounds = here if self.bounds is None else self.bounds.union(here)
            self.z = (low, high) if self.z is None else (min(low, self.z[0]), max(high, self.z[1]))

    def record(self) -> dict[str, Any]:
        b = self.bounds
        return {
            "points": self.points,
            "eligible": self.eligible,
            "no_returns": self.no_returns,
            "odd_returns": self.odd_returns,
            "bounds": None if b is None else [b.x0, b.y0, b.x1, b.y1],
            "z": None if self.z is None else list(self.z),
            "classes": {str(k): int(self.classes[k]) for k in np.flatnonzero(self.classes)},
        }


class _Spool:
    """Collects fragments; beyond `SPILL_POINTS` in memory they wait on disk, so memory does not grow with the file."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._parts: dict[tuple[str, str], list[Int32]] = {}
        self._spilled: set[tuple[str, str]] = set()
        self._held = 0
        self._rows = 3

    def add(self, chunk: str, part: str, points: Int32) -> None:
        self._rows = points.shape[0]
        self._parts.setdefault((chunk, part), []).append(points)
        self._held += points.shape[1]
        if self._held > SPILL_POINTS:
            self._spill()

    def _path(self, key: tuple[str, str]) -> Path:
        return self._folder / "-".join(key)

    def _spill(self) -> None:
        for key, parts in self._parts.items():
            with self._path(key).open("ab") as out:
                for points in parts:
                    out.write(np.ascontiguousarray(points.T).tobytes())
            self._spilled.add(key)
        self._parts = {key: [] for key in self._parts}
        self._held = 0

    def fragments(self) -> Iterator[tuple[tuple[str, str], Int32]]:
        """Yield each fragment once, complete, and let go of it."""
        for key in sorted(self._parts):
            parts = self._parts.pop(key)
            if key in self._spilled:
                path = self._path(key)
                parts.insert(0, np.fromfile(path, np.int32).reshape(-1, self._rows).T)
                path.unlink()
            yield key, np.ascontiguousarray(np.concatenate(parts, axis=1))
