"""The search for the nearest references: every way of searching against all pairs. Sums and orders beside it."""

from __future__ import annotations

import dataclasses

import numpy as np
import oracle_robust
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask.filters.cloud import cloud_from_xyz
from ppdf_dask.filters.ppdf.robust.cells import LOW, REF, UNPROVEN
from ppdf_dask.filters.ppdf.robust.classify import _by_rows
from ppdf_dask.filters.ppdf.robust.growth import NOT_KNOWN
from ppdf_dask.filters.ppdf.robust.lanes import (
    CELL,
    COUNT,
    FX,
    FY,
    LANES,
    LARGEST_CELL,
    X,
    Y,
    Z,
    room_for_lanes,
    surfaces,
)
from ppdf_dask.filters.ppdf.robust.roughness import local_roughness
from ppdf_dask.filters.ppdf.robust.surface import add_reference, index_references, room_for_index

WIDTH, INNER, RINGS, PLACES = 32, (11, 21), 8, 2 * LANES + 5


def scene(seed, share, cell, step):
    """Return positions and states of a grid with references, and places asked for; `step` makes distances tie."""
    rng = np.random.default_rng(seed)
    row, col = np.divmod(np.arange(WIDTH * WIDTH), WIDTH)
    within = rng.integers(0, cell // step, (WIDTH * WIDTH, 2)) * step
    pos = np.stack([col * cell + within[:, 0], row * cell + within[:, 1], rng.integers(0, 3, len(row))], axis=1)
    state = np.where(rng.random(len(row)) < share, LOW | REF, 0).astype(np.uint8)
    places = rng.integers(INNER[0] * cell // step, INNER[1] * cell // step, (PLACES - 1, 2)) * step
    return pos.astype(np.int32), state, np.vstack([places, pos[INNER[0] * (WIDTH + 1), :2]])


def by_all_pairs(pos, state, place, limit2):
    """Return the nearest reference in each quadrant and the squared distances."""
    cells = np.flatnonzero(state & REF)
    dx, dy = (pos[cells, axis].astype(np.int64) - place[axis] for axis in (0, 1))
    d2 = dx * dx + dy * dy
    quadrant = ((dx > 0) | ((dx == 0) & (dy < 0))) + 2 * ((dy > 0) | ((dy == 0) & (dx > 0)))
    x, y, z = pos[cells].T
    order = np.lexsort((y, x, z, d2))
    order = order[(d2[order] > 0) & (d2[order] <= limit2)]
    which = [order[quadrant[order] == q][:1] for q in range(4)]
    return [int(cells[w[0]]) if len(w) else -1 for w in which] + [int(d2[w[0]]) if len(w) else limit2 for w in which]


@pytest.mark.parametrize("cell", [1_000, LARGEST_CELL, LARGEST_CELL + 500], ids=["small", "largest", "too large"])
@given(
    seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.01, 0.1, 0.5, 1.0]), step=st.sampled_from([1, 250, 500])
)
@settings(deadline=None, max_examples=30)
def test_every_search_finds_what_all_pairs_say(cell, seed, share, step):
    pos, state, places = scene(seed, share, cell, step)
    index, room, limit2 = room_for_index(len(state)), room_for_lanes(), (RINGS * cell - 1) ** 2
    index_references(WIDTH, cell, pos, state, index)
    for i, (x, y) in enumerate(places):
        room.place[i, [X, Y, Z, FX, FY, CELL]] = x, y, 0, x % cell, y % cell, y // cell * WIDTH + x // cell
    surfaces(room, PLACES, index, pos, WIDTH, cell, RINGS, limit2, 0.1 * (cell * 1e-3) ** 2)
    for i, place in enumerate(places):
        found = by_all_pairs(pos, state, place, limit2)
        assert room.found[8 * i : 8 * i + 8].tolist() == found
        x, y, z = pos.T.tolist()
        near = {q: (found[4 + q], z[j], x[j], y[j]) for q, j in enumerate(found[:4]) if j >= 0}
        assert (room.place[i, COUNT], *room.answer[i]) == oracle_robust.surface((*map(int, place), 0), near, cell)


@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.02, 0.3]))
@settings(deadline=None, max_examples=30)
def test_a_reference_added_leaves_the_index_of_all(seed, share):
    pos, state, _ = scene(seed, share, 1_000, 1)
    index, expected = room_for_index(len(state)), room_for_index(len(state))
    index_references(WIDTH, 1_000, pos, state, index)
    for k in np.random.default_rng(seed).choice(np.flatnonzero(~state & REF), 40, replace=False):
        state[k] |= LOW | REF
        add_reference(WIDTH, 1_000, pos, k, index)
    index_references(WIDTH, 1_000, pos, state, expected)
    for got, wanted in zip(index, expected, strict=True):
        np.testing.assert_array_equal(got, wanted)


@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(1, 20), st.integers(1, 20)),
    reach=st.integers(0, 6),
    share=st.sampled_from([0.0, 0.02, 0.3]),
)
@settings(deadline=None, max_examples=60)
def test_roughness_is_the_mean_depth_of_what_lies_below(seed, shape, reach, share):
    """The oracle goes from cell to cell."""
    rng = np.random.default_rng(seed)
    residuals = rng.integers(-2_000, 1_000, shape).astype(np.int32)
    residuals[rng.random(shape) < 0.3] = NOT_KNOWN
    state = np.where(rng.random(shape) < share, UNPROVEN | LOW, LOW).astype(np.uint8)
    expected = np.empty(shape, np.int32)
    for row, col in np.ndindex(shape):
        around = (slice(max(row - reach, 0), row + reach + 1), slice(max(col - reach, 0), col + reach + 1))
        depths = [min(-r, 1_000) for r in residuals[around].ravel().tolist() if NOT_KNOWN < r < 0]
        proven = not (state[around] & UNPROVEN).any()
        expected[row, col] = (sum(depths) // max(len(depths), 1)) if proven else NOT_KNOWN
    found = local_roughness(shape[1], state.ravel(), residuals.ravel(), reach, 1_000)
    assert found.tolist() == expected.ravel().tolist()


@given(
    y=st.lists(st.integers(-40, 40) | st.integers(-1_000_000, 1_000_000), min_size=1, max_size=40),
    core=st.integers(0, 40),
    cell=st.sampled_from([1, 7, 1000]),
)
@settings(deadline=None)
def test_points_are_put_in_rows_the_core_first(y, core, cell):
    n_core = min(core, len(y))
    cloud = cloud_from_xyz(np.array([[0.0, v / 1000, 0.0] for v in y]))
    cloud = dataclasses.replace(cloud, n_core=n_core)
    rows = (cloud.y.astype(np.int64) - int(cloud.y.min())) // cell
    expected = sorted(range(n_core), key=lambda i: rows[i]) + sorted(range(n_core, len(y)), key=lambda i: rows[i])
    assert _by_rows(cloud, cell).tolist() == expected
