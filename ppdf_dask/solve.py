"""One chunk from points to labels, with as wide a buffer as each place needs and no more memory than is allowed.

The whole core is classified once with the first guess of the buffer. What that could not prove is classified again with
a wider buffer, alone: a proof that fails does so in a few places, and their surroundings are small. Where a cloud would
exceed the memory, its core is cut into quarters. Neither changes a proven answer, for it is that of the whole survey.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ppdf_dask import filters
from ppdf_dask.grid import Chunk, Rect
from ppdf_dask.heap import give_back
from ppdf_dask.neighbourhood import Cut, Surroundings, unsure
from ppdf_dask.params import Parameters
from ppdf_dask.store import RunStore

Bools = npt.NDArray[np.bool_]
Int64 = npt.NDArray[np.int64]

NARROW = 10_000
"""A buffer below this, mm, is widened as if it were this wide."""

FIRST_STEP, NEXT_STEPS = 2.5, 1.5
"""What a buffer grows by, first and then.

Where a proof fails, a patch mostly is cut by the area's edge, and nothing is won before all of it is inside. With the
planner's chunks these steps load fewer points than doubling, with chunks of 150 m some more (`ppdf-dask benchmark
proof`, README).
"""


@dataclass(frozen=True)
class ClassifyJob:
    """What a worker needs to classify one chunk.

    Attributes
    ----------
    chunk : Chunk
        The chunk.
    cut : Cut
        How the survey lies in the store.
    filter : Parameters
        The filter's parameters, nothing left to derive.
    buffer, max_buffer : int
        First guess and limit of the buffer, mm.
    most_points : float
        Points a cloud may have; default: any number.
    usual_points : float
        Points above which a cloud with a wider buffer is cut where that helps, though there is memory for more: else
        the peak of a large survey would be that of its worst place. Default: any number.
    """

    chunk: Chunk
    cut: Cut
    filter: Parameters
    buffer: int
    max_buffer: int
    most_points: float = float("inf")
    usual_points: float = float("inf")


@dataclass(frozen=True)
class Answer:
    """What classifying a chunk gave.

    Attributes
    ----------
    core : ndarray of int32, shape (3 or 4, n)
        The chunk's points, from its lower-left corner.
    counts : dict
        Core points of each source.
    ground, unproven : ndarray of bool, shape (n,)
        The mask, and what could not be proven.
    loaded : tuple of int
        Points of each cloud that was classified.
    loaded_first : int
        Points of those with the first guess of the buffer.
    width : int
        The widest buffer tried, mm.
    full : bool
        Whether memory, not `max_buffer`, kept it from trying a wider one.
    """

    core: npt.NDArray[np.int32]
    counts: dict[str, int]
    ground: npt.NDArray[np.bool_]
    unproven: npt.NDArray[np.bool_]
    loaded: tuple[int, ...]
    loaded_first: int
    width: int
    full: bool

    @property
    def tries(self) -> int:
        """Clouds classified."""
        return len(self.loaded)


def solve(store: RunStore, job: ClassifyJob) -> Answer:
    """Classify the core of one chunk; writes nothing.

    Parameters
    ----------
    store : RunStore
        With all fragments and their index.
    job : ClassifyJob
        The chunk and how to go about it.

    Returns
    -------
    Answer
        Every proven answer is that of the whole survey as one chunk.

    Raises
    ------
    DamagedError
        When a fragment is not what the index says.
    """
    chosen, near = filters.of(job.filter), Surroundings(store, job.cut, job.chunk)
    ground, unproven = np.zeros(near.n, np.bool_), np.ones(near.n, np.bool_)
    reach = 0 if chosen.exact else round(chosen.required_buffer(job.filter) * 1000)
    lost = unsure(job.cut, job.chunk, near, reach)
    todo, loaded, first, widest, full = [(job.chunk.core, job.buffer)], [], 0, job.buffer, False
    while todo:
        part, width = todo.pop()
        expected = near.expect(part, width)
        if expected > (job.most_points if width == job.buffer else min(job.most_points, job.usual_points)):
            parts = quarters(part, width)
            todo += [(p, width) for p in parts]
            if parts:
                continue
            if width > job.buffer and expected > job.most_points:
                full = True
                continue
        n, left = _attempt(near, job, (part, width), ground, unproven)
        give_back()
        widest = max(widest, width)
        loaded.append(n)
        first += n if width == job.buffer else 0
        left = left[~lost[left]]
        if len(left) == 0 or width >= job.max_buffer:
            continue
        if width > job.buffer and job.cut.near(part.grow(width)):
            continue  # What lies there stays unknown, however wide the buffer.
        wider = widened(max(width, job.cut.buffer), first=width == job.buffer, most=job.max_buffer)
        todo += [(place, wider) for place in cover(*near.xy(left), wider)]
    if len(near.core) > 3:
        ground |= near.core[3].astype(np.bool_)
    return Answer(near.core, near.counts, ground, unproven | lost, tuple(loaded), first, widest, full)


def _attempt(
    near: Surroundings, job: ClassifyJob, where: tuple[Rect, int], ground: Bools, unproven: Bools
) -> tuple[int, Int64]:
    """Classify one cloud and note what it tells; return its points, and which of its core a wider one could prove.

    A function of its own because nothing else of the cloud may stay while the next one is loaded.
    """
    cloud, index = near.cloud(*where)
    verdict = filters.of(job.filter).classify(cloud, job.filter)
    # What an earlier cloud proved stays: this one may see less on the far side.
    index, seen = index[unproven[index]], unproven[index]
    ground[index] = verdict.ground[seen]
    unproven[index] = verdict.unproven[seen]
    return cloud.n, index[unproven[index]] if cloud.known is not None else index[:0]


def widened(width: int, *, first: bool, most: int) -> int:
    """Return the buffer to try after one of `width` mm, at most `most`.

    Examples
    --------
    >>> widened(80_000, first=True, most=500_000), widened(200_000, first=False, most=500_000)
    (200000, 300000)
    """
    return min(round((FIRST_STEP if first else NEXT_STEPS) * max(width, NARROW)), most)


def quarters(part: Rect, width: int) -> list[Rect]:
    """Cut a part of a core in four; none when its buffer makes up so much of the cloud that this would not help.

    Examples
    --------
    >>> [p.metres() for p in quarters(Rect(0, 0, 4000, 4000), 1000)]
    [(0.0, 0.0, 2.0, 2.0), (0.0, 2.0, 2.0, 4.0), (2.0, 0.0, 4.0, 2.0), (2.0, 2.0, 4.0, 4.0)]
    >>> quarters(Rect(0, 0, 5, 4), 20)
    []
    """
    if 2 * max(part.width, part.height) < width or min(part.width, part.height) < 2:
        return []
    x, y = part.x0 + part.width // 2, part.y0 + part.height // 2
    return [
        Rect(part.x0, part.y0, x, y),
        Rect(part.x0, y, x, part.y1),
        Rect(x, part.y0, part.x1, y),
        Rect(x, y, part.x1, part.y1),
    ]


def cover(x: Int64, y: Int64, width: int) -> list[Rect]:
    """Cover points by rectangles that, each with `width` around it, have a small area in sum.

    Parameters
    ----------
    x, y : ndarray of int64, shape (n,)
        At least one point, mm.
    width : int
        The buffer each rectangle gets, mm; more than 0.

    Returns
    -------
    list of Rect
        Each point lies in exactly one.

    Examples
    --------
    >>> cover(np.array([0, 5, 900]), np.array([0, 5, 0]), 10)
    [Rect(x0=0, y0=0, x1=6, y1=6), Rect(x0=900, y0=0, x1=901, y1=1)]
    >>> cover(np.array([0, 5, 900]), np.array([0, 5, 0]), 1000)
    [Rect(x0=0, y0=0, x1=901, y1=6)]
    """
    box = Rect(int(x.min()), int(y.min()), int(x.max()) + 1, int(y.max()) + 1)
    whole = _area(box, width)
    wide = box.width >= box.height
    if whole <= 2 * (2 * width) ** 2 or max(box.width, box.height) == 1:
        return [box]
    along, middle = (x, (box.x0 + box.x1) // 2) if wide else (y, (box.y0 + box.y1) // 2)
    first = along < middle
    parts = cover(x[first], y[first], width) + cover(x[~first], y[~first], width)
    return parts if sum(_area(p, width) for p in parts) < whole else [box]


def _area(rect: Rect, width: int) -> int:
    return (rect.width + 2 * width) * (rect.height + 2 * width)
