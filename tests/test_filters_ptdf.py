"""PTDF against passes that triangulate anew each time, and cases done by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from classic_clouds import INF, cells, cloud_of, points
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask._delaunay import CORNERS, Triangulation
from ppdf_dask.errors import ParameterError
from ppdf_dask.filters.ptdf import LASR, PAPER, PtdfParams, classify


def cross(o, a, b):
    return (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0])


class Tin:
    """The facets over a set of points, found again by brute force for every place."""

    def __init__(self, pts):
        self.middle = tuple((min(v) + max(v)) // 2 for v in zip(*pts, strict=True))[:2]
        tin = Triangulation(200_000)
        tin.insert(np.array([(x - self.middle[0], y - self.middle[1], z) for x, y, z in pts], np.int32))
        own = tin.triangles[tin.triangles[:, :3].min(axis=1) >= CORNERS, :3]
        self.facets = [
            [(x + self.middle[0], y + self.middle[1], z) for x, y, z in corners]
            for corners in tin.vertices[own].tolist()
        ]
        self.at = {p[:2]: p for p in pts}

    def facet(self, p):
        """The facet that holds a place; on an edge the one left of its way up; None outside."""
        for corners in self.facets:
            edges = [(corners[i], corners[(i + 1) % 3]) for i in range(3)]
            if all(cross(a, b, p) > 0 or (cross(a, b, p) == 0 and a[:2] < b[:2]) for a, b in edges):
                return corners
        return None


def measure(corners, p, params):
    """Distance to the facet's plane and how far the point is inside the limits (negative: outside)."""
    a, b, c = (np.array(v, float) for v in corners)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    p = np.array(p, float)
    d = abs(normal @ (p - a))
    if d < 1e-6:
        return 0.0, INF
    nearest = min(np.linalg.norm(p - v) for v in (a, b, c))
    margin = min(params.iteration_distance * 1000 - d, params.iteration_angle - math.degrees(math.asin(d / nearest)))
    if params.foot_inside:
        foot = p - normal * (normal @ (p - a))
        sides = [(a, b), (b, c), (c, a)]
        margin = min(margin, *(cross(u, v, foot) / math.hypot(*(v - u)[:2]) for u, v in sides))
    return d, margin


def against_facet(tin, corners, p, params):
    normal = np.cross(*(np.subtract(v, corners[0]) for v in corners[1:]))
    slope = math.degrees(math.atan2(math.hypot(*normal[:2]), abs(normal[2])))
    d, margin = measure(corners, p, params)
    if (params.mirror == "steep" and slope > params.terrain_angle) or (params.mirror == "failed" and margin <= 0):
        v = max(corners, key=lambda c: (c[2], c[0], c[1]))
        image = (2 * v[0] - p[0], 2 * v[1] - p[1], p[2])
        there = tin.facet(image)
        return (INF, -INF) if there is None else measure(there, image, params)
    return d, margin


class Noise(Exception):
    """A decision within float noise: the example says nothing."""


def oracle(pts, params):
    window, spacing = round(params.window * 1000), round(params.spacing * 1000)

    def lowest(step):
        best = {}
        for p in pts:
            at = (p[1] // step, p[0] // step)
            best[at] = min(best.get(at, p), p, key=lambda q: (q[2], q[0], q[1]))
        return [best[at] for at in sorted(best)]

    seeds = lowest(window)
    _, (c0, c1, r0, r1) = cells(pts, window)
    xs = [c * window for c in range(c0 - 1, c1 + 3)]
    ys = [r * window for r in range(r0 - 1, r1 + 3)]
    ring = {(x, y) for x in xs for y in ys if x in (xs[0], xs[-1]) or y in (ys[0], ys[-1])}
    vertices = list(seeds)
    for x, y in sorted(ring):
        near = min(seeds, key=lambda s: ((s[0] - x) ** 2 + (s[1] - y) ** 2, s[2], s[0], s[1]))
        vertices.append((x, y, near[2]))
    tin = Tin(vertices)
    open_ = [p for p in lowest(spacing) if p[:2] not in tin.at]
    while True:
        best = {}
        for k, p in enumerate(open_):
            corners = tin.facet(p)
            d, margin = against_facet(tin, corners, p, params)
            if abs(margin) < 1e-6:
                raise Noise
            if margin > 0 and max(math.dist(a[:2], b[:2]) for a in corners for b in corners) >= spacing:
                best.setdefault(tuple(corners), []).append((d, p[2], k))
        if not best:
            break
        for found in best.values():
            found.sort()
            if len(found) > 1 and found[1][0] - found[0][0] < 1e-6:
                raise Noise
        chosen = {found[0][2] for found in best.values()}
        vertices += [p for k, p in enumerate(open_) if k in chosen]
        open_ = [p for k, p in enumerate(open_) if k not in chosen]
        tin = Tin(vertices)
    out = []
    for p in pts:
        if p[:2] in tin.at:
            rise = abs(p[2] - tin.at[p[:2]][2])
            out.append(rise == 0 or (params.label == "surface" and rise < params.tolerance * 1000))
        elif params.label == "vertices":
            out.append(False)
        else:
            d, margin = against_facet(tin, tin.facet(p), p, params)
            if abs(margin) < 1e-6 or abs(d - params.tolerance * 1000) < 1e-6:
                raise Noise
            out.append(margin > 0 or d < params.tolerance * 1000)
    return out


@given(
    points(most=40, extent=8_000, height=3_000),
    st.sampled_from(["off", "steep", "failed"]),
    st.booleans(),
    st.sampled_from(["surface", "vertices"]),
    st.sampled_from([0.25, 1.0]),
)
@settings(deadline=None, max_examples=80)
def test_oracle(pts, mirror, foot_inside, label, spacing):
    if len(set(pts)) < 3:
        return
    params = PtdfParams(
        window=4.0,
        terrain_angle=30.0,
        spacing=spacing,
        mirror=mirror,
        foot_inside=foot_inside,
        label=label,
        tolerance=0.1,
    )
    try:
        expected = oracle(pts, params)
    except Noise:
        return
    assert classify(cloud_of(pts), params).ground.tolist() == expected


def flat(size=20, step=1000):
    return [(step * i + 500, step * j + 500, 0) for i in range(size) for j in range(size)]


@pytest.mark.parametrize(("rise", "expected"), [(189, True), (190, False)])
def test_angle_by_hand(rise, expected):
    # In the flat TIN of 1 m squares the middle of a square is 707 mm from its corners; asin(d / |PV|) < 15 degrees
    # means d < tan(15 degrees) * 707 = 189.5 mm.
    ground = classify(cloud_of([*flat(), (10_000, 10_000, rise)]), PAPER).ground
    assert ground[:400].all()
    assert bool(ground[400]) is expected


def test_cliff_edge_needs_the_mirror():
    # A terrace 3 m high. Its last point lies in a facet that spans the cliff and is far off it; mirrored about the
    # facet's highest corner it lies on the flat of the terrace.
    pts = [(1000 * i + 500, 1000 * j + 500, 3000 * (i > 9)) for i in range(20) for j in range(20)]
    pts.append((9_800, 10_100, 3000))
    common = {"window": 2.0, "terrain_angle": 50.0, "iteration_angle": 10.0, "tolerance": 0.0}
    for mirror, expected in (("off", False), ("steep", True), ("failed", True)):
        ground = classify(cloud_of(pts), PtdfParams(mirror=mirror, **common)).ground
        # The foot of the cliff is under the facets that span it; the last row touches the border's heights.
        assert all(g for g, (x, y, _) in zip(ground, pts[:-1], strict=False) if x != 9_500 and y < 19_000)
        assert bool(ground[-1]) is expected, mirror


def test_only_vertices():
    pts = [*flat(), (10_010, 10_010, 1)]
    ground = classify(cloud_of(pts), LASR.replace(spacing=2.0)).ground
    # One point of each 2 m cell, the seeds of the 10 m windows among them.
    assert ground.sum() == 100
    assert classify(cloud_of(pts), LASR.replace(spacing=2.0, label="surface")).ground.all()


def test_too_wide_for_the_exact_predicates():
    # Points 200 m apart are one island.
    pts = [(200_000 * k, 0, 0) for k in range(700)]
    with pytest.raises(ParameterError, match=r"134218 m .*--chunk-size"):
        classify(cloud_of(pts), PtdfParams())


def test_points_on_edges_belong_to_one_facet_whatever_the_order():
    # On a grid of 250 mm most points lie on an edge of the TIN of every fourth one.
    rng = np.random.default_rng(5)
    xy = 250 * np.stack(np.meshgrid(np.arange(48), np.arange(48)), axis=-1).reshape(-1, 2)
    pts = np.column_stack([xy, rng.integers(0, 400, len(xy))])
    params = PtdfParams(window=3.0, spacing=1.0, tolerance=0.1)
    ground = classify(cloud_of(pts), params).ground
    assert 0.2 < ground.mean() < 0.9
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(len(pts))
        assert (classify(cloud_of(pts[order]), params).ground == ground[order]).all()
