"""CSF through its library: what a plain reading of the method gives, silent, repeatable, with clear errors."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from classic_clouds import cloud_of
from oracle_csf import margins

from ppdf_dask.errors import ParameterError, PpdfError
from ppdf_dask.filters import csf
from ppdf_dask.filters.csf import PAPER, PAPER_SMOOTH, CsfParams, classify

pytest.importorskip("CSF", reason="the extra csf is not installed")


def scene(seed=1):
    """Flat land with a house, and a terrace 4 m high beyond a steep bank."""
    rng = np.random.default_rng(seed)
    xy = rng.integers(0, 40_000, (5000, 2))
    bank = np.clip(xy[:, 0] - 20_000, 0, 4000)
    house = (abs(xy[:, 0] - 10_000) < 4000) & (abs(xy[:, 1] - 20_000) < 4000)
    return np.column_stack([xy, bank + np.where(house, 5000, 0)]), house


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"slope_smooth": False},
        {"rigidness": 1, "threshold": 0.2, "time_step": 0.9},
        {"rigidness": 2, "iterations": 30},
        {"resolution": 0.5},
        {"resolution": 0.5, "slope_smooth": False},
    ],
    ids=str,
)
def test_oracle(values):
    rng = np.random.default_rng(len(str(values)))
    xy = rng.integers(0, 14_000, (600, 2))
    bank = np.clip(xy[:, 0] - 8_000, 0, 3_000)
    house = (abs(xy[:, 0] - 4_000) < 2_000) & (abs(xy[:, 1] - 6_000) < 2_500)
    pts = np.column_stack([xy, bank + np.where(house, 5_000, 0) + rng.integers(0, 300, len(xy))])
    # In the order in which ours hands them over: of equally near points the first carries the cloth.
    pts = pts[np.lexsort((pts[:, 2], pts[:, 1], pts[:, 0]))]
    params = CsfParams(**values)
    metres = ((pts - pts.min(axis=0)) / 1000).tolist()
    inside = np.array(margins(metres, params))
    sure = np.abs(inside) > 1e-9
    assert sure.sum() > 590
    ground = classify(cloud_of(pts), params).ground
    assert 0.2 < ground.mean() < 0.9
    assert (ground == (inside > 0))[sure].all()
    if params == CsfParams(resolution=0.5):
        # The cloth that hangs over the bank is large enough to be let down here.
        rough = np.array(margins(metres, params.replace(slope_smooth=False)))
        assert ((rough > 0) != (inside > 0)).any()


def test_a_house_is_removed_and_the_land_kept():
    pts, house = scene()
    ground = classify(cloud_of(pts), CsfParams()).ground
    assert not ground[house].any()
    # The cloth spans the walls' foot and the bank; everywhere else it lies on the land.
    far = (pts[:, 0] < 18_000) & ~((abs(pts[:, 0] - 10_000) < 6000) & (abs(pts[:, 1] - 20_000) < 6000))
    assert ground[far].all()


def test_the_order_of_the_points_does_not_matter_nor_does_a_second_run():
    pts, _ = scene()
    ground = classify(cloud_of(pts), CsfParams()).ground
    order = np.random.default_rng(2).permutation(len(pts))
    assert (classify(cloud_of(pts[order]), CsfParams()).ground == ground[order]).all()
    moved = pts + np.array([512_345_678, 5_400_000_123, -70_000])
    assert (classify(cloud_of(moved), CsfParams()).ground == ground).all()


def test_equally_near_points_do_not_depend_on_their_order():
    # Each particle of the cloth has four points at the same distance, of different heights.
    rng = np.random.default_rng(4)
    xy = 500 * np.stack(np.meshgrid(np.arange(40), np.arange(40)), axis=-1).reshape(-1, 2)
    pts = np.column_stack([xy + 250, rng.integers(0, 3000, len(xy))])
    # The cloth's first particle hangs over the lowest x and y.
    pts = np.vstack([pts, [[0, 0, 0]]])
    ground = classify(cloud_of(pts), CsfParams()).ground
    order = rng.permutation(len(pts))
    assert (classify(cloud_of(pts[order]), CsfParams()).ground == ground[order]).all()


def test_parameters_reach_the_library():
    pts, _ = scene()
    counts = {
        name: int(classify(cloud_of(pts), params).ground.sum())
        for name, params in {
            "soft": CsfParams(rigidness=1),
            "stiff": CsfParams(),
            "smooth": PAPER_SMOOTH,
            "rough": PAPER,
            "narrow": CsfParams(threshold=0.01),
            "one step": CsfParams(iterations=1, slope_smooth=False),
        }.items()
    }
    assert counts["smooth"] >= counts["rough"]
    assert counts["narrow"] < counts["stiff"]
    assert counts["one step"] < counts["stiff"]
    assert counts["soft"] > counts["stiff"]


def test_nothing_is_printed_even_from_c():
    code = (
        "import numpy as np; from ppdf_dask.filters import classify_ground;"
        "classify_ground(np.random.default_rng(0).uniform(0, 9, (500, 3)), 'csf')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, env=os.environ)
    assert done.stdout == b""
    assert done.stderr == b""


def test_errors_say_what_to_do(monkeypatch):
    with pytest.raises(ParameterError, match=r"rigidness = 2\.5 is not a whole number"):
        CsfParams(rigidness=2.5)  # type: ignore[arg-type]
    wide = cloud_of([(200_000 * k, 200_000 * k, 0) for k in range(9)])
    with pytest.raises(ParameterError, match=r"--chunk-size"):
        classify(wide, CsfParams(resolution=0.05))
    pts, _ = scene()
    monkeypatch.setattr(csf, "CHILD", csf.CHILD.with_name("absent.py"))
    with pytest.raises(PpdfError, match=r"5000 points ended with code 2 .*--chunk-size"):
        classify(cloud_of(pts), CsfParams())
    monkeypatch.setattr(csf.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(PpdfError, match=r"pip install 'ppdf-dask\[csf\]'"):
        classify(cloud_of(pts), CsfParams())
