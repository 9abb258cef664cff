"""A chunk and what surrounds it, read from the store as clouds: of the whole core, or of a part of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Cloud
from ppdf_dask.grid import Chunk, ChunkGrid, Rect
from ppdf_dask.index import Parts, fragments, parts_of
from ppdf_dask.store import RunStore

Int32 = npt.NDArray[np.int32]
Bools = npt.NDArray[np.bool_]

KEPT_POINTS = 2_000_000
"""Points of neighbouring cores a task keeps decoded, those of the cloud it works on included (24 MB): the parts of a
chunk ask for the same ones again, and beside a large cloud, decoding again takes next to no time."""


class Kept:
    """Decoded points of chunks, at most `KEPT_POINTS` of them; the first that came go first."""

    def __init__(self, read: Callable[[str], Int32]) -> None:
        self._read = read
        self._points: dict[str, Int32] = {}

    def of(self, chunk: str) -> Int32:
        """Return the points of a chunk."""
        if chunk not in self._points:
            found = self._read(chunk)
            self.make_room(found.shape[1])
            self._points[chunk] = found
        return self._points[chunk]

    def make_room(self, n: int) -> None:
        """Let go of what leaves no room for `n` points more."""
        while self._points and sum(p.shape[1] for p in self._points.values()) + n > KEPT_POINTS:
            self._points.pop(next(iter(self._points)))


@dataclass(frozen=True)
class Cut:
    """How the survey lies in the store.

    Attributes
    ----------
    grid : ChunkGrid
        The chunks.
    buffer : int
        Width of the stored buffers, mm.
    extent : Rect
        Bounding box of all eligible points and of `unknown`, mm: outside is known to be empty.
    unknown : tuple of Rect
        Places of tiles that could not be read: what lies there is not known.
    """

    grid: ChunkGrid
    buffer: int
    extent: Rect
    unknown: tuple[Rect, ...] = ()

    def near(self, place: Rect) -> bool:
        """Tell whether a place holds something unknown."""
        return any(place.intersects(other) for other in self.unknown)

    def known(self, part: Rect, width: int) -> Rect:
        """Return the widest rectangle of known space around a part of a core within `width` mm.

        The part itself always belongs to it: whoever asks for one that is unknown somewhere has to say so (`near`).
        """
        found = part.grow(width)
        for place in self.unknown:
            if found.intersects(place):
                cuts = (
                    Rect(max(found.x0, place.x1), found.y0, found.x1, found.y1),
                    Rect(found.x0, max(found.y0, place.y1), found.x1, found.y1),
                    Rect(found.x0, found.y0, min(found.x1, place.x0), found.y1),
                    Rect(found.x0, found.y0, found.x1, min(found.y1, place.y0)),
                )
                whole = [c for c in cuts if c.contains(part)]
                found = max(whole, key=lambda c: c.width * c.height, default=part)
        return found


class Surroundings:
    """The core of a chunk, and clouds of any part of it with any buffer.

    Parameters
    ----------
    store : RunStore
        A store whose tile stage is complete: a place without fragments is empty.
    cut : Cut
        How the survey was cut.
    chunk : Chunk
        The chunk.

    Attributes
    ----------
    core : ndarray of int32, shape (3 or 4, n)
        The chunk's own points in the order of the fragments, from its lower-left corner; the fourth row tells ground
        given from the start.
    counts : dict
        Points of each source, in that order.
    """

    def __init__(self, store: RunStore, cut: Cut, chunk: Chunk) -> None:
        self._store, self._cut, self._chunk = store, cut, chunk
        cores = fragments(store, chunk.id, "core")
        self.counts = {source: points.shape[1] for source, points in cores.items()}
        self.core: Int32 = join(list(cores.values()))
        self._parts: dict[str, Parts] = {}
        self._kept = Kept(lambda other: join(list(fragments(store, other, "core").values())))

    @property
    def n(self) -> int:
        """Points of the core."""
        return int(self.core.shape[1])

    def xy(self, index: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the absolute coordinates of points of the core, mm."""
        home = self._chunk.core
        return self.core[0, index] + np.int64(home.x0), self.core[1, index] + np.int64(home.y0)

    def expect(self, part: Rect, width: int) -> float:
        """Return about how many points `cloud` would load, from the index alone."""
        if part == self._chunk.core and width <= self._cut.buffer:
            return float(sum(n for side in self._index(self._chunk.id).values() for n, _ in side.values()))
        known, points = part.grow(width), 0.0
        for other in self._cut.grid.over(overlap(known, self._cut.extent)):
            shared = overlap(known, other.core)
            inside = sum(n for n, _ in self._index(other.id).get("core", {}).values())
            points += inside * (shared.width * shared.height) / (other.core.width * other.core.height)
        return points

    def cloud(self, part: Rect, width: int) -> tuple[Cloud, npt.NDArray[np.int64]]:
        """Load a part of the core and at least `width` mm around it.

        Parameters
        ----------
        part : Rect
            A part of the core, or all of it.
        width : int
            Buffer in mm; up to the stored width it comes with the chunk, beyond that from the cores of the neighbours.

        Returns
        -------
        cloud : Cloud
            The part's points first, in the order of the core; `known` is None where nothing lies outside.
        index : ndarray of int64
            Which points of the core these are, ascending.
        """
        home, stored = self._chunk.core, self._cut.buffer
        if part == home:
            known = self._cut.known(part, max(width, stored))
            index, pieces = np.arange(self.n), [self.core]
        else:
            known = self._cut.known(part, width)
            mine = inside(self.core, home, part)
            index = np.flatnonzero(mine)
            rest = inside(self.core, home, known)
            rest[index] = False
            pieces = [self.core[:, index], self.core[:, rest]]
        if home.grow(stored).contains(known):
            whole = known == home.grow(stored)
            around = fragments(self._store, self._chunk.id, "buffer").values()
            pieces += [p if whole else crop(p, home, home, known) for p in around]
        else:
            for other in self._cut.grid.over(overlap(known, self._cut.extent)):
                if other != self._chunk:
                    pieces.append(crop(self._kept.of(other.id), other.core, home, known))
        points = join([p for p in pieces if p.shape[1]])
        self._kept.make_room(points.shape[1])
        cloud = Cloud(
            x=points[0],
            y=points[1],
            z=points[2],
            origin=(home.x0, home.y0),
            n_core=len(index),
            known=None if known.contains(self._cut.extent) else known,
            fixed=points[3].astype(np.bool_) if len(points) > 3 else None,
        )
        return cloud, index

    def _index(self, chunk: str) -> Parts:
        if chunk not in self._parts:
            self._parts[chunk] = parts_of(self._store, chunk)
        return self._parts[chunk]


def unsure(cut: Cut, chunk: Chunk, near: Surroundings, reach: int) -> Bools:
    """Return which core points lie so near to unknown space that their answer cannot count, bool (n,).

    Parameters
    ----------
    cut : Cut
        Says what is unknown.
    chunk : Chunk
        The chunk.
    near : Surroundings
        Its points.
    reach : int
        How far the filter looks, mm; 0 for one that proves its answers. All points of a core that is unknown in part
        are unsure.
    """
    found = np.full(near.n, cut.near(chunk.core))
    for place in cut.unknown if reach else ():
        found |= inside(near.core, chunk.core, place.grow(reach))
    return found


def inside(points: Int32, home: Rect, place: Rect) -> Bools:
    """Tell which points, counted from the corner of `home`, lie in `place`, bool (n,)."""
    # A bound outside int32 cannot cut anything: cores are far smaller than 2000 km.
    low, high = -(2**31), 2**31 - 1
    x0, x1 = (max(low, min(high, v - home.x0)) for v in (place.x0, place.x1))
    y0, y1 = (max(low, min(high, v - home.y0)) for v in (place.y0, place.y1))
    found: Bools = points[0] >= x0
    found &= points[0] < x1
    found &= points[1] >= y0
    found &= points[1] < y1
    return found


def overlap(a: Rect, b: Rect) -> Rect:
    """Return what two rectangles share; of a width or height below 0 when that is nothing."""
    return Rect(max(a.x0, b.x0), max(a.y0, b.y0), min(a.x1, b.x1), min(a.y1, b.y1))


def join(pieces: list[Int32]) -> Int32:
    """Join points, int32 (3 or 4, n)."""
    if not pieces:
        return np.empty((3, 0), np.int32)
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces, axis=1)


def crop(points: Int32, home: Rect, target: Rect, known: Rect) -> Int32:
    """Keep what lies in `known`, shifted from its own chunk's corner to that of `target`."""
    kept = points[:, inside(points, home, known)]
    kept[0] += home.x0 - target.x0
    kept[1] += home.y0 - target.y0
    return kept
