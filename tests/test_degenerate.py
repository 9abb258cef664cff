"""Degenerate clouds: every filter answers, the same for any order; PPDF's answers are those its documentation gives.

Work is counted in executed lines of the uncompiled kernels, not in seconds.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings

import numpy as np
import pytest

from ppdf_dask import filters
from ppdf_dask.errors import ParameterError
from ppdf_dask.filters import classify_ground
from ppdf_dask.filters.ppdf.paper.params import PaperParams
from ppdf_dask.filters.ppdf.robust.params import RobustParams

PROFILES = {"robust": RobustParams(), "paper": PaperParams()}
# pcom and voxel are for terrestrial scans, csf starts a process per call: their own tests hold their degenerate clouds.
FILTERS = ("msf", "pmf", "ptdf", "smrf")


def plane(size: float = 60.0, step: float = 0.8, slope: float = 0.1, seed: int = 0) -> np.ndarray:
    """A rough, tilted square."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0, size, step), np.arange(0, size, step)))
    rng = np.random.default_rng(seed)
    return np.column_stack([x, y, 100 + slope * x + rng.uniform(-0.03, 0.03, len(x))])


def tiny() -> dict[str, np.ndarray]:
    line = 0.75 * np.arange(40)
    return {
        "0 points": np.empty((0, 3)),
        "1 point": np.array([[5.0, 5.0, 5.0]]),
        "2 points": np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 50.0]]),
        "3 on a line": np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [2.0, 2.0, 0.0]]),
        "identical": np.tile([[123.456, 7.0, 8.0]], (500, 1)),
        "a column": np.column_stack([np.full(300, 5.0), np.full(300, 5.0), np.linspace(0, 90, 300)]),
        "a line": np.column_stack([line, 2 * line, line]),
    }


def shapes() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    base = plane()
    stretched = plane(30, 0.5, np.tan(np.radians(60.0)))
    cliff = base + np.column_stack([np.zeros((len(base), 2)), np.where(base[:, 0] > 30, 40.0, 0.0)])
    lake = base[np.hypot(base[:, 0] - 30, base[:, 1] - 30) > 15]
    noise = base[rng.choice(len(base), 40, replace=False)]
    noise[:, 2] += rng.choice([-1e6, 1e6], len(noise))
    dense = np.column_stack([rng.uniform(0, 6, (36_000, 2)), rng.uniform(-0.03, 0.03, 36_000)])
    return {
        "30 % duplicates": np.vstack([base, base[rng.random(len(base)) < 0.3]]),
        "60 degrees": stretched,
        "cliff": cliff,
        "lake": lake,
        "1000 points/m2": dense,
        "noise of 1000 km": np.vstack([base, noise]),
        "stray point 2000 km away": np.vstack([base, [[2_000_000.0, 5.0, 100.0]]]),
    }


def answer(xyz: np.ndarray, params: object) -> np.ndarray:
    with warnings.catch_warnings():
        # Filters may warn that a cloud is too sparse or too small for them: that is an answer, too.
        warnings.simplefilter("ignore")
        return classify_ground(xyz, params)


@pytest.mark.parametrize("name", tiny())
@pytest.mark.parametrize("profile", PROFILES)
def test_what_carries_no_plane_is_not_ground(name: str, profile: str) -> None:
    assert not answer(tiny()[name], PROFILES[profile]).any()


@pytest.mark.parametrize("name", tiny() | shapes())
@pytest.mark.parametrize("which", [*PROFILES, *FILTERS])
def test_an_answer_per_point_that_no_order_decides(name: str, which: str) -> None:
    xyz = (tiny() | shapes())[name]
    if name == "1000 points/m2" and which in FILTERS:
        xyz = xyz[(xyz[:, :2] < 3).all(axis=1)]
    params = PROFILES.get(which) or filters.parameters(which)
    found = answer(xyz, params)
    assert found.dtype == np.bool_
    assert found.shape == (len(xyz),)
    order = np.random.default_rng(2).permutation(len(xyz))
    assert np.array_equal(answer(xyz[order], params), found[order])
    # Exact duplicates get one label.
    _, place = np.unique(xyz, axis=0, return_inverse=True)
    place = place.reshape(-1)
    labels = np.zeros((place.max() + 1 if len(place) else 0, 2), bool)
    labels[place, found.astype(int)] = True
    assert not labels.all(axis=1).any()


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("name", ["30 % duplicates", "lake", "1000 points/m2"])
def test_bare_ground_is_found(name: str, profile: str) -> None:
    assert answer(shapes()[name], PROFILES[profile]).mean() > 0.98


def test_a_cliff_is_terrain() -> None:
    """A plateau of 30 x 60 m that drops 40 m on one side and leaves the survey on three: the edge is no drop."""
    cliff = shapes()["cliff"]
    top = cliff[:, 0] > 30
    assert answer(cliff, PaperParams()).mean() > 0.98
    found = answer(cliff, RobustParams())
    assert found[~top].mean() > 0.9
    assert found[top].mean() > 0.9


def test_sixty_degrees() -> None:
    """The paper's planes reach 85 degrees; the robust ones 45, so that it has no seed there: documented, not hidden."""
    slope = shapes()["60 degrees"]
    assert answer(slope, PaperParams()).mean() > 0.98
    assert not answer(slope, RobustParams()).any()


@pytest.mark.parametrize("profile", PROFILES)
def test_noise_of_a_thousand_kilometres_hides_nothing(profile: str) -> None:
    xyz = shapes()["noise of 1000 km"]
    found = answer(xyz, PROFILES[profile])
    noise = np.abs(xyz[:, 2]) > 1e5
    assert not found[noise].any()
    if profile == "robust":
        assert found[~noise].mean() > 0.9


@pytest.mark.parametrize("profile", PROFILES)
def test_a_stray_point_changes_no_other_label(profile: str) -> None:
    xyz = shapes()["stray point 2000 km away"]
    params = PROFILES[profile]
    if isinstance(params, RobustParams):
        # The stray point counts for the density, which decides the cell: fixed here, so that only its place matters.
        params = params.replace(cell_size=2.0, refinement=1)
    found = answer(xyz, params)
    assert not found[-1]
    assert np.array_equal(found[:-1], answer(xyz[:-1], params))


@pytest.mark.parametrize("which", [*PROFILES, *FILTERS])
def test_a_stray_point_10_000_km_away_is_refused_by_name(which: str) -> None:
    xyz = np.vstack([plane(10), [[1e7, 5.0, 100.0]]])
    with pytest.raises(ParameterError, match=r"x reaches .* remove the stray points"):
        classify_ground(xyz, PROFILES.get(which) or filters.parameters(which))


COUNTER = """
import json, os, sys, warnings
os.environ["NUMBA_DISABLE_JIT"] = "1"
warnings.simplefilter("ignore")
import numpy as np
np.seterr(all="ignore")
from ppdf_dask import filters
name, profile, parts = json.loads(sys.stdin.read())
params = filters.parameters("ppdf", profile)
rng = np.random.default_rng(0)
made = {
    "spread": lambda n: rng.uniform([0, 0, 0], [(n / 4) ** 0.5, (n / 4) ** 0.5, 0.05], (n, 3)),
    "one cell": lambda n: rng.uniform([0, 0, 0], [0.9, 0.9, 3.0], (n, 3)),
    "duplicates": lambda n: np.tile(rng.uniform([0, 0, 0], [20, 20, 0.05], (40, 3)), (n // 40, 1)),
    "lake": lambda n: rng.uniform(0, [40, 8, 0.05], (n, 3)) + [0, 30, 0] * rng.integers(0, 2, (n, 1)),
}[name]
lines = 0
def count(frame, event, arg):
    global lines
    if "/filters/" not in frame.f_code.co_filename:
        return None
    lines += 1
    return count
for n in parts:
    xyz = made(n)
    filters.classify_ground(xyz, params)
    lines = 0
    sys.settrace(count)
    filters.classify_ground(xyz, params)
    sys.settrace(None)
    print(len(xyz), lines)
"""


def counted(name: str, profile: str, sizes: tuple[int, int]) -> list[tuple[int, int]]:
    done = subprocess.run(
        [sys.executable, "-c", COUNTER],
        input=json.dumps([name, profile, sizes]),
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return [tuple(map(int, line.split())) for line in done.stdout.splitlines()]


@pytest.mark.parametrize(
    ("profile", "name", "few"),
    [
        ("robust", "one cell", 160),
        ("robust", "lake", 160),
        ("paper", "spread", 160),
        # Below some hundred points in one square the number of RANSAC trials still rises to its limit.
        ("paper", "one cell", 640),
        ("paper", "duplicates", 160),
        ("paper", "lake", 160),
    ],
)
def test_four_times_the_points_are_about_four_times_the_work(profile: str, name: str, few: int) -> None:
    (small, little), (large, much) = counted(name, profile, (few, 4 * few))
    # Quadratic work would grow 16 times, n log n about 5 times; the bound is 8.
    assert large == 4 * small
    assert much < 8 * little
