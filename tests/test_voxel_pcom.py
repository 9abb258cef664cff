"""The voxel filter and PCOM against a plain oracle (dictionaries of voxels) and against cases done by hand."""

import itertools
import math
import statistics
import tracemalloc
import warnings
from collections import defaultdict
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask import filters
from ppdf_dask.errors import ParameterError
from ppdf_dask.filters import pcom, voxel
from ppdf_dask.filters._clusters import above_neighbours, touching, window_clusters
from ppdf_dask.filters.cloud import Density, cloud_from_grid
from ppdf_dask.filters.pcom import PcomParams
from ppdf_dask.filters.voxel import VoxelParams
from ppdf_dask.grid import Rect
from ppdf_dask.params import DtmParams

# ---------------------------------------------------------------- the oracle


def columns_of(points, edge):
    """{(i, j): {layer: [points]}} of integer points."""
    columns = defaultdict(lambda: defaultdict(list))
    for p in points:
        columns[p[0] // edge, p[1] // edge][p[2] // edge].append(p)
    return columns


def lowest_level(points, edge):
    """3D Forest: a voxel is low if it is the first occupied one, or the second and adjacent to the first."""
    low = set()
    for stack in columns_of(points, edge).values():
        layers = sorted(stack)
        low |= set(stack[layers[0]])
        if len(layers) > 1 and layers[1] == layers[0] + 1:
            low |= set(stack[layers[1]])
    return low


def rounded_mean(values):
    return math.floor(Fraction(sum(values), len(values)) + Fraction(1, 2))


def clusters(members, linked):
    """Connected components, by flooding."""
    left, found = set(members), []
    while left:
        front = [left.pop()]
        cluster = set(front)
        while front:
            a = front.pop()
            near = {b for b in left if linked(a, b)}
            left -= near
            cluster |= near
            front.extend(near)
        found.append(cluster)
    return found


def is_outline(column, columns):
    i, j = column
    row = [b for a, b in columns if a == i]
    line = [a for a, b in columns if b == j]
    return j in (min(row), max(row)) or i in (min(line), max(line))


def pcom_level(points, edge, params):
    columns = columns_of(points, edge)
    layer = {c: min(stack) for c, stack in columns.items()}
    centroid = {
        c: tuple(rounded_mean([p[k] for p in stack[layer[c]]]) for k in range(3)) for c, stack in columns.items()
    }

    def within(a, b, distance):
        return sum((centroid[a][k] - centroid[b][k]) ** 2 for k in (0, 1)) <= distance**2

    smallest = max(params.min_voxels, math.ceil(Fraction(round(params.min_area * 10**6), edge**2)))
    tolerance, h = round(params.tolerance * edge), params.half_window
    large = set()
    for k in range(min(layer.values()) - h, max(layer.values()) + h + 1):
        window = [c for c in columns if abs(layer[c] - k) <= h]
        for cluster in clusters(window, lambda a, b: within(a, b, tolerance)):
            bordering = any(is_outline(c, columns) for c in cluster)
            if len(cluster) >= smallest or (bordering and 2 * len(cluster) >= smallest):
                large |= cluster
    kept = set()
    for c in large:
        around = [centroid[b][2] for b in large if b != c and within(b, c, 3 * edge)]
        if not around or centroid[c][2] - statistics.median(around) <= round(params.interior * edge):
            kept.add(c)
    ground = set()
    for c, stack in columns.items():
        if c in kept:
            ground |= set(stack[layer[c]]) | set(stack.get(layer[c] + 1, []))
        elif c not in large:
            eight = [(c[0] + a, c[1] + b) for a, b in itertools.product((-1, 0, 1), repeat=2) if a or b]
            if sum(b in kept and abs(layer[b] - layer[c]) <= 1 for b in eight) >= 3:
                ground |= set(stack[layer[c]])
    return ground


def oracle(points, params):
    """Classify integer points in mm; returns a list of bool."""
    r = round(params.resolution * 1000)

    def level(some, edge):
        return pcom_level(some, edge, params) if isinstance(params, PcomParams) else lowest_level(some, edge)

    per_coarse = defaultdict(list)
    for p in points:
        per_coarse[p[0] // (5 * r), p[1] // (5 * r)].append(p)
    solid = {c for c, ps in per_coarse.items() if len(ps) >= 3 and len(set(ps)) > 1}
    first = {p for p in level(points, 5 * r) if (p[0] // (5 * r), p[1] // (5 * r)) in solid} if points else set()
    if not first:
        return [False] * len(points)
    ground = level([p for p in points if p in first], r // 2) & level(points, r)
    return [p in ground for p in points]


# ---------------------------------------------------------------- clouds

FILTERS = {VoxelParams: voxel, PcomParams: pcom}


def classify(points, params, origin=(0, 0)):
    x, y, z = np.array(points, np.int64).reshape(-1, 3).T
    cloud = cloud_from_grid(x + origin[0], y + origin[1], z)
    return FILTERS[type(params)].classify(cloud, params).ground


@st.composite
def clouds(draw):
    """Rough terrain with layers above it, clumps, duplicates, points on voxel faces, strays near and far."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.integers(0, 250))
    extent, step = draw(st.sampled_from([(300, 1), (1500, 1), (1000, 10), (2000, 50)]))
    x, y = rng.integers(-extent, extent, (2, n)) // step * step
    slope = draw(st.sampled_from([0, 0.1, 1]))
    z = (slope * x).astype(np.int64) + rng.integers(-15, 15, n) // step * step
    up = rng.uniform(size=n) < draw(st.sampled_from([0, 0.3]))
    z[up] += rng.integers(0, 800, int(up.sum()))
    points = list(zip(x.tolist(), y.tolist(), z.tolist(), strict=True))
    points += points[: draw(st.integers(0, 5))]
    points += draw(st.lists(st.tuples(*[st.integers(-5000, 5000)] * 3), max_size=3))
    if draw(st.booleans()):
        points.append((900_000_000, -900_000_000, draw(st.integers(-10_000, 10_000))))
    return points


voxel_params = st.builds(VoxelParams, resolution=st.sampled_from([0.02, 0.1, 0.3]))
pcom_params = st.builds(
    PcomParams,
    resolution=st.sampled_from([0.04, 0.1, 0.3]),
    min_area=st.sampled_from([0.0, 0.02, 0.2, 1.0]),
    min_voxels=st.sampled_from([1, 3, 5]),
    tolerance=st.sampled_from([1.0, 1.5, 2.5, 3.01]),
    half_window=st.sampled_from([0, 1, 2]),
    interior=st.sampled_from([0.1, 1.5]),
)
EXAMPLES = settings(max_examples=80, deadline=None)


@EXAMPLES
@given(clouds(), voxel_params | pcom_params)
def test_agrees_with_the_oracle(points, params):
    assert classify(points, params).tolist() == oracle(points, params)


@EXAMPLES
@given(st.integers(0, 2**32 - 1), st.integers(1, 25), st.integers(4, 13), st.integers(0, 2))
def test_clusters_of_every_window_agree_with_flooding(seed, m, tolerance, half):
    edge = 4  # few places, so that many distances equal the tolerance
    rng = np.random.default_rng(seed)
    ix, iy = (v.astype(np.int64) for v in np.divmod(np.sort(rng.choice(64, m, replace=False)), 8))
    layer = rng.integers(-3, 3, m)
    cx, cy = ix * edge + rng.integers(0, edge, m), iy * edge + rng.integers(0, edge, m)
    name = window_clusters(ix, iy, layer, cx, cy, (tolerance - 1) // edge + 1, tolerance, half)
    for k in range(-6, 6):
        window = [i for i in range(m) if abs(layer[i] - k) <= half]
        found = defaultdict(set)
        for i in window:
            found[name[i, k - layer[i] + half]].add(i)
        expected = clusters(window, lambda a, b: (cx[a] - cx[b]) ** 2 + (cy[a] - cy[b]) ** 2 <= tolerance**2)
        assert sorted(map(sorted, found.values())) == sorted(map(sorted, expected))


@EXAMPLES
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(0, 3))
def test_local_medians_and_contacts_agree_with_their_definition(seed, m, excess):
    edge, radius = 4, 12
    rng = np.random.default_rng(seed)
    ix, iy = (v.astype(np.int64) for v in np.divmod(np.sort(rng.choice(64, m, replace=False)), 8))
    cx, cy, cz = ix * edge + rng.integers(0, edge, m), iy * edge + rng.integers(0, edge, m), rng.integers(0, 8, m)
    kept, layer = rng.uniform(size=m) < 0.7, cz // edge
    out = above_neighbours(ix, iy, cx, cy, cz, kept, 3, radius, excess)
    contacts = touching(ix, iy, layer, kept)
    for i in range(m):
        others = [j for j in range(m) if j != i and kept[j]]
        near = [cz[j] for j in others if (cx[i] - cx[j]) ** 2 + (cy[i] - cy[j]) ** 2 <= radius**2]
        assert out[i] == bool(kept[i] and near and cz[i] - np.median(near) > excess)
        eight = [j for j in others if max(abs(ix[i] - ix[j]), abs(iy[i] - iy[j]), abs(layer[i] - layer[j])) == 1]
        assert contacts[i] == len(eight)


@EXAMPLES
@given(clouds(), st.sampled_from([VoxelParams(), PcomParams(min_area=0.05)]), st.randoms(use_true_random=False))
def test_order_and_place_do_not_matter(points, params, random):
    shuffled = list(range(len(points)))
    random.shuffle(shuffled)
    whole = classify(points, params)
    assert classify([points[k] for k in shuffled], params).tolist() == whole[shuffled].tolist()
    # a shift by whole coarse voxels leaves every voxel as it is
    assert classify(points, params, origin=(500 * 1_000_000, -500 * 7)).tolist() == whole.tolist()


@EXAMPLES
@given(clouds(), st.integers(-2000, 2000), st.integers(1, 3000))
def test_the_voxel_filter_shows_no_seam(points, x0, width):
    params = VoxelParams()
    core = [p for p in points if x0 <= p[0] < x0 + width]
    if not core:
        return
    near = [p for p in points if not x0 <= p[0] < x0 + width and x0 - 500 <= p[0] < x0 + width + 500]
    x, y, z = np.array(core + near, np.int64).T
    cloud = replace(cloud_from_grid(x, y, z), n_core=len(core), known=Rect(x0 - 500, -(10**9), x0 + width + 500, 10**9))
    verdict = voxel.classify(cloud, params)
    assert not verdict.unproven.any()
    whole = dict(zip(points, classify(points, params).tolist(), strict=True))
    assert verdict.ground.tolist() == [whole[p] for p in core]


def test_a_column_cut_by_the_known_area_is_unproven():
    for low, high, partial in ((100, 1900, True), (0, 2000, False)):
        x = np.arange(low, high, 10)
        cloud = replace(cloud_from_grid(x, 0 * x, 0 * x), known=Rect(low, -1000, high, 1000))
        unproven = voxel.classify(cloud, VoxelParams()).unproven
        assert unproven.tolist() == [partial and (v < 500 or v >= 1500) for v in x.tolist()]


# ---------------------------------------------------------------- by hand


def sheet(x0, x1, y0, y1, height=lambda x, y: 0 * x):
    """Points every 20 mm, none on a voxel face, from 5 mm above zero."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(x0 + 5, x1, 20), np.arange(y0 + 5, y1, 20)))
    return np.column_stack([x, y, 5 + height(x, y)])


def box(x0, x1, y0, y1, top, extent=4000):
    """Flat ground with a solid box on it, whose top alone is seen; returns the points and which are the box's."""

    def inside(x, y):
        return (x >= x0) & (x < x1) & (y >= y0) & (y < y1)

    points = sheet(0, extent, 0, extent, lambda x, y: top * inside(x, y))
    return points, inside(points[:, 0], points[:, 1])


@pytest.mark.parametrize("params", [VoxelParams(), PcomParams()])
@pytest.mark.parametrize("points", [[], [(1, 2, 3)], [(0, 0, 0), (9, 9, 9)], [(7, 7, 7)] * 9])
def test_too_few_points_hold_no_ground(points, params):
    ground = classify(points, params)
    assert ground.dtype == np.bool_
    assert ground.tolist() == [False] * len(points)


@pytest.mark.parametrize("params", [VoxelParams(), PcomParams()])
def test_a_stem_over_seen_ground_is_cut_two_fine_voxels_up(params):
    ground = sheet(0, 4000, 0, 4000)
    stem = np.array([(2005, 2005, 5 + 20 * k) for k in range(1, 500)])
    found = classify(np.vstack([ground, stem]), params)
    assert found[: len(ground)].all()
    assert found[len(ground) :].tolist() == [z < 100 for z in stem[:, 2]]


def test_pcom_removes_the_stump_that_the_voxel_filter_keeps():
    points, stump = box(2000, 2500, 2000, 2500, top=600)  # one coarse column; 25 middle voxels, 100 are asked for
    assert classify(points, VoxelParams()).all()
    assert classify(points, PcomParams()).tolist() == (~stump).tolist()


def test_pcom_removes_the_outlier_below_that_the_voxel_filter_keeps():
    points = np.vstack([sheet(0, 4000, 0, 4000), [(2222, 2222, -3000)]])
    # in both the outlier hides the ground of its coarse column: the limit of "lowest voxel"
    visible = (points[:, :2] // 500 != 2222 // 500).any(axis=1)
    outlier = points[:, 2] < 0
    assert classify(points, VoxelParams()).tolist() == (visible | outlier).tolist()
    assert classify(points, PcomParams()).tolist() == visible.tolist()


def test_a_terrace_stays_unless_it_is_smaller_than_the_smallest_cluster():
    wide, _ = box(0, 2000, 0, 4000, top=1000)
    small, terrace = box(1000, 1500, 1000, 2500, top=1000)  # 0.75 m2
    for points in (wide, small):
        assert classify(points, VoxelParams()).all()
    assert classify(wide, PcomParams()).all()
    assert classify(small, PcomParams()).tolist() == (~terrace).tolist()
    assert classify(small, PcomParams(min_area=0.75, interior=30.0)).all()


def test_a_slope_is_not_cut_at_the_boundaries_of_the_layers():
    points = sheet(0, 4000, 0, 4000, lambda x, y: 2 * x // 5)
    assert classify(points, VoxelParams()).all()
    assert classify(points, PcomParams()).all()
    literal = classify(points, PcomParams(half_window=0))
    # a fine layer is 2.5 columns wide and 80 long: 160 or 240 voxels, where a border cluster needs 200
    assert 0 < literal.sum() < len(points)


def test_the_interior_threshold_drops_what_stands_out_of_a_kept_cluster():
    points, bump = box(2000, 2050, 2000, 2050, top=90)  # one layer up at the fine level, within its window
    assert classify(points, PcomParams()).tolist() == (~bump).tolist()
    assert classify(points, PcomParams(interior=1.9)).all()


def test_the_expansion_takes_in_a_dropped_voxel_among_kept_ones():
    points, bump = box(2000, 2050, 2000, 2050, top=60)
    assert classify(points, PcomParams(half_window=0)).all()
    higher, bump = box(2000, 2050, 2000, 2050, top=110)  # two layers up
    assert classify(higher, PcomParams(half_window=0)).tolist() == (~bump).tolist()


def test_a_cluster_at_the_border_may_be_half_as_large():
    params = PcomParams(interior=30.0)
    beside, _ = box(0, 500, 1000, 2000, top=1000)  # 0.5 m2
    inside, terrace = box(500, 1000, 1000, 2000, top=1000)
    assert classify(beside, params).all()
    assert classify(inside, params).tolist() == (~terrace).tolist()


def test_fixed_points_stay_ground():
    points, stump = box(2000, 2500, 2000, 2500, top=600)
    cloud = replace(cloud_from_grid(*points.T), fixed=stump)
    assert pcom.classify(cloud, PcomParams()).ground.all()


def test_a_stray_point_at_the_other_end_of_the_grid_costs_nothing():
    points = np.vstack([sheet(0, 2000, 0, 2000), [(2_000_000_000, 2_000_000_000, 2_000_000_000)]])
    cloud = cloud_from_grid(*points.T)
    for params in (VoxelParams(resolution=0.02), PcomParams(resolution=0.02)):
        module = FILTERS[type(params)]
        tracemalloc.start()
        found = module.classify(cloud, params).ground
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert found[:-1].all()
        assert not found[-1]
        # one point per column, the dearest case of all
        assert peak < module.FILTER.bytes_per_point * len(points) + 100_000


def test_pcom_agrees_across_a_seam_beyond_its_buffer():
    rng = np.random.default_rng(3)
    points = sheet(0, 20_000, 0, 6000, lambda x, y: x // 10 + rng.integers(0, 30, len(x)))
    stump = ((points[:, 0] // 300) % 7 == 0) & ((points[:, 1] // 300) % 5 == 0)
    points[stump, 2] += 500
    params = PcomParams()
    whole = classify(points, params)
    reach = round(pcom.required_buffer(params) * 1000)
    core = points[:, 0] < 10_000
    near = ~core & (points[:, 0] < 10_000 + reach)
    assert not whole[core].all()
    cloud = cloud_from_grid(*np.vstack([points[core], points[near]]).T)
    cloud = replace(cloud, n_core=int(core.sum()), known=Rect(-(10**9), -(10**9), 10_000 + reach, 10**9))
    assert pcom.classify(cloud, params).ground.tolist() == whole[core].tolist()


# ---------------------------------------------------------------- parameters


def test_a_resolution_without_whole_half_voxels_is_refused():
    with pytest.raises(ParameterError, match=r"multiple of 0\.002 m"):
        VoxelParams(resolution=0.025)


@pytest.mark.parametrize("change", [{"half_window": 0.5}, {"min_voxels": 2.5}])
def test_counts_are_whole_numbers(change):
    with pytest.raises(ParameterError, match="whole number"):
        PcomParams(**change)


@pytest.mark.parametrize("module", [voxel, pcom])
def test_sparse_points_enlarge_the_resolution_and_say_so(module):
    params = next(iter(module.FILTER.profiles.values()))
    sparse = Density(points=250 * 100, cells=10)  # 100 points/m2: spacing 0.1 m
    with pytest.warns(UserWarning, match=r"0\.1 m is too fine for 100 points/m2.*enlarged to 0\.4 m"):
        resolved = module.FILTER.resolve(params, sparse)
    assert resolved == params.replace(resolution=0.4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert module.FILTER.resolve(resolved, sparse) == resolved
        assert module.FILTER.resolve(params, Density(250 * 1600, 10)) == params
        assert module.FILTER.resolve(params, Density(0, 0)) == params
        finer = params.replace(points_per_column=0)
        assert module.FILTER.resolve(finer, sparse) == finer


@pytest.mark.parametrize(("module", "other"), [(voxel, DtmParams()), (pcom, VoxelParams())])
def test_a_foreign_parameter_object_is_refused(module, other):
    cloud = cloud_from_grid(*np.zeros((3, 0), np.int64))
    with pytest.raises(ParameterError, match="Params"):
        module.classify(cloud, other)
    with pytest.raises(ParameterError, match="Params"):
        module.required_buffer(other)


@pytest.mark.parametrize("name", ["voxel", "pcom"])
def test_the_registry_finds_the_filter(name):
    found = filters.get(name)
    assert found.name == name
    assert filters.parameters(name).RETURNS == "all"
