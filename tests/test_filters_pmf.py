"""PMF against openings by brute force."""

from __future__ import annotations

import math

import pytest
from classic_clouds import cells, cloud_of, fill, opened, points
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask.errors import ParameterError
from ppdf_dask.filters.pmf import PAPER, PDAL, PmfParams, classify, required_buffer, windows


def oracle(pts, p):
    """Zhang's loop: points leave window by window. None where the decision lies within float noise."""
    step = round(p.cell * 1000)
    low, box = cells(pts, step)
    surface = fill(low, box, 1)
    kept = [True] * len(pts)
    k, width = 0, 0.0
    while width < p.window:
        last, width = width, p.cell * (2 * 2**k + 1)
        height = p.initial_height if k == 0 else p.initial_height + math.tan(math.radians(p.slope)) * (width - last)
        height = min(height, p.max_height)
        surface = opened(surface, 2**k, p.shape)
        for i, (x, y, z) in enumerate(pts):
            margin = surface[x // step, y // step] + height * 1000 - z
            if kept[i] and abs(margin) < 1e-6:
                kept[i] = None
            elif margin <= 0:
                kept[i] = False
        k += 1
    return kept


@given(
    points(extent=9_000),
    st.sampled_from([1.0, 1.5]),
    st.sampled_from([3.0, 9.0, 10.0]),
    st.sampled_from([5.0, 15.0, 45.0]),
    st.sampled_from(["square", "diamond"]),
)
@settings(deadline=None, max_examples=60)
def test_oracle(pts, cell, window, slope, shape):
    params = PmfParams(cell=cell, window=window, slope=slope, shape=shape)
    ground = classify(cloud_of(pts), params).ground
    if len(set(pts)) < 3:
        assert not ground.any()
        return
    for got, expected in zip(ground.tolist(), oracle(pts, params), strict=True):
        assert expected is None or got == expected


def oracle_on_points(pts, p):
    """The PCL's loop: squares around the points that are left. None where the decision lies within float noise."""
    left = list(range(len(pts)))
    for radius, height in windows(p):
        width = round(p.cell * 1000) * (2 * radius + 1)
        near = {
            i: [j for j in left if all(2 * abs(pts[i][axis] - pts[j][axis]) <= width for axis in (0, 1))] for i in left
        }
        eroded = {i: min(pts[j][2] for j in near[i]) for i in left}
        margin = {i: max(eroded[j] for j in near[i]) + height * 1000 - pts[i][2] for i in left}
        if any(abs(m) < 1e-6 for m in margin.values()):
            return None
        left = [i for i in left if margin[i] > 0]
    return [i in left for i in range(len(pts))]


@given(
    points(extent=9_000),
    st.sampled_from([0.999, 1.0, 1.5]),
    st.sampled_from([3.0, 9.0, 10.0]),
    st.sampled_from([5.0, 15.0, 45.0]),
)
@settings(deadline=None, max_examples=60)
def test_oracle_on_points(pts, cell, window, slope):
    params = PmfParams(cell=cell, window=window, slope=slope, shape="square", on="points")
    expected = oracle_on_points(pts, params)
    if len(set(pts)) >= 3 and expected is not None:
        assert classify(cloud_of(pts), params).ground.tolist() == expected


def test_windows_of_the_paper():
    tan15 = math.tan(math.radians(15))
    assert windows(PAPER) == [
        (1, 0.5),
        (2, pytest.approx(0.5 + 2 * tan15)),
        (4, pytest.approx(0.5 + 4 * tan15)),
        (8, pytest.approx(0.5 + 8 * tan15)),
    ]
    assert [h for _, h in windows(PDAL)] == pytest.approx([0.15, 2.15, 2.5, 2.5, 2.5])


def test_a_house_wider_than_the_windows_stays():
    def cloud(half):
        pts = [(1000 * c + 500, 1000 * r + 500, 0) for c in range(60) for r in range(60)]
        return cloud_of([(x, y, 6000 * (max(abs(x - 30_000), abs(y - 30_000)) < 1000 * half)) for x, y, _ in pts])

    small, large = cloud(8), cloud(10)
    assert (classify(small, PAPER).ground == (small.z == 0)).all()
    assert classify(large, PAPER).ground.all()
    assert (classify(large, PmfParams(shape="square")).ground == (large.z == 0)).all()


def test_strictly_below_the_tolerance():
    flat = [(1000 * c + 500, 1000 * r + 500, 0) for c in range(9) for r in range(9)]
    for z, expected in ((499, True), (500, False)):
        assert bool(classify(cloud_of([*flat, (4_500, 4_500, z)]), PAPER).ground[-1]) is expected


def test_parameters_are_checked():
    assert required_buffer(PAPER) == pytest.approx(3 + 5 + 9 + 17 + 10)
    with pytest.raises(ParameterError, match=r"slope = 95.0 degrees is above"):
        PmfParams(slope=95.0)
    with pytest.raises(ParameterError, match=r"on = 'points' knows squares only; set shape = 'square'"):
        PmfParams(on="points")
    with pytest.raises(ParameterError, match=r"shape = 'round' is unknown"):
        PmfParams(shape="round")  # type: ignore[arg-type]
