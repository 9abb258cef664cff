"""A chunk and what surrounds it, read from the store as one cloud."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ppdf_dask.filters.cloud import Cloud
from ppdf_dask.grid import Chunk, ChunkGrid, Rect
from ppdf_dask.store import RunStore

Int32 = npt.NDArray[np.int32]


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
        Bounding box of all eligible points, mm: outside is known to be empty.
    """

    grid: ChunkGrid
    buffer: int
    extent: Rect


def load(store: RunStore, cut: Cut, chunk: Chunk, width: int) -> tuple[Cloud, dict[str, int]]:
    """Read a chunk's core and at least `width` mm around it.

    Parameters
    ----------
    store : RunStore
        A store whose tile stage is complete: a place without fragments is empty.
    cut : Cut
        How the survey was cut.
    chunk : Chunk
        The chunk.
    width : int
        Buffer in mm; up to the stored width it comes with the chunk, beyond that from the cores of the neighbours.

    Returns
    -------
    cloud : Cloud
        Core points first, in the order of the fragments; `known` is None where nothing lies outside.
    counts : dict
        Core points of each source, in that order.
    """
    cores = {source: store.read_points(chunk.id, "core", source) for source in store.sources(chunk.id, "core")}
    counts = {source: points.shape[1] for source, points in cores.items()}
    parts = list(cores.values())
    if width <= cut.buffer:
        known = chunk.core.grow(cut.buffer)
        parts += [store.read_points(chunk.id, "buffer", source) for source in store.sources(chunk.id, "buffer")]
    else:
        known = chunk.core.grow(width)
        for other in cut.grid.over(_overlap(known, cut.extent)):
            if other != chunk:
                parts += [
                    _crop(store.read_points(other.id, "core", source), other.core, chunk.core, known)
                    for source in store.sources(other.id, "core")
                ]
    points = np.concatenate(parts, axis=1) if parts else np.empty((3, 0), np.int32)
    cloud = Cloud(
        x=points[0],
        y=points[1],
        z=points[2],
        origin=(chunk.core.x0, chunk.core.y0),
        n_core=sum(counts.values()),
        known=None if known.contains(cut.extent) else known,
        fixed=points[3].astype(np.bool_) if len(points) > 3 else None,
    )
    return cloud, counts


def _overlap(a: Rect, b: Rect) -> Rect:
    return Rect(max(a.x0, b.x0), max(a.y0, b.y0), min(a.x1, b.x1), min(a.y1, b.y1))


def _crop(points: Int32, home: Rect, target: Rect, known: Rect) -> Int32:
    """Keep what lies in `known`, shifted from its own chunk's corner to that of `target`."""
    dx, dy = home.x0 - target.x0, home.y0 - target.y0
    x, y = points[0] + np.int64(dx), points[1] + np.int64(dy)
    inside = (
        (x >= known.x0 - target.x0)
        & (x < known.x1 - target.x0)
        & (y >= known.y0 - target.y0)
        & (y < known.y1 - target.y0)
    )
    kept = points[:, inside]
    kept[0], kept[1] = x[inside], y[inside]
    return kept
