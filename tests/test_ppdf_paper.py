"""PPDF as published: equal to its plain twin, to cases worked out by hand, and to itself however the survey is cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle_paper as oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask.filters import classify_ground, of, parameters
from ppdf_dask.filters.cloud import Cloud, cloud_from_grid, cloud_from_xyz
from ppdf_dask.filters.ppdf.paper import _plane_kernels
from ppdf_dask.filters.ppdf.paper.classify import classify, stages
from ppdf_dask.filters.ppdf.paper.growth import grow
from ppdf_dask.filters.ppdf.paper.params import PaperParams
from ppdf_dask.filters.ppdf.paper.squares import sort_by_square
from ppdf_dask.grid import Rect

# Small squares, short search: many cells, many passes and every fallback within a few dozen points.
SMALL = PaperParams(
    plane_size=4.0, min_inliers=4, search_limit=6.0, classification_distance=0.8, division_distance=0.4,
    inlier_distance=0.2, seed_distance=0.2, canopy_height=3.0, canopy_cell=1.5,
)  # fmt: skip
variants = st.sampled_from(
    [
        SMALL,
        SMALL.replace(neighbours="nearest"),
        SMALL.replace(seeds="local_minimum"),
        SMALL.replace(seeds="local_minimum", neighbours="nearest", min_neighbours=3),
        SMALL.replace(min_neighbours=4, plane_size=3.0, canopy_cell=2.0),
    ]
)


@st.composite
def clouds(draw, most=70, side=12.0):
    """Random and nasty clouds, absolute millimetres: gridded, duplicated, collinear, steep, sparse, one stray."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.integers(0, most))
    x, y = rng.uniform(-side / 3, side, (2, n))
    kind = draw(st.sampled_from(["rough", "line", "identical", "sparse", "steep", "steps"]))
    if kind == "line":
        y = 0.5 * x
    if kind == "sparse":
        x, y = 8 * x, 8 * y
    slope = draw(st.sampled_from([0.0, 0.3, 1.7 if kind != "steep" else 8.0]))
    z = slope * x + rng.normal(0, 0.1, n) + np.where(rng.random(n) < 0.3, rng.exponential(1.5, n), 0.0)
    if kind == "steps":
        z += 2.0 * (x > side / 3)
    if kind == "identical":
        x, y, z = (np.full(n, v) for v in (1.5, 2.5, 3.0))
    z -= np.where(rng.random(n) < 0.05, 4.0, 0.0)
    step = draw(st.sampled_from([1, 250, 1000]))
    mm = np.rint(np.column_stack([x, y, z]) * 1000 / step).astype(np.int64) * step
    if n and draw(st.booleans()):
        mm = np.vstack([mm, mm[rng.integers(0, n, n // 3)]])
    if n and draw(st.integers(0, 4)) == 0:
        mm = np.vstack([mm, [[1_900_000_000, 1_500_000_000, 7_000]]])
    return mm + np.array(draw(st.sampled_from([(0, 0, 0), (-7_000, 500_001_003, 0), (512_345_678, 5_400_000_500, 0)])))


def cloud_of(points):
    return cloud_from_grid(*np.asarray(points, np.int64).reshape(-1, 3).T)


@settings(max_examples=120, deadline=None)
@given(points=clouds(), params=variants)
def test_every_stage_equals_the_plain_twin(points, params):
    got = stages(cloud_of(points), params)
    ground, seeds, under, planes, close = oracle.classify(points, params)
    # Same order of operations: not even at a threshold may the two differ.
    differing = int((got.ground != ground).sum() + (got.seeds != seeds).sum())
    assert differing == 0, f"{differing} labels differ; {close.count} comparisons were within 1e-9 of their limit"
    assert (got.under_canopy == under).all()
    level = np.rint(np.log2(params.plane_size / got.planes.size)).astype(int)
    address = np.rint(got.planes.corner / got.planes.size[:, None]).astype(int)
    assert sorted(zip(*address.T.tolist(), level.tolist(), got.planes.support.tolist(), strict=True)) == planes


@settings(max_examples=40, deadline=None)
@given(points=clouds(most=40), data=st.data())
def test_fixed_points_are_seeds_and_pass_their_label_to_duplicates(points, data):
    fixed = np.array(data.draw(st.lists(st.booleans(), min_size=len(points), max_size=len(points))), bool)
    params = SMALL.replace(min_inliers=50)
    got = classify(replace(cloud_of(points), fixed=fixed), params)
    assert (got.ground == oracle.classify(points, params, fixed)[0]).all()
    assert got.ground[fixed].all()


def scene(seed, n=700, side=60.0, step=1):
    """Hills with holes, a cliff, vegetation and low outliers; absolute millimetres."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, side, (n, 2))
    for _ in range(rng.integers(0, 3)):
        xy = xy[np.abs(xy - rng.uniform(0, side, 2)).max(axis=1) > rng.uniform(1, 10)]
    x, y = xy.T
    z = rng.uniform(0, 5) * np.sin(x / 9) * np.cos(y / 12) + rng.uniform(-0.7, 0.7) * x + 3.0 * (x > rng.uniform(0, 90))
    z += np.where(rng.random(len(x)) < 0.35, rng.exponential(2.0, len(x)), 0.0)
    z -= np.where(rng.random(len(x)) < 0.01, 5.0, 0.0)
    mm = np.rint(np.column_stack([x, y, z]) * 1000 / step).astype(np.int64) * step
    return mm + np.array([480_003_000, 5_400_001_000, 0])


def crop(points, rect):
    x, y, _ = points.T
    inside = np.flatnonzero((x >= rect.x0) & (x < rect.x1) & (y >= rect.y0) & (y < rect.y1))
    near = (points[inside] - [rect.x0, rect.y0, 0]).astype(np.int32)
    return inside, Cloud(*near.T.copy(), (rect.x0, rect.y0), len(inside), rect)


seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=150, deadline=None)
@given(seed=seeds, cut=st.tuples(*[st.floats(0, 0.45)] * 4), step=st.sampled_from([1, 500]), params=variants)
def test_what_is_proven_in_a_crop_is_true_of_the_whole(seed, cut, step, params):
    points = scene(seed, step=step)
    whole = classify(cloud_of(points), params)
    assert not whole.unproven.any()
    (x0, y0, _), (x1, y1, _) = points.min(axis=0), points.max(axis=0) + 1
    w, h = x1 - x0, y1 - y0
    rect = Rect(int(x0 + cut[0] * w), int(y0 + cut[1] * h), int(x1 - cut[2] * w), int(y1 - cut[3] * h))
    inside, cloud = crop(points, rect)
    part = classify(cloud, params)
    wrong = (part.ground != whole.ground[inside]) & ~part.unproven
    assert not wrong.any()


def test_a_wide_buffer_proves_the_core():
    points = scene(3, n=6000, side=120.0)
    params = SMALL.replace(min_inliers=6)
    whole = classify(cloud_of(points), params)
    x0, y0 = (int(v) for v in points.min(axis=0)[:2])
    core = Rect(x0 + 40_000, y0 + 40_000, x0 + 80_000, y0 + 80_000)
    left = []
    for buffer in (0, 5_000, 30_000):
        inside, cloud = crop(points, core.grow(buffer))
        x, y = points[inside, 0], points[inside, 1]
        own = (x >= core.x0) & (x < core.x1) & (y >= core.y0) & (y < core.y1)
        part = classify(cloud, params)
        assert (part.ground == whole.ground[inside])[~part.unproven].all()
        left.append(int(part.unproven[own].sum()))
    assert left[0] > left[1] > left[2] == 0


@settings(max_examples=40, deadline=None)
@given(seed=seeds, step=st.sampled_from([1, 500]), params=variants)
def test_order_origin_and_duplicates_decide_nothing(seed, step, params):
    rng = np.random.default_rng(seed)
    points = scene(seed, n=400, side=30.0, step=step)
    points = np.vstack([points, points[rng.integers(0, len(points), 100)]])
    once = classify(cloud_of(points), params).ground
    order = rng.permutation(len(points))
    assert (classify(cloud_of(points[order]), params).ground == once[order]).all()
    labels = {}
    for p, g in zip(map(tuple, points), once, strict=True):
        assert labels.setdefault(p, g) == g
    shift = np.array([-12_345, 777, 0])
    base = points.min(axis=0) * [1, 1, 0] + shift
    moved = Cloud(*(points - base).astype(np.int32).T.copy(), (int(base[0]), int(base[1])), len(points))
    assert (classify(moved, params).ground == once).all()


@settings(max_examples=30, deadline=None)
@given(seed=seeds, squares=st.tuples(st.integers(-(10**6), 10**6), st.integers(-(10**6), 10**6)), up=st.integers(-9, 9))
def test_moving_the_cloud_by_whole_squares_moves_the_answer(seed, squares, up):
    # Random numbers belong to the place, so only the seeds without them can move; growth and canopy know no place.
    params = SMALL.replace(seeds="local_minimum")
    points = scene(seed, n=300, side=25.0)
    moved = points + np.array([squares[0] * 4000, squares[1] * 4000, up * 1000])
    assert (classify(cloud_of(moved), params).ground == classify(cloud_of(points), params).ground).all()


def test_moving_a_clean_plane_by_whole_squares_moves_its_planes():
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.5, 30), np.arange(0.5, 30)))
    for shift in (0.0, -70.0, 123_450.0):
        found = stages(cloud_from_xyz(np.column_stack([x + shift, y, 0.25 * x])), PaperParams())
        assert found.ground.all()
        assert sorted(found.planes.corner[:, 0] - shift) == [0.0] * 3 + [10.0] * 3 + [20.0] * 3


def test_extremes_of_extent_sort_like_the_integer_key():
    rng = np.random.default_rng(1)
    x = rng.integers(-(2**31), 2**31, 50).astype(np.int32)
    y = rng.integers(-(2**31), 2**31, 50).astype(np.int32)
    z = rng.integers(0, 9, 50).astype(np.int32)
    wide = Cloud(*(np.concatenate([v, v]) for v in (x, y, z)), (0, 0), 100)
    squares = sort_by_square(wide, 10_000)
    rows = [(i // 10_000, j // 10_000, i, j, k) for i, j, k in zip(*(v.tolist() for v in (x, y, z)), strict=True)] * 2
    assert [rows[i] for i in squares.order] == sorted(rows)


def test_trials_follow_the_confidence_formula():
    # ceil(ln 0.01 / ln(1 - w^3)): 168 at w = 0.3 (167.2 ...), 574 at w = 0.2, clipped at both ends.
    assert [_plane_kernels.trials_needed(k, 100) for k in (100, 30, 20, 5)] == [50, 169, 574, 1000]


def square_ground(size=10, slope=0.1):
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.5, size), np.arange(0.5, size)))
    return np.column_stack([x, y, slope * x])


def test_one_plane_per_square_and_a_split_where_points_lie_below():
    flat = square_ground(slope=0.0)
    assert stages(cloud_from_xyz(flat), PaperParams()).planes.size.tolist() == [10.0]
    # A ditch 2 m deep in one quarter: the square fails the reliability test, the other quarters keep their planes.
    ditch = flat.copy()
    ditch[(ditch[:, 0] < 5) & (ditch[:, 1] < 5), 2] = -2.0
    planes = stages(cloud_from_xyz(ditch), PaperParams()).planes
    assert sorted(planes.size) == [5.0] * 4
    assert sorted(planes.point[:, 2]) == [-2.0, 0.0, 0.0, 0.0]
    # 0.999 m deep is still the same plane.
    ditch[:, 2] /= 2.002
    assert stages(cloud_from_xyz(ditch), PaperParams()).planes.size.tolist() == [10.0]


def test_fewer_inliers_than_asked_for_make_no_plane():
    flat = square_ground(slope=0.0)[:20]
    assert len(stages(cloud_from_xyz(flat), PaperParams()).planes) == 1
    assert len(stages(cloud_from_xyz(flat[:19]), PaperParams()).planes) == 0


def test_walls_make_no_plane():
    z, x = (v.ravel() for v in np.meshgrid(np.arange(0, 4, 0.2), np.arange(0.5, 9)))
    assert len(stages(cloud_from_xyz(np.column_stack([x, 0 * x + 5, z])), PaperParams()).planes) == 0


CROSS = np.array([[10, 1, 0], [-1, 10, 0], [-10, -1, 0], [1, -10, 0]]) * 100


def grown(heights, z, params=None):
    """The state of a point at (0, 0, z) amid one ground point per quadrant, 1 m away; lengths in mm."""
    points = np.vstack([CROSS + np.column_stack([np.zeros((4, 2), int), heights]), [[0, 0, z]]]).astype(np.int32)
    state, _ = grow(tuple(points.T.copy()), np.array([1, 1, 1, 1, 0], np.uint8), 1.0, None, params or PaperParams())
    return int(state[-1])


def test_acceptance_is_strict_symmetric_and_perpendicular():
    flat = [0, 0, 0, 0]
    assert [grown(flat, z) for z in (1499, 1500, -1499, -1500)] == [1, 0, 1, 0]
    # On a slope of 1 (45 degrees) 1.5 m perpendicular are 2.121 m vertical.
    steep = [1000, -100, -1000, 100]
    assert [grown(steep, z) for z in (2121, 2122, -2121, -2122)] == [1, 0, 1, 0]


def test_a_plane_steeper_than_80_degrees_gives_its_mean_height():
    wall = [8000, -800, -8000, 800]
    assert [grown(wall, z) for z in (1499, 1500)] == [1, 0]


def test_few_neighbours_give_the_distance_weighted_mean_height():
    points = np.array([[1000, 0, 0], [-3000, 0, 4000], [0, 0, 2499], [0, 0, 2500]], np.int32)
    state = np.array([1, 1, 0, 0], np.uint8)
    # Weights 1 and 1/3: mean height 1 m.
    for fewest, want in ((1, [1, 1, 1, 0]), (3, [1, 1, 0, 0])):
        params = PaperParams(min_neighbours=fewest)
        assert grow(tuple(points.T.copy()), state, 1.0, None, params)[0].tolist() == want


def test_growth_climbs_pass_by_pass_as_published():
    # A flight of steps of 1.4 m: literal acceptance takes each step in its own pass (the method's known runaway).
    points = np.array([[k * 1000, 0, k * 1400] for k in range(6)], np.int32)
    state, passes = grow(tuple(points.T.copy()), np.array([1, 0, 0, 0, 0, 0], np.uint8), 1.0, None, PaperParams())
    assert (state.tolist(), passes) == ([1] * 6, 6)


def test_the_search_ends_at_its_limit():
    points = np.array([[0, 0, 0], [50_000, 0, 0], [-50_001, 0, 0]], np.int32)
    assert grow(tuple(points.T.copy()), np.array([1, 0, 0], np.uint8), 1.0, None, PaperParams())[0].tolist() == [
        1,
        1,
        0,
    ]


@pytest.mark.parametrize("n", [0, 1, 2])
def test_two_points_are_not_ground(n):
    assert not classify(cloud_from_xyz(np.zeros((n, 3)) + np.arange(n)[:, None]), PaperParams()).ground.any()


def test_identical_and_far_points_are_harmless():
    many = np.zeros((5000, 3))
    assert not classify(cloud_from_xyz(many), PaperParams()).ground.any()
    far = np.vstack([square_ground(30), [[2_000_000.0, 2_000_000.0, 5.0]], [[5.0, 5.0, 1e6]], [[5.1, 5.0, -1e6]]])
    ground = classify(cloud_from_xyz(far), PaperParams()).ground
    assert not ground[-3:].any()
    assert ground[:-3].mean() > 0.9


def test_a_tie_just_beyond_the_searched_buckets_is_seen():
    # Four points per m2 make buckets of 1 m. In the first quadrant of (600, 600) a ground point lies 400 mm away, as
    # far as the bucket's edge, where a lower one waits at the same distance; the other quadrants are settled at once.
    others = [[320, 880, 0], [320, 320, 0], [880, 320, 0]]
    points = np.array([[0, 0, 90_000], [600, 600, 1000], [840, 920, 0], [1000, 600, -20_000], *others], np.int32)
    start = np.array([0, 0, 1, 1, 1, 1, 1], np.uint8)
    for last, accepted in ((-20_000, 0), (20_000, 1)):
        points[3, 2] = last
        assert grow(tuple(points.T.copy()), start, 4.0, None, PaperParams())[0][1] == accepted


@pytest.mark.parametrize("turn", range(4))
def test_a_point_is_proven_only_if_a_nearer_or_equal_neighbour_cannot_hide(turn):
    # The nearest ground of the first quadrant lies 1 m away; an unknown point straight to the right could tie with it.
    points = np.array([[0, 0, 0], [800, 600, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    for hidden_from, state in ((1000, 3), (1001, 1)):
        box = np.array([[-5000, -5000], [hidden_from - 1, 5000]])
        turned, corners = points.copy(), box.copy()
        for _ in range(turn):
            turned[:, :2] = np.column_stack([-turned[:, 1], turned[:, 0]])
            corners = np.column_stack([-corners[:, 1], corners[:, 0]])
        (x0, y0), (x1, y1) = corners.min(axis=0).tolist(), (corners.max(axis=0) + 1).tolist()
        got, _ = grow(
            tuple(turned.astype(np.int32).T.copy()),
            np.array([0, 1, 1, 1, 1], np.uint8), 1.0, Rect(x0, y0, x1, y1), PaperParams(),
        )  # fmt: skip
        assert got[0] == state


def test_an_unproven_neighbour_makes_unproven_unless_it_is_farther():
    near = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * 1000
    for place, state in ((900, 3), (1100, 1)):
        points = np.vstack([near, [[place, 900, 9000], [0, 0, 0]]]).astype(np.int32)
        start = np.array([1, 1, 1, 1, 2, 0], np.uint8)
        got, _ = grow(tuple(points.T.copy()), start, 1.0, Rect(-9000, -9000, 9000, 9000), PaperParams(search_limit=5.0))
        assert got[5] == state


def test_a_canopy_cell_cut_by_the_edge_makes_its_square_unproven():
    # Squares of 3 m, canopy cells of 2 m: the cell from 2 to 4 m reaches over the square's edge at 3 m.
    params = PaperParams(plane_size=3.0, canopy_cell=2.0, min_inliers=3, canopy_height=1.0)
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0.25, 3, 0.5), np.arange(0.25, 3, 0.5)))
    points = np.rint(np.column_stack([x, y, 0 * x]) * 1000).astype(np.int64)
    unproven = [crop_verdict(points, Rect(-9000, -9000, edge, 9000), params) for edge in (3000, 4000)]
    assert unproven[0].all()
    # The square itself is then settled: its seeds are proven ground whatever lies beyond.
    assert not unproven[1].any()


def crop_verdict(points, rect, params):
    return classify(crop(points, rect)[1], params).unproven


def test_the_published_method_is_a_profile_of_ppdf():
    paper = parameters("ppdf", "paper")
    assert paper == PaperParams()
    points = scene(5, n=3000) / 1000
    assert (classify_ground(points, paper) == classify(cloud_from_xyz(points), PaperParams()).ground).all()
    assert of(paper).required_buffer(paper) == 50.0
