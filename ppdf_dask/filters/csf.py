"""CSF: the cloth simulation filter, through its authors' library.

Zhang, Qi, Wan, Wang, Xie, Wang and Yan, "An easy-to-use airborne LiDAR data filtering method based on cloth
simulation", Remote Sensing 8 (2016), 501. The library prints to the standard output from C++, starts threads as it
likes and holds Python's lock for minutes; it therefore runs in a process of its own, on one thread.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ppdf_dask.errors import ParameterError, PpdfError
from ppdf_dask.filters import Filter
from ppdf_dask.filters.cloud import Bools, Cloud, Density, Verdict
from ppdf_dask.filters.islands import by_island
from ppdf_dask.filters.raster import check_cells
from ppdf_dask.grid import MM
from ppdf_dask.params import Parameters, quantity

MAX_PARTICLES = 4_000_000
"""Most particles of one cloth, 2 km x 2 km at 1 m: the library takes about 1 kB for each (measured), so 4 GB."""

CHILD = Path(__file__).with_name("_csf_child.py")


@dataclass(frozen=True, kw_only=True)
class CsfParams(Parameters):
    """Parameters of the cloth simulation filter.

    The defaults are the library's; ``paper`` is Table 2 of the PPDF paper.

    Parameters
    ----------
    resolution : float
        Distance of the cloth's particles; not below the point spacing.
    rigidness : int
        1 for steep slopes, 2 for relief, 3 for flat land.
    threshold : float
        Height above or below the cloth within which a point is ground.
    iterations : int
        Most steps of the simulation.
    time_step : float
        Length of a step; the library's unit.
    slope_smooth : bool
        Let the cloth down onto steep slopes that it spans.
    """

    resolution: float = quantity(1.0, "m", low=0.05, high=100.0, doc="distance of the cloth's particles")
    rigidness: int = quantity(3, "1", low=1, high=3, doc="1 steep slopes, 2 relief, 3 flat land")
    threshold: float = quantity(0.5, "m", low=0.001, high=100.0, doc="distance to the cloth")
    iterations: int = quantity(500, "steps", low=1, high=100_000, doc="most steps of the simulation")
    time_step: float = quantity(0.65, "1", low=0.01, high=10.0, doc="length of a step")
    slope_smooth: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("rigidness", "iterations"):
            if not isinstance(getattr(self, name), int):
                raise ParameterError(f"{name} = {getattr(self, name)!r} is not a whole number")


PAPER = CsfParams(resolution=0.3, rigidness=3, threshold=0.5, iterations=500, slope_smooth=False)
"""Table 2 of the PPDF paper, which ran a program where smoothing is off unless asked for."""

PAPER_SMOOTH = PAPER.replace(slope_smooth=True)
"""Table 2 with slope smoothing."""


def classify(cloud: Cloud, params: Parameters) -> Verdict:
    """Classify a cloud with the cloth simulation filter.

    Parameters
    ----------
    cloud : Cloud
        Eligible points; all of them carry the cloth, the core points are classified.
    params : CsfParams
        The parameters.

    Returns
    -------
    Verdict
        Ground where the point is closer than the threshold to the cloth; unproven is all False, CSF does not prove its
        answers. The cloth hangs at the cloud's corner, so that the answer depends on where the cloud is cut.

    Raises
    ------
    ParameterError
        When the cloth would exceed its limit.
    PpdfError
        When the package ``cloth-simulation-filter`` is missing, or its process fails.
    """
    assert isinstance(params, CsfParams)
    if cloud.n_core and importlib.util.find_spec("CSF") is None:
        raise PpdfError(
            "the filter csf needs the package cloth-simulation-filter; install it with: pip install 'ppdf-dask[csf]'"
        )
    return by_island(cloud, required_buffer(params), lambda island: _label(island, params))


def required_buffer(params: Parameters) -> float:
    """Return 50 m, at least 50 particles. The cloth has no bound: it hangs at the corner of what is loaded.

    With 50 m, 2.2 % of the points within 25 m of the seams of a sparse tile cut into 250 m chunks had two answers.
    """
    assert isinstance(params, CsfParams)
    return max(50.0, 50.0 * params.resolution)


def _label(cloud: Cloud, params: CsfParams) -> Bools:
    # The cloth takes the first of equally near points, so that their order must not be the caller's.
    order = np.lexsort((cloud.z, cloud.y, cloud.x))
    xyz = np.empty((cloud.n, 3))
    for axis, values in enumerate((cloud.x, cloud.y, cloud.z)):
        np.divide(values[order].astype(np.int64) - int(values.min()), MM, out=xyz[:, axis])
    wide, high = (math.floor(v.max() / params.resolution) + 4 for v in (xyz[:, 0], xyz[:, 1]))
    check_cells(wide, high, params.resolution, MAX_PARTICLES)
    ground = np.empty(cloud.n, np.bool_)
    ground[order] = _simulate(xyz, params)
    return ground[: cloud.n_core]


def _simulate(xyz: np.ndarray[tuple[int, int], np.dtype[np.float64]], params: CsfParams) -> Bools:
    settings = {
        "cloth_resolution": float(params.resolution),
        "rigidness": params.rigidness,
        "class_threshold": float(params.threshold),
        "interations": params.iterations,
        "time_step": float(params.time_step),
        "bSloopSmooth": params.slope_smooth,
    }
    done = subprocess.run(
        [sys.executable, "-P", str(CHILD)],
        input=json.dumps(settings).encode() + b"\n" + xyz.tobytes(),
        capture_output=True,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
        check=False,
    )
    if done.returncode != 0 or len(done.stdout) != len(xyz):
        last = (done.stderr.decode(errors="replace").strip().splitlines() or ["no message"])[-1]
        raise PpdfError(
            f"the cloth simulation of {len(xyz)} points ended with code {done.returncode} ({last}); "
            "with too little memory, use smaller chunks (--chunk-size) or a larger resolution"
        )
    return np.asarray(np.frombuffer(done.stdout, np.uint8) != 0)


def _keep(params: Parameters, _: Density) -> Parameters:
    return params


FILTER = Filter(
    name="csf",
    profiles={"default": CsfParams(), "paper": PAPER, "paper-smooth": PAPER_SMOOTH},
    classify=classify,
    required_buffer=required_buffer,
    exact=False,
    resolve=_keep,
    bytes_per_point=1500.0,
)
