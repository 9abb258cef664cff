"""MSF by its definition, strict and seeded."""

from __future__ import annotations

import math

import pytest
from classic_clouds import cells, cloud_of, points
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask.filters.msf import PAPER, PAPER_SEEDED, MsfParams, classify, required_buffer


def low_points(pts, step):
    best = {}
    for p in pts:
        at = (p[0] // step, p[1] // step)
        best[at] = min(best.get(at, p), p, key=lambda q: (q[2], q[0], q[1]))
    return best


def allowed(p, d2):
    rise = math.tan(math.radians(p.slope))
    return rise * math.sqrt(d2)


def strict(pts, p):
    step = round(p.cell * 1000)
    low = low_points(pts, step)
    out = []
    for x, y, z in pts:
        margin = math.inf
        for at, (xj, yj, zj) in low.items():
            d2 = (x - xj) ** 2 + (y - yj) ** 2
            if at == (x // step, y // step):
                margin = min(margin, p.tolerance * 1000 - (z - zj))
            elif d2 <= (p.window * 500) ** 2 and z > zj:
                margin = min(margin, min(allowed(p, d2), p.max_height * 1000) - (z - zj))
        out.append(None if 0 < abs(margin) < 1e-6 else margin >= 0)
    return out


def seeded(pts, p):
    step = round(p.cell * 1000)
    low = low_points(pts, step)
    _, (c0, c1, r0, r1) = cells(pts, step)
    width = max(1, round(p.window / p.cell))
    wide, high = min(width, c1 - c0 + 1), min(width, r1 - r0 + 1)
    ground = set()
    for c in range(c0, c1 - wide + 2):
        for r in range(r0, r1 - high + 2):
            inside = [q for (cc, rr), q in low.items() if c <= cc < c + wide and r <= rr < r + high]
            if inside:
                ground.add(min(inside, key=lambda q: (q[2], q[0], q[1])))
    while True:
        new = set()
        for q in set(pts) - ground:
            d2, z = min(((q[0] - g[0]) ** 2 + (q[1] - g[1]) ** 2, g[2], g[0], g[1]) for g in ground)[:2]
            margin = min(p.tolerance * 1000 + allowed(p, d2), p.max_height * 1000) - (q[2] - z)
            if 0 < abs(margin) < 1e-6:
                return None
            if margin >= 0:
                new.add(q)
        if not new:
            return [q in ground for q in pts]
        ground |= new


@given(points(), st.sampled_from([1.0, 2.5]), st.sampled_from([4.0, 10.0]), st.sampled_from([0.0, 15.0, 45.0]))
@settings(deadline=None, max_examples=60)
def test_strict_is_the_definition(pts, cell, window, slope):
    params = MsfParams(cell=cell, window=window, slope=slope, variant="strict")
    ground = classify(cloud_of(pts), params).ground
    if len(set(pts)) < 3:
        assert not ground.any()
        return
    for got, expected in zip(ground.tolist(), strict(pts, params), strict=True):
        assert expected is None or got == expected


@given(points(), st.sampled_from([1.0, 2.5]), st.sampled_from([2.0, 5.0, 10.0]), st.sampled_from([0.0, 15.0, 45.0]))
@settings(deadline=None, max_examples=80)
def test_seeded_is_the_definition(pts, cell, window, slope):
    params = MsfParams(cell=cell, window=window, slope=slope)
    if len(set(pts)) < 3:
        return
    expected = seeded(pts, params)
    assert expected is None or classify(cloud_of(pts), params).ground.tolist() == expected


def ramp(degrees):
    rise = math.tan(math.radians(degrees))
    return [(1000 * i + 500, 1000 * j + 500, round(1000 * i * rise)) for i in range(30) for j in range(30)]


def test_the_strict_rule_loses_every_slope_steeper_than_its_own():
    # The rule of the paper's Table 2, 15 degrees: only the foot of a ramp of 20 degrees has no lower neighbour.
    assert classify(cloud_of(ramp(14)), PAPER).ground.all()
    steep = cloud_of(ramp(20))
    ground = classify(steep, PAPER).ground
    assert ground.sum() == 30
    assert (steep.x[ground] == 500).all()
    # Growth climbs it: over 1 m it may rise by 0.3 m + tan(15 degrees) * 1 m, more than tan(20 degrees) * 1 m.
    assert classify(steep, PAPER_SEEDED).ground.all()


def test_buffer():
    assert required_buffer(PAPER) == pytest.approx(7.0)
    assert required_buffer(PAPER_SEEDED) == pytest.approx(50.0)
