"""Processor time of repeated, interleaved work, and of the stages inside PPDF."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from statistics import median
from typing import Any
from unittest.mock import patch

from ppdf_dask.errors import PpdfError
from ppdf_dask.params import Parameters

_ROBUST = "ppdf_dask.filters.ppdf.robust"
_PAPER = "ppdf_dask.filters.ppdf.paper"

STAGES: dict[str, dict[str, str]] = {
    "RobustParams": {
        f"{_ROBUST}.cells:build": "lowest points",
        f"{_ROBUST}.cells:drop_low_outliers": "low outliers",
        f"{_ROBUST}.classify:find_planes": "planes",
        f"{_ROBUST}.classify:link_patches": "patches",
        f"{_ROBUST}.classify:judge_components": "patches",
        f"{_ROBUST}.classify:spread_roofs": "patches",
        f"{_ROBUST}.classify:grow": "growth",
        f"{_ROBUST}.classify:clean": "cleaning",
        f"{_ROBUST}.classify:local_roughness": "roughness",
        f"{_ROBUST}.classify:halve": "halved cells",
        f"{_ROBUST}.classify:label": "labels",
    },
    "PaperParams": {
        f"{_PAPER}.classify:sort_by_square": "sorting",
        f"{_PAPER}.classify:under_canopy": "under canopy",
        f"{_PAPER}.classify:plane_seeds": "planes and seeds",
        f"{_PAPER}.classify:lowest_seeds": "planes and seeds",
        f"{_PAPER}.classify:grow": "growth",
    },
}
"""Kind of parameters to the functions that are stages of their filter; they are not nested in each other."""


KEEP_NOTHING = {"MALLOC_MMAP_THRESHOLD_": "131072", "MALLOC_TRIM_THRESHOLD_": "131072"}
"""Tells glibc to give freed arrays back at once, so that the resident size is what is held."""


@dataclass(frozen=True)
class Timing:
    """Seconds of several repetitions.

    Attributes
    ----------
    cpu : tuple of float
        Processor time, user and system, child processes included: what one core would take.
    wall : tuple of float
        Elapsed time.
    """

    cpu: tuple[float, ...]
    wall: tuple[float, ...]

    @property
    def seconds(self) -> float:
        """Median processor time."""
        return median(self.cpu)

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {"cpu_s": self.seconds, "wall_s": median(self.wall), "cpu_all_s": list(self.cpu)}


def processor_time() -> float:
    """Return the seconds of processor time used so far, finished child processes included."""
    t = os.times()
    return time.process_time() + t.children_user + t.children_system


def interleaved(work: Mapping[str, Callable[[], object]], repeat: int) -> Iterator[tuple[str, float, float]]:
    """Run every piece of work once, then every piece again, `repeat` times.

    Neighbouring measurements see the same load of the machine, so that their ratios mean something even where the
    seconds do not.

    Parameters
    ----------
    work : mapping of str to callable
        Name to work.
    repeat : int
        Rounds.

    Yields
    ------
    tuple of (str, float, float)
        Name, processor seconds, elapsed seconds.

    Examples
    --------
    >>> [name for name, _, _ in interleaved({"a": int, "b": float}, 2)]
    ['a', 'b', 'a', 'b']
    """
    for _ in range(repeat):
        for name, function in work.items():
            cpu, wall = processor_time(), time.perf_counter()
            function()
            yield name, processor_time() - cpu, time.perf_counter() - wall


def timings(measured: list[tuple[str, float, float]]) -> dict[str, Timing]:
    """Collect what `interleaved` yielded by name."""
    return {
        name: Timing(tuple(c for n, c, _ in measured if n == name), tuple(w for n, _, w in measured if n == name))
        for name in dict.fromkeys(n for n, _, _ in measured)
    }


@dataclass
class Recorder:
    """What the stages of a filter took.

    Attributes
    ----------
    seconds : dict of str to float
        Processor time by stage, summed over its calls.
    peak : dict of str to int
        Most memory held during the stage beyond what was held at the start, bytes; empty without `memory`.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    peak: dict[str, int] = field(default_factory=dict)


@contextmanager
def recorded(params: Parameters, *, memory: bool = False) -> Iterator[Recorder]:
    """Time the stages of a filter by putting a clock around its functions; outside of this nothing is slowed down.

    Parameters
    ----------
    params : Parameters
        Tells which filter; one without an entry in `STAGES` has no stages.
    memory : bool
        Also trace memory, which makes NumPy slower; default False. Memory that compiled code holds for itself is not
        seen.

    Yields
    ------
    Recorder
        Filled while the filter runs. Not for several threads at a time.
    """
    record = Recorder()
    with ExitStack() as stack:
        if memory:
            tracemalloc.start()
            stack.callback(tracemalloc.stop)
        base = tracemalloc.get_traced_memory()[0] if memory else 0
        for target, stage in STAGES.get(type(params).__name__, {}).items():
            module, name = target.split(":")
            holder = import_module(module)
            clocked = _clocked(getattr(holder, name), stage, record, base if memory else None)
            stack.enter_context(patch.object(holder, name, clocked))
        yield record


def _clocked(function: Callable[..., Any], stage: str, record: Recorder, base: int | None) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        if base is not None:
            tracemalloc.reset_peak()
        start = time.process_time()
        try:
            return function(*args, **kwargs)
        finally:
            record.seconds[stage] = record.seconds.get(stage, 0.0) + time.process_time() - start
            if base is not None:
                held = tracemalloc.get_traced_memory()[1] - base
                record.peak[stage] = max(record.peak.get(stage, 0), held)

    return call


def child(asked: dict[str, Any], environment: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Ask `ppdf_dask.experiments._filter_child` in a new process.

    Raises
    ------
    PpdfError
        When the process fails; the message holds what it said last.
    """
    command = [sys.executable, "-m", "ppdf_dask.experiments._filter_child"]
    done = subprocess.run(
        command,
        input=json.dumps(asked),
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | KEEP_NOTHING | dict(environment or {}),
    )
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise PpdfError(f"measuring {asked['filter']} in a process of its own failed: {last}")
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer
