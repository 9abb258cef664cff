import math
from contextlib import contextmanager
from fractions import Fraction
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay, cKDTree

from ppdf_dask import _delaunay, dtm
from ppdf_dask._delaunay import CORNERS, Triangulation
from ppdf_dask.dtm import DtmGrid, Part, Raster, rasterize_block
from ppdf_dask.errors import ParameterError
from ppdf_dask.grid import Rect
from ppdf_dask.params import DtmParams

SIDE = 24
"""Pixels of a block in most tests: large blocks only take longer."""


@contextmanager
def sizes(**constants):
    """Set module constants that change the work, never the result (but BLOCK)."""
    with patch.multiple(dtm, **({"BLOCK": SIDE} | constants)):
        yield


def loader(points, seen=None):
    def load(rect):
        if seen is not None:
            seen.append(rect)
        x, y = points[:, 0], points[:, 1]
        return [Part.of(points[(x >= rect.x0) & (x < rect.x1) & (y >= rect.y0) & (y < rect.y1)])]

    return load


def as_bytes(result):
    filled = b"" if result.filled is None else result.filled.tobytes()
    return result.height.tobytes(), result.distance.tobytes(), filled


def centres(block, resolution):
    x = block.rect.x0 + resolution * (np.arange(dtm.BLOCK) + 0.5)
    y = block.rect.y1 - resolution * (np.arange(dtm.BLOCK) + 0.5)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


# -- the triangulation ------------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(*[st.integers(-(2**56) + 1, 2**56 - 1)] * 2), min_size=3, max_size=3), st.booleans())
@example([(2**56 - 1, -(2**56) + 1)] * 3, False)
@example([(2**27, -1), (-1, 2**27), (1, 2**28)], False)
@settings(max_examples=200, deadline=None)
def test_the_sign_of_a_sum_of_products_is_exact(pairs, cancel):
    if cancel:
        (a, b), (c, d), _ = pairs
        pairs = [(a, b), (-b, a), (c % 7 - 3, d % 3 - 1)]
    value = sum(a * b for a, b in pairs)
    got = _delaunay._sign_of_products(*[np.int64(v) for pair in pairs for v in pair])
    assert got == (value > 0) - (value < 0)


def exact_in_circle(a, b, c, d):
    """The determinant in Python's integers."""
    rows = [(p[0] - d[0], p[1] - d[1], (p[0] - d[0]) ** 2 + (p[1] - d[1]) ** 2) for p in (a, b, c)]
    (ax, ay, al), (bx, by, bl), (cx, cy, cl) = rows
    return al * (bx * cy - by * cx) + bl * (cx * ay - cy * ax) + cl * (ax * by - ay * bx)


def turn(a, b, c):
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


coordinate = st.one_of(
    st.integers(-3, 3),
    st.integers(-(2**15), 2**15),
    st.integers(-(2**20), 2**20),
    st.integers(-(2**26), 2**26),
    st.sampled_from([k * 2**22 for k in range(-16, 17)]),
)


@given(st.lists(st.tuples(coordinate, coordinate), min_size=4, max_size=4, unique=True))
@settings(max_examples=200, deadline=None)
def test_the_circle_test_is_exact_and_a_tie_has_one_answer(points):
    a, b, c, d = points
    if turn(a, b, c) == 0:
        return
    if turn(a, b, c) < 0:
        b, c = c, b
    got = _delaunay.in_circle(*[np.int64(v) for p in (a, b, c, d) for v in p])
    value = exact_in_circle(a, b, c, d)
    if value != 0:
        assert got == (value > 0)
        return
    # The perturbed determinant to first order: raise the lift of the largest point by a positive amount.
    top = max(points)
    rest = {a: turn(d, b, c), b: turn(a, d, c), c: turn(a, b, d), d: -turn(a, b, c)}
    assert got == (rest[top] > 0)


@pytest.mark.parametrize("m", [2**20, 2**25])
def test_a_miss_of_the_circle_by_one_part_in_a_quadrillion_is_seen(m):
    """x² + y² of the fourth point differs by 1 from the others' m² or m² + 1; floating point cannot tell."""
    on = [(m, 0), (0, m), (-m, 0)], [(m, 1), (-1, m), (-m, -1)]
    off = [(1, -m), (-1, -m), (m, 1), (-m, 1)], [(0, -m), (m, 0), (-m, 0), (0, m)]
    for circle, others in zip(on, off, strict=True):
        for d in others:
            values = [v for p in (*circle, d) for v in p]
            assert abs(exact_in_circle(*circle, d)) == 2 * m * m + 2 * (circle[0][1]) ** 2
            assert _delaunay.in_circle(*map(np.int64, values)) == (exact_in_circle(*circle, d) > 0)


def shape(tin):
    v, t = tin.vertices, tin.triangles
    return {frozenset((*map(tuple, v[k[:3]].tolist()),)) for k in t}


lattice = st.tuples(st.integers(-6, 6), st.integers(-6, 6), st.integers(0, 3))
scattered = st.tuples(st.integers(-900, 900), st.integers(-900, 900), st.integers(0, 3))


@given(st.lists(st.one_of(lattice, scattered), max_size=40), st.randoms(use_true_random=False), st.integers(0, 40))
@settings(max_examples=60, deadline=None)
def test_a_triangulation_is_delaunay_and_depends_on_the_set_only(points, random, cut):
    cloud = np.array(points, dtype=np.int32).reshape(-1, 3)
    tin = Triangulation(1000)
    tin.insert(cloud)
    v, t = tin.vertices.tolist(), tin.triangles.tolist()
    lowest = {}
    for x, y, z in points:
        lowest[x, y] = min(z, lowest.get((x, y), z))
    assert {(x, y): z for x, y, z in v[CORNERS:]} == lowest
    areas = [turn(v[a], v[b], v[c]) for a, b, c, *_ in t]
    assert min(areas) > 0
    assert sum(areas) == 2 * (4_000_000 + 2000), "the square with its third corner one step out"
    for k, (a, b, c, *others) in enumerate(t):
        assert all(exact_in_circle(v[a], v[b], v[c], p) <= 0 for p in v)
        assert all(u < 0 or k in t[u][3:] for u in others)
    shuffled = list(points)
    random.shuffle(shuffled)
    again = Triangulation(1000)
    for part in (shuffled[:cut], shuffled[cut:]):
        again.insert(np.array(part, dtype=np.int32).reshape(-1, 3))
    assert shape(again) == shape(tin)


def test_a_square_too_wide_for_exact_predicates_is_refused():
    Triangulation(2**26 - 1)
    with pytest.raises(ValueError, match="exact"):
        Triangulation(2**26)


# -- the surface ------------------------------------------------------------------------------------------------------


def rule(p, q, r, limit):
    """Whether a triangle counts, in rational numbers."""
    edges = [(a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 for a, b in ((p, q), (q, r), (r, p))]
    radius2 = Fraction(math.prod(edges), 4 * turn(p, q, r) ** 2)
    return max(edges) <= limit**2 and radius2 <= limit**2


@pytest.mark.parametrize("seed", range(6))
def test_heights_and_distances_agree_with_scipy(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(5, 300))
    xyz = np.column_stack([rng.integers(-40_000, 60_000, (n, 2)), rng.integers(0, 30_000, n)])
    offset = np.array([500_000_000, 5_000_000_000, 0])
    params = DtmParams(resolution=1.0, max_edge=9.0, fill_edge=30.0)
    with sizes():
        grid = DtmGrid.from_params(params)
        block = next(iter(grid.over(Rect(*offset[:2], *(offset[:2] + 1)))))
        got = rasterize_block(block, loader(xyz + offset), params)
        pixels = centres(block, 1000) - offset[:2]
        mesh = Delaunay(xyz[:, :2].astype(float))
        assert len(mesh.coplanar) == 0
        found = mesh.find_simplex(pixels)
        for layer, limit in ((got.height, 9_000), (got.filled, 30_000)):
            wanted = np.full(len(pixels), np.nan)
            for k, s in enumerate(found):
                if s < 0:
                    continue
                corners = [tuple(map(int, xyz[i])) for i in mesh.simplices[s]]
                if rule(*corners, limit):
                    system = np.array([[x, y, 1] for x, y, _ in corners], dtype=float)
                    wanted[k] = np.linalg.solve(system, [z for *_, z in corners]) @ [*pixels[k], 1] / 1000
            assert np.isfinite(wanted).any()
            # float32 rounds 30 m by 1e-6; the solver loses more in slivers, whose determinant is small.
            np.testing.assert_allclose(layer.ravel(), wanted, atol=3e-6)
        nearest = cKDTree(xyz[:, :2]).query(pixels)[0] / 1000
        wanted = np.where(nearest <= 30, nearest, np.inf)
        np.testing.assert_allclose(got.distance.ravel(), wanted, rtol=1e-7)


@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 700),
    st.sampled_from([1, 3, 40]),
    st.sampled_from([1, 2, 30]),
    st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_every_home_holds_its_pixel_and_every_distance_is_the_nearest_points(seed, n, resolution, limit, extent):
    """In steps of a quarter of a pixel, so that points lie on centres, edges and corners of pixels; in integers."""
    rng = np.random.default_rng(seed)
    spread = int(rng.integers(1, 200))
    points = rng.integers(-spread, spread, (n, 3)).astype(np.int32)
    points[:, :2] += rng.integers(-60, 60, 2).astype(np.int32)
    tin = Triangulation(100_000)
    tin.insert(points)
    first, step, shape = rng.integers(-100, 100, 2), 2 * resolution, (13, 17)
    z, d, home = np.full((1, *shape), np.nan), np.full(shape, np.inf), np.full(shape, -1, np.int32)
    box = np.array([-(10**5), -(10**5), 10**5, 10**5])
    limits, need = np.array([limit * resolution]), box.copy()
    if extent:
        box[:2], box[2:] = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    dtm.heights(tin.vertices, tin.triangles, first, step, limits, box, z, home, need)
    dtm.distances(tin.vertices, tin.triangles, home, first, step, limits[-1], box, d, need)
    x, y = np.meshgrid(first[0] + step * np.arange(shape[1]), first[1] - step * np.arange(shape[0]))
    squared = ((x[..., None] - 2 * points[:, 0]) ** 2 + (y[..., None] - 2 * points[:, 1]) ** 2).min(axis=-1)
    wanted = np.where(squared <= 4 * limits[-1] ** 2, np.sqrt(squared) / 2, np.inf)
    np.testing.assert_array_equal(d, wanted)
    corners = 2 * tin.vertices[tin.triangles[home, :3], :2].astype(np.int64)
    for k in range(3):
        (px, py), (qx, qy) = (np.moveaxis(corners[..., (k + i) % 3, :], -1, 0) for i in (1, 2))
        assert ((qx - px) * (y - py) >= (qy - py) * (x - px)).all()


@st.composite
def surveys(draw):
    """Random, gridded, collinear, clustered and doubled ground, several blocks wide."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["random", "grid", "fine grid", "lines", "clusters", "mixed"]))
    n = draw(st.integers(0, 300))
    xy = rng.integers(-60_000, 90_000, (n, 2))
    if kind == "grid":
        xy = xy // 5000 * 5000
    elif kind == "fine grid":
        xy = (xy // 4 // 1000) * 1000 + 500
    elif kind == "lines":
        xy[:, 1] = xy[:, 0] // 4 + rng.integers(0, 3, n) * 5000
    elif kind == "clusters":
        xy = xy // 30_000 * 30_000 + rng.integers(0, 2000, (n, 2))
    elif kind == "mixed":
        xy[::2] = xy[::2] // 8000 * 8000
    return np.column_stack([xy, rng.integers(-5000, 5000, n)])


def at_once(points, block, limits, resolution=1000):
    """The block from one triangulation of the whole survey: no margin, nothing to prove."""
    tin = Triangulation(1_000_000)
    tin.insert(points.astype(np.int32))
    first = np.array([2 * block.rect.x0 + resolution, 2 * block.rect.y1 - resolution])
    z = np.full((len(limits), dtm.BLOCK, dtm.BLOCK), np.nan)
    d = np.full(z.shape[1:], np.inf)
    box = np.array([-(10**6), -(10**6), 10**6, 10**6])
    home = np.empty(d.shape, np.int32)
    pixels = first, 2 * resolution
    dtm.heights(tin.vertices, tin.triangles, *pixels, np.array(limits), box, z, home, box.copy())
    dtm.distances(tin.vertices, tin.triangles, home, *pixels, limits[-1], box, d, box.copy())
    return z[0], d, z[-1]


def as_float32(arrays):
    return tuple((a / 1000).astype(np.float32).tobytes() for a in arrays)


@given(
    surveys(),
    st.sampled_from([0, 500, 3000, 40_000]),
    st.integers(3, SIDE),
    st.sampled_from([20, 100, 1000]),
    st.booleans(),
    st.randoms(use_true_random=False),
)
@settings(max_examples=60, deadline=None)
def test_the_result_depends_on_the_ground_only(points, margin, window, most, known, random):
    """Bytes are equal whatever the first margin, the windows, the loader's order and what is known of the extent."""
    params = DtmParams(resolution=1.0, max_edge=8.0, fill_edge=20.0)
    order = list(range(len(points)))
    random.shuffle(order)
    seen = []
    with sizes(WINDOW=window * 1000, MAX_POINTS=most):
        block = DtmGrid(1000).block(-1, 0)
        extent = Rect(-60_000, -60_000, 90_000, 90_000) if known else None
        got = rasterize_block(block, loader(points[order], seen), params, extent=extent, first_margin=margin)
        generous = rasterize_block(
            block, lambda _: [Part.of(points[::2]), Part.of(points[1::2])], params, first_margin=margin
        )
        assert as_bytes(generous) == as_bytes(got), "whole chunks, as the store gives them"
        assert (generous.points, generous.margin) == (got.points, got.margin) or known
        whole, again = (at_once(p, block, [8000, 20_000]) for p in (points, points[order]))
    assert as_bytes(got) == as_float32(whole)
    assert [a.tobytes() for a in again] == [a.tobytes() for a in whole], "and this in the last bit of a double"
    reach = block.rect.grow(2 * 20_000 + 2)
    assert all(reach.contains(rect) for rect in seen)
    assert got.margin <= 2 * 20_000 + 2


def test_far_points_decide_and_are_asked_for():
    """A point 15 m outside the block lies in the circle of a triangle within; a first look at the block misses it."""
    near = [[2_000, 2_000, 0], [20_000, 2_000, 0], [11_000, 20_000, 9_000]]
    params = DtmParams(max_edge=60.0)
    with sizes():
        block = DtmGrid(1000).block(-1, 0)
        for far in ([11_000, -3_000, 0], [26_000, 26_000, 50_000], [-9_000, 20_000, 50_000]):
            points = np.array([*near, far])
            alone = rasterize_block(block, loader(points[:3]), params, first_margin=0)
            got = rasterize_block(block, loader(points), params, first_margin=0)
            assert as_bytes(got)[:2] == as_float32(at_once(points, block, [60_000]))[:2]
            assert got.height.tobytes() != alone.height.tobytes()


def test_the_far_side_of_a_circle_is_looked_at():
    """The last point lies just inside the circle of the others and nearly 2 `max_edge` from the pixels they hold."""
    radius, middle = 7990, (30_900, 12_000)
    arc = [
        [round(middle[0] + radius * math.cos(a)), round(middle[1] + radius * math.sin(a)), 0]
        for a in (2.65, math.pi, 3.63)
    ]
    far = [middle[0] + radius - 30, middle[1], 0]
    with sizes():
        block = DtmGrid(1000).block(-1, 0)
        alone, got = (
            rasterize_block(block, loader(np.array(p)), DtmParams(max_edge=8.0), first_margin=0)
            for p in (arc, [*arc, far])
        )
    assert np.isfinite(alone.height).any()
    assert np.isnan(got.height).all()


def test_the_nearest_point_is_looked_for_even_where_all_heights_are_proven():
    """A round hole up to the block's edge: its circle lies in the block, but a point outside is nearer than its rim."""
    gx, gy = np.meshgrid(np.arange(50, 23_600, 500), np.arange(-5270, 30_000, 500))
    xy = np.column_stack([gx.ravel(), gy.ravel()])
    xy = xy[np.hypot(xy[:, 0] - 19_200, xy[:, 1] - 12_000) > 4750]
    rim = [[23_550, 12_000 - 1908], [23_550, 12_000 + 1908], [14_450, 12_000]]
    points = np.column_stack([np.vstack([xy, rim, [[24_300, 12_000]]]), np.zeros(len(xy) + 4, int)])
    with sizes():
        block = DtmGrid(1000).block(-1, 0)
        got = rasterize_block(block, loader(points), DtmParams(max_edge=20.0), first_margin=0)
        assert as_bytes(got)[:2] == as_float32(at_once(points, block, [20_000]))[:2]
    assert got.distance[SIDE - 12, -1] == np.float32(math.hypot(0.8, 0.5))


def test_a_plane_comes_back_and_the_place_of_a_pixel_is_its_centre():
    rng = np.random.default_rng(1)
    xy = rng.integers(-60_000, 60_000, (6000, 2)) * 10
    points = np.column_stack([xy, 300_000 + xy[:, 0] // 10 - 3 * (xy[:, 1] // 10)])
    params = DtmParams(resolution=0.25)
    with sizes():
        block = DtmGrid(250).block(3, -2)
        got = rasterize_block(block, loader(points), params)
        x, y = (centres(block, 250) / 1000).T
    assert (x[0], y[0]) == (-2 * SIDE * 0.25 + 0.125, -3 * SIDE * 0.25 - 0.125)
    # float32 rounds 300 m by at most 2**-16 m.
    np.testing.assert_allclose(got.height.ravel(), 300 + 0.1 * x - 0.3 * y, atol=2**-16, rtol=0)
    assert got.height.dtype == got.distance.dtype == np.float32


def test_gridded_ground_gives_its_own_heights_and_no_holes():
    """Every four neighbours lie on one circle; pixel centres lie on points and, shifted, on edges."""
    rng = np.random.default_rng(2)
    for shift in (500, 0):
        gx, gy = np.meshgrid(np.arange(-5, SIDE + 6), np.arange(-5, SIDE + 6))
        z = rng.integers(0, 50_000, gx.shape)
        points = np.column_stack([gx.ravel() * 1000 + shift, gy.ravel() * 1000 + shift, z.ravel()])
        with sizes():
            got = rasterize_block(DtmGrid(1000).block(-1, 0), loader(points), DtmParams())
        assert not np.isnan(got.height).any()
        own = z[5 : 5 + SIDE, 5 : 5 + SIDE][::-1] / 1000
        if shift:
            np.testing.assert_array_equal(got.height, own.astype(np.float32))
            assert (got.distance == 0).all()
        else:
            np.testing.assert_array_equal(got.distance, np.float32(math.sqrt(0.5)))


def test_of_points_at_one_place_the_lowest_counts():
    points = np.array([[x, y, z] for x in (0, 30_000) for y in (0, 30_000) for z in (9000, 4000, 7000)])
    with sizes():
        got = rasterize_block(DtmGrid(1000).block(-1, 0), loader(points), DtmParams())
    assert (got.height == 4).all()


LINE = [[k * 999, 2 * k * 999, k] for k in range(20)]


@pytest.mark.parametrize(
    "points",
    [[], [[5000, 5000, 0]], [[5000, 5000, 0]] * 5, [[1000, 1000, 0], [9000, 5000, 1]], LINE],
    ids=["none", "one", "one place", "two", "line"],
)
def test_too_few_points_and_points_on_a_line_give_no_height(points):
    cloud = np.array(points, dtype=np.int64).reshape(-1, 3)
    with sizes():
        block = DtmGrid(1000).block(-1, 0)
        got = rasterize_block(block, loader(cloud), DtmParams(max_edge=10.0, fill_edge=11.0))
        pixels = centres(block, 1000)
    assert np.isnan(got.height).all()
    assert np.isnan(got.filled).all()
    d = np.full(len(pixels), np.inf)
    for p in points:
        d = np.minimum(d, np.hypot(*(pixels - p[:2]).T) / 1000)
    d[d > 11] = np.inf
    np.testing.assert_allclose(got.distance.ravel(), d, rtol=1e-7)


def test_a_lake_stays_open_and_can_be_filled():
    rng = np.random.default_rng(3)
    xy = rng.integers(-60_000, 90_000, (20_000, 2))
    radius = np.hypot(*(xy - 12_000).T)
    xy = xy[radius > 11_000]
    points = np.column_stack([xy, np.full(len(xy), 7000)])
    with sizes():
        block = DtmGrid(1000).block(-1, 0)
        got = rasterize_block(block, loader(points), DtmParams(max_edge=10.0, fill_edge=30.0))
        plain = rasterize_block(block, loader(points), DtmParams(max_edge=10.0))
        off = np.hypot(*(centres(block, 1000) - 12_000).T).reshape(SIDE, SIDE)
    # The points around are about 1 m apart: within 2 m of the shore all is certain.
    assert np.isnan(got.height[off < 8_000]).all()
    assert not np.isnan(got.height[off > 13_000]).any()
    assert (got.filled == 7).all()
    np.testing.assert_array_equal(got.height, plain.height)
    assert plain.filled is None
    assert np.isfinite(got.distance).all()
    assert got.distance[off < 1000].min() > 10
    assert np.isinf(plain.distance[off < 1000]).all()


def test_a_flat_triangle_with_a_wide_circle_gives_no_height():
    """Its edges are short, but its circle of 50 m tells of a hole that could not be proven from nearby."""
    points = np.array([[0, 10_000, 0], [10_000, 10_500, 0], [20_000, 10_000, 0]])
    assert not rule(*map(tuple, points.tolist()), 50_000)
    assert rule(*map(tuple, points.tolist()), 101_000)
    fine = DtmParams(resolution=0.1, max_edge=50.0, fill_edge=101.0)
    with sizes(BLOCK=256):
        got = rasterize_block(DtmGrid(100).block(-1, 0), loader(points), fine)
    assert np.isnan(got.height).all()
    assert (got.filled == 0).any()


def test_heights_in_feet_and_distances_in_metres():
    points = np.array([[x, y, 3048] for x in (-5000, 29_500) for y in (-5000, 29_500)])
    with sizes():
        got = rasterize_block(DtmGrid(1000).block(-1, 0), loader(points), DtmParams(), unit_z=0.3048)
    assert (got.height == 10).all()
    assert got.distance[0, -1] == np.float32(math.hypot(6, 6))


# -- the raster -------------------------------------------------------------------------------------------------------


def test_a_resolution_or_an_edge_must_be_whole_millimetres():
    assert DtmGrid.from_params(DtmParams(resolution=0.3)).resolution == 300
    with pytest.raises(ParameterError, match=r"resolution = 0\.3333 m is not a whole number of millimetres"):
        DtmGrid.from_params(DtmParams(resolution=0.3333))
    with pytest.raises(ParameterError, match="max_edge"):
        rasterize_block(DtmGrid(1000).block(0, 0), loader(np.zeros((0, 3))), DtmParams(max_edge=10.0001))
    with pytest.raises(ParameterError, match="fill_edge"):
        DtmParams(max_edge=10.0, fill_edge=9.0)


@given(st.integers(-(10**10), 10**10), st.integers(-(10**10), 10**10), st.integers(50, 10_000))
@settings(deadline=None)
def test_every_place_lies_in_one_block_of_the_raster_around_it(x, y, resolution):
    grid = DtmGrid(resolution)
    (block,) = grid.over(Rect(x, y, x + 1, y + 1))
    assert block.rect.contains(Rect(x, y, x + 1, y + 1))
    assert grid.block(block.row, block.col) == block
    raster = Raster.over(grid, Rect(x - 3 * resolution * dtm.BLOCK, y, x + 1, y + 1))
    row, col = raster.offset(block)
    assert raster.rect.x0 + col * resolution == block.rect.x0
    assert raster.rect.y1 - row * resolution == block.rect.y1
    assert len({b.id for b in grid.over(raster.rect)}) == raster.rows * raster.cols == 4
    xs, ys = raster.centres()
    assert (len(ys), len(xs)) == raster.shape
    assert xs[0] == pytest.approx((raster.rect.x0 + resolution / 2) / 1000, rel=1e-15)
    assert ys[-1] == pytest.approx((raster.rect.y0 + resolution / 2) / 1000, rel=1e-15)
