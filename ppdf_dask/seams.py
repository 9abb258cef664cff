"""How far neighbouring chunks disagree where both have an answer: the price of cutting a survey, for any filter.

Each chunk answers once more, for its core and half of its buffer around it, from just the points within its buffer. Two
neighbours then both have an answer for the strip along the edge between them. Where a filter's answer depends on what
else was loaded, the two differ; PPDF widens its buffer until its answer is proven, so that they cannot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ppdf_dask import filters
from ppdf_dask.dropped import are_dropped
from ppdf_dask.errors import StoreError
from ppdf_dask.filters.cloud import Cloud
from ppdf_dask.grid import MM, Chunk, Rect
from ppdf_dask.index import fragments
from ppdf_dask.neighbourhood import crop, inside, join, overlap
from ppdf_dask.saved import load_plan, refuse_other_code
from ppdf_dask.solve import ClassifyJob, widened
from ppdf_dask.stages import Cutting, Inputs
from ppdf_dask.store import RunStore

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Labels = npt.NDArray[np.int64]
Tick = Callable[[str], None]


@dataclass(frozen=True)
class Seam:
    """The strip along the edge between two chunks.

    Attributes
    ----------
    a, b : str
        Chunk ids; `b` lies east or north of `a`.
    x0, y0, x1, y1 : float
        The edge, metres.
    points, differ : int
        Points both have an answer for; those with two answers.
    """

    a: str
    b: str
    x0: float
    y0: float
    x1: float
    y1: float
    points: int
    differ: int


@dataclass(frozen=True)
class Seams:
    """All seams of a run.

    Attributes
    ----------
    filter : str
        Name of the filter.
    exact : bool
        Whether it proves its answers.
    buffer_m, strip_m : float
        Buffer of the chunks, half width of the strips.
    unproven : int
        Answers in the strips that a filter which proves its own could not prove within ``--max-buffer``.
    seams : tuple of Seam
        By chunk ids.
    """

    filter: str
    exact: bool
    buffer_m: float
    strip_m: float
    unproven: int
    seams: tuple[Seam, ...]

    @property
    def points(self) -> int:
        """Points of all strips."""
        return sum(s.points for s in self.seams)

    @property
    def differ(self) -> int:
        """Points with two answers."""
        return sum(s.differ for s in self.seams)

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        total = {"points": self.points, "differ": self.differ}
        return {**vars(self), **total, "seams": [vars(s) for s in self.seams]}

    def markdown(self) -> str:
        """Return a table of the sum and the ten worst seams."""
        share = self.differ / max(self.points, 1)
        lines = [
            f"{self.filter}, buffer {self.buffer_m:g} m: {self.differ:,} of {self.points:,} points ({share:.4%}) "
            f"within {self.strip_m:g} m of {len(self.seams)} seams have two answers"
            + (f"; {self.unproven:,} answers are not proven" if self.unproven else "")
        ]
        worst = sorted((s for s in self.seams if s.differ), key=lambda s: (-s.differ, s.a, s.b))[:10]
        if worst:
            lines += ["", "| seam | points | differ | share |", "|---|---:|---:|---:|"]
            lines += [f"| {s.a} {s.b} | {s.points:,} | {s.differ:,} | {s.differ / s.points:.3%} |" for s in worst]
        return "\n".join(lines)

    def figure(self) -> Figure:
        """Draw a map: each seam coloured by the share of its points that have two answers."""
        from matplotlib.collections import LineCollection
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6, 5), layout="constrained")
        axes = figure.subplots()
        lines = LineCollection(
            [((s.x0, s.y0), (s.x1, s.y1)) for s in self.seams],
            array=np.array([100 * s.differ / max(s.points, 1) for s in self.seams]),
            cmap="viridis_r",
            linewidths=4,
            capstyle="butt",
        )
        lines.set_clim(0, max(0.001, *(100 * s.differ / max(s.points, 1) for s in self.seams), 0.0))
        axes.add_collection(lines)
        axes.autoscale()
        axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
        axes.ticklabel_format(useOffset=False, style="plain")
        axes.tick_params(axis="x", rotation=30)
        share = self.differ / max(self.points, 1)
        # Above the colour bar too: the map itself may be narrower than the title.
        figure.suptitle(f"{self.filter}, buffer {self.buffer_m:g} m: {share:.3%} of the seams' points differ", size=11)
        figure.colorbar(lines, label="points with two answers (%)")
        return figure


def measure(run: str | Path, tick: Tick = lambda chunk: None) -> Seams:
    """Measure the seams of a run, one chunk after the other; needs neither scheduler nor source files.

    Parameters
    ----------
    run : str or Path
        Folder of a run whose chunks are classified and whose intermediate points are still there.
    tick : callable
        Called with each chunk's id when it is done.

    Raises
    ------
    StoreError
        When there is no run, other code made it, or its points are gone (``--drop-intermediate``).
    """
    store, plan = RunStore(str(Path(run) / "run.zarr")), load_plan(run)
    refuse_other_code(run)
    inputs = Inputs(plan)
    keys = inputs.tile_keys
    tiles = {s: r for s, r in store.records("tile") if s in keys and r["fingerprint"] == keys[s]}
    cutting = Cutting(inputs, store, tiles)
    ids = sorted(cutting.index.points)
    if are_dropped(store):
        raise StoreError(f"the points of {run} were dropped; run again without --drop-intermediate into another folder")
    chosen = filters.of(cutting.filter)
    band = cutting.buffer // 2
    strips: dict[tuple[str, str], Labels] = {}
    found: list[Seam] = []
    unproven = 0
    for ident in ids:
        job = cutting.classify_job(ident)
        labels, open_ = _answer(store, job, band)
        unproven += open_
        for a, b, edge in _edges(job.chunk, plan.grid.chunk):
            other = b if ident == a.id else a
            if other.id not in cutting.index.points:
                continue
            strip = _within(labels, edge.grow(band))
            if (a.id, b.id) not in strips:
                strips[a.id, b.id] = strip
                continue
            found.append(_compare(a, b, edge, strips.pop((a.id, b.id)), strip))
        tick(ident)
    seams = tuple(sorted(found, key=lambda s: (s.a, s.b)))
    return Seams(chosen.name, chosen.exact, cutting.buffer / MM, band / MM, unproven, seams)


def _answer(store: RunStore, job: ClassifyJob, band: int) -> tuple[Labels, int]:
    """Return absolute x, y, z and label of the points of the core and `band` mm around it, sorted; what is unproven."""
    chosen, width = filters.of(job.filter), job.buffer - band
    place = overlap(job.chunk.core.grow(band), job.cut.extent)
    while True:
        cloud = _load(store, job, place, width)
        verdict = chosen.classify(cloud, job.filter)
        if not verdict.unproven.any() or cloud.known is None or width >= job.max_buffer:
            break
        width = widened(width, first=width == job.buffer - band, most=job.max_buffer)
    n, home = cloud.n_core, job.chunk.core
    ground = verdict.ground if cloud.fixed is None else verdict.ground | cloud.fixed[:n]
    rows = np.array([cloud.x[:n], cloud.y[:n], cloud.z[:n], ground], np.int64)
    rows += np.array([[home.x0], [home.y0], [0], [0]])
    return rows[:, np.lexsort(rows[2::-1])], int(verdict.unproven.sum())


def _load(store: RunStore, job: ClassifyJob, place: Rect, width: int) -> Cloud:
    home, known = job.chunk.core, job.cut.known(place, width)
    points = join(
        [
            crop(piece, other.core, home, known)
            for other in job.cut.grid.over(overlap(known, job.cut.extent))
            for piece in fragments(store, other.id, "core").values()
        ]
    )
    asked = inside(points, home, place)
    points = np.concatenate([points[:, asked], points[:, ~asked]], axis=1)
    return Cloud(
        x=points[0],
        y=points[1],
        z=points[2],
        origin=(home.x0, home.y0),
        n_core=int(asked.sum()),
        known=None if known.contains(job.cut.extent) else known,
        fixed=points[3].astype(np.bool_) if len(points) > 3 else None,
    )


def _edges(chunk: Chunk, at: Callable[[int, int], Chunk]) -> Iterator[tuple[Chunk, Chunk, Rect]]:
    """Yield the pairs of neighbours a chunk belongs to, the western or southern one first, and the edge between."""
    for a, b in (
        (at(chunk.ix - 1, chunk.iy), chunk),
        (chunk, at(chunk.ix + 1, chunk.iy)),
        (at(chunk.ix, chunk.iy - 1), chunk),
        (chunk, at(chunk.ix, chunk.iy + 1)),
    ):
        yield a, b, overlap(a.core, b.core)


def _within(labels: Labels, place: Rect) -> Labels:
    x, y = labels[0], labels[1]
    return labels[:, (x >= place.x0) & (x < place.x1) & (y >= place.y0) & (y < place.y1)]


def _compare(a: Chunk, b: Chunk, edge: Rect, first: Labels, second: Labels) -> Seam:
    if not np.array_equal(first[:3], second[:3]):
        raise StoreError(f"chunks {a.id} and {b.id} hold different points; `ppdf-dask verify` says what is damaged")
    return Seam(a.id, b.id, *edge.metres(), first.shape[1], int((first[3] != second[3]).sum()))
