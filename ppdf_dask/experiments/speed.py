"""Speed against what every program does with a file: decode it, copy it. One core, kernels warm, within one run."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from ppdf_dask import filters
from ppdf_dask.experiments.clock import Recorder, Timing, child, interleaved, recorded, timings
from ppdf_dask.experiments.labelled import read
from ppdf_dask.experiments.tables import markdown, number
from ppdf_dask.filters.cloud import Cloud, density
from ppdf_dask.params import Parameters, RunParams

DECODE, COPY = "decode", "copy"
"""Names of the yardsticks: laspy and lazrs read the file, and read and write it, on one thread."""


@dataclass(frozen=True)
class Choice:
    """A filter's profile to measure.

    Attributes
    ----------
    filter, profile : str
        As registered.
    params : Parameters
        The profile's, perhaps changed.
    """

    filter: str
    profile: str
    params: Parameters

    @property
    def name(self) -> str:
        """The filter's and the profile's name."""
        return f"{self.filter}:{self.profile}"

    @classmethod
    def of(cls, name: str) -> list[Choice]:
        """Return the choices behind ``NAME``, ``NAME:PROFILE`` or ``all`` (every registered filter's first profile).

        Examples
        --------
        >>> [choice.name for choice in Choice.of("ppdf:robust")]
        ['ppdf:robust']
        """
        if name == "all":
            return [choice for each in filters.names() for choice in cls.of(each)]
        filter_name, _, profile = name.partition(":")
        params = filters.parameters(filter_name, profile or None)
        return [cls(filter_name, profile or next(iter(filters.get(filter_name).profiles)), params)]


@dataclass(frozen=True)
class Stage:
    """One step of a filter.

    Attributes
    ----------
    name : str
        What it does; "other" is everything around the steps.
    seconds : float
        Median processor time.
    share : float
        Of the filter's time.
    bytes_per_point : float
        Most memory held in the meantime, points themselves not counted, per offered point; NaN where not traced.
    """

    name: str
    seconds: float
    share: float
    bytes_per_point: float


@dataclass(frozen=True)
class FilterSpeed:
    """One filter on one file.

    Attributes
    ----------
    choice : Choice
        What was measured.
    offered : int
        Points the filter saw.
    alone : Timing
        The filter on points in memory.
    classify : Timing
        The whole of ``ppdf-dask classify`` but start-up and imports: scan, decode, filter, write, verify.
    stages : tuple of Stage
        Steps of the filter, if known.
    bytes_per_point : float or None
        Growth of the resident size of a process that runs the filter, per offered point; None where not measured.
    """

    choice: Choice
    offered: int
    alone: Timing
    classify: Timing
    stages: tuple[Stage, ...]
    bytes_per_point: float | None


@dataclass(frozen=True)
class FileSpeed:
    """All measurements on one file.

    Attributes
    ----------
    name : str
        The file's name.
    points : int
        In the file.
    density : float
        Usable points per m2 of occupied 5 m cells.
    decode, copy : Timing
        laspy with lazrs, one thread.
    filters : tuple of FilterSpeed
        One per choice.
    """

    name: str
    points: int
    density: float
    decode: Timing
    copy: Timing
    filters: tuple[FilterSpeed, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        rows = [
            {
                "filter": f.choice.name,
                "offered": f.offered,
                "alone": f.alone.as_dict(),
                "classify": f.classify.as_dict(),
                "points_per_s": self.points / f.alone.seconds,
                "decode_over_filter": self.decode.seconds / f.alone.seconds,
                "classify_over_copy": f.classify.seconds / self.copy.seconds,
                "classify_us_per_point": 1e6 * f.classify.seconds / self.points,
                "bytes_per_point": f.bytes_per_point,
                "stages": [
                    {
                        "name": s.name,
                        "cpu_s": s.seconds,
                        "share": s.share,
                        "points_per_s": f.offered / s.seconds if s.seconds > 0 else None,
                        "bytes_per_point": None if np.isnan(s.bytes_per_point) else s.bytes_per_point,
                    }
                    for s in f.stages
                ],
            }
            for f in self.filters
        ]
        return {
            "file": self.name,
            "points": self.points,
            "density": self.density,
            DECODE: self.decode.as_dict(),
            COPY: self.copy.as_dict() | {"us_per_point": 1e6 * self.copy.seconds / self.points},
            "filters": rows,
        }


@dataclass(frozen=True)
class FirstCall:
    """What a filter's first call in a process takes, seconds.

    Attributes
    ----------
    imports : float
        Loading its modules, numba's among them.
    cold, warm : float
        Classifying a small cloud, with an empty and with a filled cache of kernels.
    """

    imports: float
    cold: float
    warm: float


@dataclass(frozen=True)
class SpeedTable:
    """All measurements of one run.

    Attributes
    ----------
    files : tuple of FileSpeed
        One per file.
    compilation : dict of str to FirstCall
        By filter.
    """

    files: tuple[FileSpeed, ...]
    compilation: dict[str, FirstCall] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {
            "cpus": os.cpu_count(),
            "files": [f.as_dict() for f in self.files],
            "first_call_s": {k: asdict(v) for k, v in self.compilation.items()},
        }

    def markdown(self) -> str:
        """Return two tables per file: ratios, and the filters' stages; compilation where it was measured."""
        parts = [text for f in self.files for text in (_ratios(f), *_stages(f))]
        if self.compilation:
            rows = [[k, number(v.imports), number(v.cold), number(v.warm)] for k, v in self.compilation.items()]
            parts.append(markdown(["first call on a small cloud", "imports s", "cold cache s", "warm cache s"], rows))
        return "\n\n".join(parts)


def _ratios(found: FileSpeed) -> str:
    def row(name: str, timing: Timing, memory: float | None = None) -> list[str]:
        return [
            name,
            number(timing.seconds, 3),
            number(found.points / timing.seconds / 1e6),
            number(timing.seconds / found.decode.seconds),
            number(timing.seconds / found.copy.seconds),
            "" if memory is None else f"{memory:.0f}",
        ]

    head = [f"{found.name}: {found.points:,} points, {found.density:.2f}/m2", "CPU s", "Mpts/s"]
    rows = [row("decode (laspy, lazrs)", found.decode), row("copy (laspy, lazrs)", found.copy)]
    for f in found.filters:
        rows.append(row(f"{f.choice.name} alone", f.alone, f.bytes_per_point))
        rows.append(row(f"{f.choice.name} classify, LAZ to LAZ", f.classify))
    return markdown([*head, "over decode", "over copy", "peak B/point"], rows)


def _stages(found: FileSpeed) -> Iterator[str]:
    for f in found.filters:
        rows = [
            [
                s.name,
                number(1e3 * s.seconds, 1),
                number(100 * s.share, 1),
                number(f.offered / s.seconds / 1e6 if s.seconds > 0 else float("nan"), 1),
                number(s.bytes_per_point, 0),
            ]
            for s in f.stages
        ]
        if rows:
            head = [f"{found.name}: {f.choice.name}, {f.offered:,} offered", "CPU ms", "share %", "Mpts/s"]
            yield markdown([*head, "held B/point"], rows)


def measure(
    path: str | Path,
    choices: list[Choice],
    *,
    repeat: int = 3,
    memory: bool = True,
    tick: Callable[[str], None] = lambda name: None,
) -> FileSpeed:
    """Measure everything on one file.

    Parameters
    ----------
    path : str or Path
        LAS or LAZ.
    choices : list of Choice
        Filters to measure.
    repeat : int
        Rounds over all measurements; medians are reported. Default 3.
    memory : bool
        Measure peak memory in a process of its own; default True.
    tick : callable
        Told the name of each piece of work when it is done; there are ``1 + (2 + 2 * len(choices)) * repeat +
        len(choices)`` of them.

    Returns
    -------
    FileSpeed
    """
    labelled = read(path)
    clouds = {c.name: labelled.cloud(labelled.seen(c.params)) for c in choices}
    resolved = {c.name: filters.of(c.params).resolve(c.params, density(clouds[c.name])) for c in choices}
    tick("read")
    records: dict[str, list[Recorder]] = {c.name: [] for c in choices}
    held: dict[str, tuple[dict[str, int], float | None]] = {}
    with tempfile.TemporaryDirectory() as folder:
        work: dict[str, Callable[[], object]] = {
            DECODE: partial(_decode, path),
            COPY: partial(_copy, path, Path(folder, "copy.laz")),
        }
        for c in choices:
            alone = partial(_alone, c, clouds[c.name], resolved[c.name], records[c.name])
            work[f"{c.name} alone"] = alone
            work[f"{c.name} classify"] = partial(_classify, path, Path(folder, "classified.laz"), c.params)
            held[c.name] = _warm_up(c, clouds[c.name], resolved[c.name], memory, folder)
            tick(c.name)
        measured = []
        for step in interleaved(work, repeat):
            measured.append(step)
            tick(step[0])
    times = timings(measured)
    rows = []
    for c in choices:
        seen, alone_time = clouds[c.name].n, times[f"{c.name} alone"]
        peak, resident = held[c.name]
        stages = _summary(records[c.name], peak, seen)
        rows.append(
            FilterSpeed(
                c, seen, alone_time, times[f"{c.name} classify"], stages, None if resident is None else resident / seen
            )
        )
    per_m2 = density(labelled.cloud(labelled.usable)).per_m2
    return FileSpeed(Path(path).name, labelled.n, per_m2, times[DECODE], times[COPY], tuple(rows))


def _warm_up(
    choice: Choice, cloud: Cloud, params: Parameters, memory: bool, folder: str
) -> tuple[dict[str, int], float | None]:
    """Load the kernels with an unmeasured run; then trace the stages' memory, and the whole's in a new process."""
    filters.of(params).classify(cloud, params)
    if not memory:
        return {}, None
    with recorded(params, memory=True) as record:
        filters.of(params).classify(cloud, params)
    points = Path(folder, "points.npy")
    np.save(points, np.stack([cloud.x, cloud.y, cloud.z]))
    asked = {"points": str(points), "origin": cloud.origin, "params": params.as_dict()}
    answer = child({"filter": choice.filter, "profile": choice.profile, **asked})
    return record.peak, answer["bytes"]


def _alone(choice: Choice, cloud: Cloud, params: Parameters, records: list[Recorder]) -> None:
    with recorded(params) as record:
        filters.of(params).classify(cloud, params)
    records.append(record)


def _decode(path: str | Path) -> None:
    import laspy

    laspy.read(path, laz_backend=laspy.LazBackend.Lazrs)


def _copy(path: str | Path, target: Path) -> None:
    import laspy

    laspy.read(path, laz_backend=laspy.LazBackend.Lazrs).write(
        target, do_compress=True, laz_backend=laspy.LazBackend.Lazrs
    )


def _classify(path: str | Path, target: Path, params: Parameters) -> None:
    from ppdf_dask.single import classify_tile
    from ppdf_dask.survey import scan

    classify_tile(scan([path]), target, RunParams(filter=params))


def _summary(records: list[Recorder], peak: Mapping[str, int], offered: int) -> tuple[Stage, ...]:
    """Return the stages' medians; shares are of their sum."""
    names = list(dict.fromkeys(name for r in records for name in r.seconds))
    seconds = {name: median(r.seconds.get(name, 0.0) for r in records) for name in names}
    whole = sum(seconds.values())
    return tuple(
        Stage(name, s, s / whole if whole else 0.0, peak[name] / offered if name in peak else float("nan"))
        for name, s in seconds.items()
    )


def compilation(choice: Choice) -> FirstCall:
    """Measure a filter's first call on a small cloud, with an empty and with a filled kernel cache."""
    asked = {"filter": choice.filter, "profile": choice.profile, "params": choice.params.as_dict(), "points": None}
    with tempfile.TemporaryDirectory() as folder:
        cold, warm = (child(asked, {"NUMBA_CACHE_DIR": folder}) for _ in range(2))
    return FirstCall(warm["imports"], cold["first"], warm["first"])


def synthetic_files(folder: Path) -> list[Path]:
    """Write a dense and a sparse synthetic tile to measure on: 200 m at 15, 1000 m at 0.4 points/m2."""
    from ppdf_dask.synthetic import SyntheticParams, write_survey

    made = []
    for name, size, pulses in (("dense", 200, 9.0), ("sparse", 1000, 0.25)):
        (tile,) = write_survey(
            folder / name, SyntheticParams(density=pulses), extent=(0, 0, size, size), tile_size=size, truth=False
        )
        made.append(tile.rename(folder / f"{name}.laz"))
    return made
