"""What exact seams cost: the proof bit inside the filter, the buffers around chunks, and clouds classified again."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ppdf_dask.errors import PpdfError
from ppdf_dask.experiments.clock import KEEP_NOTHING
from ppdf_dask.params import ChunkParams, RunParams
from ppdf_dask.survey import Survey, scan

Tick = Callable[[str], None]


@dataclass(frozen=True)
class Bit:
    """The filter on one whole file with and without its proof bit.

    Attributes
    ----------
    points : int
        Eligible points.
    with_bit, without : tuple of float
        Processor seconds of each round; rounds of the two alternate.
    """

    points: int
    with_bit: tuple[float, ...]
    without: tuple[float, ...]

    @property
    def cost(self) -> float:
        """Share that the bit adds: the median over the rounds of their ratios, less 1."""
        return statistics.median(a / b for a, b in zip(self.with_bit, self.without, strict=True)) - 1


@dataclass(frozen=True)
class Cut:
    """A survey classified in chunks of one size.

    Attributes
    ----------
    chunk_m, buffer_m, widest_m : float
        Edge of the chunks; first guess of the buffer, and the widest one that was needed.
    chunks, points : int
        Chunks and eligible points.
    first, again : int
        Points classified with the first buffer, cores among them, and with wider ones.
    filter_seconds, tile_seconds : float
        Processor time of all classify tasks, reading and writing included, and of cutting the tiles.
    unproven : int
        Points without a proof at the end.
    """

    chunk_m: float
    buffer_m: float
    widest_m: float
    chunks: int
    points: int
    first: int
    again: int
    filter_seconds: float
    tile_seconds: float
    unproven: int


@dataclass(frozen=True)
class Proof:
    """All that was measured."""

    bit: Bit
    cuts: tuple[Cut, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {**asdict(self), "bit_cost": self.bit.cost}

    def markdown(self) -> str:
        """Return a sentence and a table."""
        bit = self.bit
        seconds = [f"{statistics.median(rounds):.2f} s" for rounds in (bit.with_bit, bit.without)]
        lines = [
            f"The proof bit: {seconds[0]} with, {seconds[1]} without it on {bit.points:,} points ({bit.cost:+.1%})",
            "",
            "| chunks | points | first buffer m | widest m | buffers | re-runs | us/point | unproven |",
            "|---:" * 8 + "|",
        ]
        lines += [
            f"| {c.chunks} of {c.chunk_m:g} m | {c.points:,} | {c.buffer_m:g} | {c.widest_m:g} | "
            f"{(c.first - c.points) / c.points:+.1%} | {c.again / c.points:+.1%} | "
            f"{c.filter_seconds / c.points * 1e6:.2f} | {c.unproven} |"
            for c in self.cuts
        ]
        return "\n".join([*lines, "", "Buffers and re-runs: points classified beyond the cores, in per cent of those."])


def measure(tiles: list[Path], sizes: list[float | None], profile: str, rounds: int, tick: Tick) -> Proof:
    """Measure the bit on the first tile, and the whole survey cut in chunks of several sizes.

    Parameters
    ----------
    tiles : list of Path
        The survey.
    sizes : list of float or None
        Edges of the chunks, m; None: the planner's choice.
    profile : str
        ``"robust"`` or ``"paper"``.
    rounds : int
        How often the filter is timed with and without the bit.
    tick : callable
        Called when a part is done.
    """
    from ppdf_dask import filters

    survey = scan([str(t) for t in tiles])
    params = RunParams(filter=filters.parameters("ppdf", profile))
    bit = bit_cost(survey, params, profile, rounds)
    tick("bit")
    cuts = []
    for size in sizes:
        cuts.append(cut_and_classify(survey, params.replace(chunks=ChunkParams(chunk_size=size))))
        tick(f"chunks of {cuts[-1].chunk_m:g} m")
    return Proof(bit, tuple(cuts))


def bit_cost(survey: Survey, params: RunParams, profile: str, rounds: int) -> Bit:
    """Time the filter on the first tile with and without the bit, round by round in turn.

    Raises
    ------
    PpdfError
        When the two masks differ: then it was not the bit that was left out.
    """
    from ppdf_dask.grid import ChunkGrid
    from ppdf_dask.tiler import TileJob

    tile = survey.tiles[0]
    job = TileJob("s_000000", tile, survey.unit_xy, survey.unit_z, params, ChunkGrid.from_metres(1000.0), 0)
    xyz = np.concatenate([np.stack([b.x, b.y, b.z])[:, b.eligible] for b in job.batches()], axis=1)
    origin = xyz.min(axis=1) * (1, 1, 0)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        np.save(Path(folder) / "points.npy", (xyz - origin[:, None]).astype(np.int32))
        asked = {
            "profile": profile,
            "params": params.filter.as_dict(),
            "points": str(Path(folder) / "points.npy"),
            "origin": [int(v) for v in origin[:2]],
        }
        # Without the bit other machine code is made, which must not be kept where that of the filter is.
        children = [
            stack.enter_context(_Child(asked | {"bit": bit}, str(Path(folder) / name)))
            for bit, name in ((True, "with"), (False, "without"))
        ]
        masks = {child.line() for child in children}
        if len(masks) != 1:
            raise PpdfError("the filter's answer on a whole tile depends on the proof bit; report this")
        found = [[float(child.ask()) for child in children] for _ in range(rounds)]
    return Bit(xyz.shape[1], tuple(a for a, _ in found), tuple(b for _, b in found))


class _Child:
    """A process that times the filter whenever it is asked."""

    def __init__(self, asked: dict[str, Any], cache: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "ppdf_dask.experiments._proof_child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | KEEP_NOTHING | {"NUMBA_CACHE_DIR": cache},
        )
        self._say(json.dumps(asked))

    def __enter__(self) -> _Child:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def _say(self, text: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(text + "\n")
        self._process.stdin.flush()

    def line(self) -> str:
        """Return the next answer."""
        assert self._process.stdout is not None
        found = self._process.stdout.readline()
        if not found:
            raise PpdfError("measuring the proof bit in a process of its own failed; see above")
        return found

    def ask(self) -> str:
        """Ask for one more run."""
        self._say("")
        return self.line()


def cut_and_classify(survey: Survey, params: RunParams) -> Cut:
    """Cut a survey and classify all its chunks, one after the other in this process."""
    from ppdf_dask import tasks
    from ppdf_dask.plan import plan
    from ppdf_dask.stages import Cutting, Inputs
    from ppdf_dask.store import RunStore

    with tempfile.TemporaryDirectory() as folder:
        made = plan(survey, params, out=folder)
        store, inputs = RunStore(str(Path(folder) / "run.zarr")), Inputs(made)
        store.create({})
        tiles = {w.ident: tasks.tile(store.url, w.job, w.fingerprint) for w in inputs.tile_works()}
        cutting = Cutting(inputs, store, tiles)
        cutting.index.publish(store)
        found = [tasks.classify(store.url, w.job, w.fingerprint) for w in cutting.classify_works()]
    first = sum(r["loaded_first"] for r in found)
    return Cut(
        chunk_m=made.grid.size / 1000,
        buffer_m=made.buffer / 1000,
        widest_m=max(r["buffer_m"] for r in found),
        chunks=len(found),
        points=sum(r["points"] for r in found),
        first=first,
        again=sum(r["loaded"] for r in found) - first,
        filter_seconds=round(sum(r["cpu_seconds"] for r in found), 2),
        tile_seconds=round(sum(r["cpu_seconds"] for r in tiles.values()), 2),
        unproven=sum(r["unproven"] for r in found),
    )
