"""Every point has exactly one owner, and lies in exactly the buffers it should lie in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask import tiler
from ppdf_dask.filters.cloud import cloud_from_grid, density
from ppdf_dask.grid import ChunkGrid, Rect
from ppdf_dask.params import RunParams
from ppdf_dask.store import RunStore
from ppdf_dask.survey import scan
from ppdf_dask.tiler import TileJob, cut, neighbours, owners, pack_cells, unpack_cells

SIZE = 5000

# Coordinates on, one below and one above chunk edges are the ones that get lost elsewhere.
edge = st.builds(lambda k, d: k * SIZE + d, st.integers(-3, 3), st.sampled_from([-1, 0, 1, 2499, 2500, 2501]))
coordinate = st.one_of(edge, st.integers(-3 * SIZE, 3 * SIZE))
places = st.lists(st.tuples(coordinate, coordinate), min_size=0, max_size=60)


@settings(deadline=None)
@given(places)
def test_each_point_has_exactly_one_owner(xy):
    x, y = (np.array([p[k] for p in xy], np.int64) for k in (0, 1))
    grid, seen = ChunkGrid(SIZE), np.zeros(len(x), int)
    for ix, iy, index in owners(grid, x, y):
        core = grid.chunk(ix, iy).core
        assert ((x[index] >= core.x0) & (x[index] < core.x1) & (y[index] >= core.y0) & (y[index] < core.y1)).all()
        assert (np.diff(index) > 0).all()
        seen[index] += 1
    assert (seen == 1).all()


@settings(deadline=None)
@given(places, st.integers(0, SIZE))
def test_buffers_hold_what_lies_around_the_core(xy, buffer):
    x, y = (np.array([p[k] for p in xy], np.int64) for k in (0, 1))
    grid = ChunkGrid(SIZE)
    found: dict[tuple[int, int], list[int]] = {}
    for ix, iy, index in neighbours(grid, buffer, x, y):
        found.setdefault((ix, iy), []).extend(index.tolist())
    for ix in range(-5, 6):
        for iy in range(-5, 6):
            core = grid.chunk(ix, iy).core
            wide = core.grow(buffer)
            expected = [k for k in range(len(x)) if _inside(wide, x[k], y[k]) and not _inside(core, x[k], y[k])]
            assert sorted(found.pop((ix, iy), [])) == expected
    assert not found


def _inside(rect: Rect, x: int, y: int) -> bool:
    return rect.x0 <= x < rect.x1 and rect.y0 <= y < rect.y1


@settings(deadline=None)
@given(st.lists(st.booleans(), min_size=1, max_size=200))
def test_density_cells_survive_packing(cells):
    mask = np.array(cells)
    assert int.from_bytes(unpack_cells(pack_cells(mask)).tobytes(), "big").bit_count() == mask.sum()


def _jobs(folder: Path, size: float, buffer: int, params: RunParams | None = None) -> list[TileJob]:
    survey = scan([folder])
    return [
        TileJob(
            f"s_{k:06d}",
            tile,
            survey.unit_xy,
            survey.unit_z,
            params or RunParams(),
            ChunkGrid.from_metres(size),
            buffer,
        )
        for k, tile in enumerate(survey.tiles)
    ]


def _stored(store: RunStore, part: str) -> np.ndarray:
    """Return all points of a part as absolute millimetres with their chunk, sorted."""
    rows = []
    for chunk in store.chunks():
        core = ChunkGrid(25_000).parse(chunk).core
        for source in store.sources(chunk, part):
            points = store.read_points(chunk, part, source).astype(np.int64)
            rows.append(np.column_stack([points[0] + core.x0, points[1] + core.y0, points[2]]))
    points = np.concatenate(rows)
    return points[np.lexsort(points.T[::-1])]


def test_fragments_hold_every_eligible_point_once_and_spilling_changes_nothing(small_survey, tmp_path, monkeypatch):
    jobs = _jobs(small_survey / "tiles", 25.0, 7_000)
    whole = [
        np.column_stack([b.x[b.eligible], b.y[b.eligible], b.z[b.eligible]]) for job in jobs for b in job.batches()
    ]
    expected = np.concatenate(whole)
    expected = expected[np.lexsort(expected.T[::-1])]
    stores = []
    for name, limit in (("memory", 10**9), ("disk", 500)):
        monkeypatch.setattr(tiler, "SPILL_POINTS", limit)
        store = RunStore(str(tmp_path / name))
        store.create({})
        records = [cut(store, job) for job in jobs]
        assert sum(r["eligible"] for r in records) == len(expected)
        np.testing.assert_array_equal(_stored(store, "core"), expected)
        stores.append((store, records))
    assert stores[0][1] == stores[1][1]
    np.testing.assert_array_equal(_stored(stores[0][0], "buffer"), _stored(stores[1][0], "buffer"))


@pytest.mark.parametrize("size", [20.0, 60.0, 1000.0])
def test_density_is_the_same_for_any_chunk_size(small_survey, tmp_path, client, size):
    from ppdf_dask.params import ChunkParams
    from ppdf_dask.plan import plan
    from ppdf_dask.runner import _Run

    survey = scan([small_survey / "tiles"])
    made = plan(survey, RunParams(chunks=ChunkParams(chunk_size=size, buffer=0.0)), out=tmp_path / "run")
    driver = _Run(made, client, lambda event: None)
    driver.begin(False, False)
    driver.tile()
    points = [
        np.stack([v[b.eligible] for v in (b.x, b.y, b.z)])
        for job in _jobs(small_survey / "tiles", size, 0)
        for b in job.batches()
    ]
    assert driver.density() == density(cloud_from_grid(*np.concatenate(points, axis=1)))


@settings(max_examples=20, deadline=None)
@given(st.floats(0.001, 5000.0))
def test_chunk_edges_are_multiples_of_the_density_cell(size):
    grid = ChunkGrid.from_metres(size)
    assert grid.size % 5000 == 0
    assert grid.size >= round(size * 1000)
