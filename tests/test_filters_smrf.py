"""SMRF against a plain-Python reading of its steps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from classic_clouds import cells, cloud_of, fill, opened, points
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask.filters import smrf
from ppdf_dask.filters.smrf import SmrfParams, classify


def progressive(surface, radius, rise):
    marked, previous = set(), surface
    for r in range(1, radius + 1):
        now = opened(surface, r)
        marked |= {at for at in surface if abs(previous[at] - now[at]) > rise * r}
        previous = now
    return marked


def steepness(terrain, box, step):
    def along(at, axis):
        size = box[1] - box[0] if axis == 0 else box[3] - box[2]
        if size == 0:
            return 0.0
        ends = [tuple(v + (s if k == axis else 0) for k, v in enumerate(at)) for s in (-1, 1)]
        ends = [e if e in terrain else at for e in ends]
        return (terrain[ends[1]] - terrain[ends[0]]) / (ends[1][axis] - ends[0][axis]) / step

    return {at: math.sqrt(along(at, 0) ** 2 + along(at, 1) ** 2) for at in terrain}


def oracle(pts, p):
    """True, False, or None where the decision lies within float noise."""
    step = round(p.cell * 1000)
    low, box = cells(pts, step)
    surface = fill(low, box, 8)
    objects = progressive({at: -z for at, z in surface.items()}, 1, 5.0 * step)
    objects |= progressive(surface, math.ceil(p.window / p.cell), p.slope * step)
    kept = {at: z for at, z in surface.items() if at not in objects}
    terrain = fill(kept, box, 8) if kept else surface
    slope = steepness(terrain, box, step)
    out = []
    for x, y, z in pts:
        at = (x // step, y // step)
        margin = p.threshold * 1000 + p.scalar * 1000 * slope[at] - abs(z - terrain[at])
        out.append(None if abs(margin) < 1e-6 else margin >= 0)
    return out


@given(points(extent=8_000), st.sampled_from([1.0, 2.0]), st.sampled_from([3.0, 5.5]), st.sampled_from([0.15, 0.5]))
@settings(deadline=None, max_examples=60)
def test_oracle(pts, cell, window, slope):
    params = SmrfParams(cell=cell, window=window, slope=slope)
    ground = classify(cloud_of(pts), params).ground
    if len(set(pts)) < 3:
        assert not ground.any()
        return
    for got, expected in zip(ground.tolist(), oracle(pts, params), strict=True):
        assert expected is None or got == expected


def test_by_hand():
    # A slope of 10 % with a house of 4 m on it and a pit of 9 m in one cell.
    pts = [(1000 * c + 500, 1000 * r + 500, 100 * c) for c in range(20) for r in range(20)]
    house = [5 <= x // 1000 < 9 and 5 <= y // 1000 < 9 for x, y, _ in pts]
    pts = [(x, y, z + 4000 * h) for (x, y, z), h in zip(pts, house, strict=True)]
    pit = pts.index((12_500, 12_500, 1200))
    pts[pit] = (12_500, 12_500, -7800)
    ground = classify(cloud_of(pts), SmrfParams(window=6.0)).ground
    expected = ~np.array(house)
    expected[pit] = False
    assert ground.tolist() == expected.tolist()


def test_tolerance_grows_with_slope():
    # On a plane of slope 0.1 the tolerance is 0.5 + 1.25 * 0.1 = 0.625 m above the cell's lowest point.
    plane = [(1000 * c + 500, 1000 * r + 500, 100 * c) for c in range(9) for r in range(9)]
    at = (4_500, 4_500, 400)
    for rise, expected in ((624, True), (626, False)):
        ground = classify(cloud_of([*plane, (at[0], at[1], at[2] + rise)]), SmrfParams()).ground
        assert ground[:-1].all()
        assert bool(ground[-1]) is expected


def test_buffer_and_record():
    assert smrf.required_buffer(SmrfParams()) == pytest.approx(46.0)
    assert smrf.FILTER.resolve(SmrfParams(cell=2.0), None) == SmrfParams(cell=2.0)  # type: ignore[arg-type]
