"""Exact across seams on the way of the data: any profile, chunk size, buffer, tile layout, workers, order, memory."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import laspy
import numpy as np
import pytest
from distributed import Client, LocalCluster
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ppdf_dask import PaperParams, RobustParams, tasks
from ppdf_dask.errors import PartialRunError
from ppdf_dask.filters import classify_ground
from ppdf_dask.grid import ChunkGrid, Rect
from ppdf_dask.index import Index
from ppdf_dask.ledger import Ledger
from ppdf_dask.merge import _Masks
from ppdf_dask.neighbourhood import Cut
from ppdf_dask.params import ChunkParams, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.result import Result
from ppdf_dask.solve import ClassifyJob, cover, quarters, solve
from ppdf_dask.store import RunStore
from ppdf_dask.survey import scan
from ppdf_dask.synthetic import SyntheticParams, write_survey
from ppdf_dask.tiler import TileJob

FOREST = SyntheticParams(density=0.8, house_share=0.5, low_outliers=0.002)
FILTERS = {
    # Cell and refinement by hand: the density is the survey's, and has a test of its own.
    "robust": RobustParams(cell_size=1.5, refinement=2, search_radius=10.0, largest_building=40.0),
    "paper": PaperParams(search_limit=15.0),
}
FAR = 10**7


class Survey:
    """A survey tiled into a store, and what the filters say of it as a whole."""

    def __init__(self, folder: Path, extent: tuple[float, float, float, float], tile: int) -> None:
        self.folder, self.cuts = folder, 0
        write_survey(folder, FOREST, extent=extent, tile_size=tile, truth=False)
        self.tiles = scan([folder / "tiles"]).tiles

    def whole(self, name: str) -> np.ndarray:
        parts = []
        for tile in self.tiles:
            las = laspy.read(tile.path)
            last = np.asarray(las.return_number) == np.asarray(las.number_of_returns)
            seen = ~np.isin(np.asarray(las.classification), (7, 9, 18)) & (last | (name == "paper"))
            parts.append((las.xyz, seen))
        xyz, seen = (np.concatenate([p[k] for p in parts]) for k in (0, 1))
        ground = np.zeros(len(xyz), bool)
        ground[seen] = classify_ground(xyz[seen], FILTERS[name])
        return ground

    def cut(self, name: str, size: float, buffer: float) -> tuple[RunStore, list[TileJob], Cut, list[str]]:
        self.cuts += 1
        store = RunStore(str(self.folder / f"run{self.cuts}.zarr"), "f")
        store.create({})
        grid, wide = ChunkGrid.from_metres(size), round(buffer * 1000)
        stored = wide if wide <= grid.size else 0
        params = RunParams(filter=FILTERS[name])
        jobs = [TileJob(f"s_{k:06d}", t, 1.0, 1.0, params, grid, stored) for k, t in enumerate(self.tiles)]
        records = {job.source: tasks.tile(store.url, job, "f") for job in jobs}
        index = Index.of(records)
        index.publish(store)
        boxes = [Rect(*r["bounds"]) for r in records.values() if r["eligible"]]
        extent = boxes[0]
        for box in boxes[1:]:
            extent = extent.union(box)
        return store, jobs, Cut(grid, stored, extent), sorted(index.points)


def masks(store: RunStore, jobs: list[TileJob]) -> np.ndarray:
    parts = []
    for job in jobs:
        read = _Masks(store, job)
        parts += [read.ground(batch) for batch in job.batches()]
        read.check_used_up()
    return np.concatenate(parts)


def check(folder: Path, name: str, place: tuple[int, int], shape: tuple[int, int], **how) -> None:
    x, y = (40 * k for k in place)
    survey = Survey(folder, (x, y, x + shape[0], y + shape[1]), how["tile"])
    store, jobs, cut, ids = survey.cut(name, how["size"], how["buffer"])
    np.random.default_rng(how["order"]).shuffle(ids)
    for ident in ids:
        chunk = cut.grid.parse(ident)
        job = ClassifyJob(chunk, cut, FILTERS[name], round(how["buffer"] * 1000), FAR, how["most"], how["usual"])
        record = tasks.classify(store.url, job, "f")
        assert record["unproven"] == 0
    np.testing.assert_array_equal(masks(store, jobs), survey.whole(name))


ways = {
    "place": st.tuples(st.integers(0, 40), st.integers(0, 40)),
    "tile": st.sampled_from([30, 50, 200]),
    "buffer": st.sampled_from([0.0, 8.0, 25.0, 120.0]),
    "order": st.integers(0, 9),
    "usual": st.sampled_from([float("inf"), 2000.0]),
}
quiet = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow, HealthCheck.data_too_large]}


@pytest.mark.parametrize("name", ["robust", "paper"])
@settings(max_examples=3, **quiet)
@given(**ways, size=st.sampled_from([35.0, 50.0, 500.0]))
def test_any_cut_gives_the_mask_of_the_whole_survey(tmp_path_factory, name, size, **how):
    # Unlimited memory here: where it is limited, see below.
    check(tmp_path_factory.mktemp("cut"), name, how.pop("place"), (70, 60), size=size, most=float("inf"), **how)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robust", "paper"])
@settings(max_examples=60, **quiet)
@given(**ways, size=st.sampled_from([50.0, 150.0, 2000.0]), most=st.sampled_from([float("inf"), 20_000.0]))
def test_any_cut_gives_the_mask_of_the_whole_survey_at_length(tmp_path_factory, name, size, most, **how):
    check(tmp_path_factory.mktemp("cut"), name, how.pop("place"), (320, 230), size=size, most=most, **how)


def test_a_chunk_too_dense_for_its_memory_is_worked_on_in_quarters_with_the_same_result(tmp_path):
    survey = Survey(tmp_path, (0, 0, 200, 200), 100)
    store, _, cut, ids = survey.cut("robust", 200.0, 20.0)
    (ident,) = ids
    # A filter that does not reach far: its proofs need less than the whole survey.
    modest = FILTERS["robust"].replace(search_radius=5.0, passes=2, fine_passes=1, largest_building=10.0)
    answers = [
        solve(store, ClassifyJob(cut.grid.parse(ident), cut, modest, 20_000, FAR, most))
        for most in (float("inf"), 25_000.0)
    ]
    whole, cautious = answers
    assert len(whole.loaded) == 1
    assert whole.loaded[0] > 25_000
    assert len(cautious.loaded) >= 4
    assert max(cautious.loaded) < 1.2 * 25_000  # Expected from the index, as if points were spread evenly.
    assert not cautious.unproven.any()
    np.testing.assert_array_equal(cautious.ground, whole.ground)


def test_a_wider_buffer_loads_no_more_than_is_usual_where_cutting_helps_and_is_never_given_up_for_it(tmp_path):
    survey = Survey(tmp_path, (0, 0, 240, 240), 240)
    store, _, cut, ids = survey.cut("robust", 80.0, 5.0)
    modest = FILTERS["robust"].replace(search_radius=5.0, passes=2, fine_passes=1, largest_building=10.0)
    most = {}
    for usual in (float("inf"), 25_000.0, 12_000.0):
        answers = [
            solve(store, ClassifyJob(cut.grid.parse(i), cut, modest, 5000, FAR, float("inf"), usual)) for i in ids
        ]
        assert not any(a.full or a.unproven.any() for a in answers)
        most[usual] = max(max(a.loaded) for a in answers), np.concatenate([a.ground for a in answers])
    assert most[25_000.0][0] < 1.2 * 25_000 < most[float("inf")][0]
    assert most[12_000.0][0] > 1.2 * 12_000
    for _, ground in most.values():
        np.testing.assert_array_equal(ground, most[float("inf")][1])


def test_what_cannot_be_proven_in_the_memory_is_said(tmp_path):
    survey = Survey(tmp_path, (0, 0, 150, 50), 50)
    store, _, cut, ids = survey.cut("robust", 50.0, 5.0)
    answers = [solve(store, ClassifyJob(cut.grid.parse(i), cut, FILTERS["robust"], 5000, FAR, 1500.0)) for i in ids]
    assert all(a.full and a.unproven.any() for a in answers)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(-(10**6), 10**6), st.integers(-(10**6), 10**6)), min_size=1, max_size=40),
    st.integers(1, 500_000),
)
def test_cover_holds_each_point_once_and_costs_no_more_than_one_box(xy, width):
    x, y = (np.array(v, np.int64) for v in zip(*xy, strict=True))
    found = cover(x, y, width)
    inside = sum(((x >= r.x0) & (x < r.x1) & (y >= r.y0) & (y < r.y1)).astype(int) for r in found)
    assert (inside == 1).all()

    def area(r: Rect) -> int:
        return (r.width + 2 * width) * (r.height + 2 * width)

    assert sum(map(area, found)) <= area(Rect(int(x.min()), int(y.min()), int(x.max()) + 1, int(y.max()) + 1))


@given(st.integers(-50, 50), st.integers(1, 90), st.integers(1, 90), st.integers(0, 200))
def test_quarters_make_up_the_whole(x, width, height, buffer):
    part = Rect(x, -x, x + width, -x + height)
    found = quarters(part, buffer)
    if found:
        assert sum(q.width * q.height for q in found) == width * height
        assert all(part.contains(q) and q.width > 0 and q.height > 0 for q in found)


def masks_of(result: Result) -> list[bytes]:
    return [path.read_bytes() for path in result.tiles]


@pytest.mark.parametrize("workers", [pytest.param(1), pytest.param(3, marks=pytest.mark.slow)])
def test_processes_and_threads_write_the_same_bytes(small_survey, client, tmp_path, workers):
    params = RunParams(chunks=ChunkParams(chunk_size=60.0))
    made = plan(scan([small_survey / "tiles"]), params, out=tmp_path / "threads")
    threads = made.run(client)
    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        Client(cluster) as other,
    ):
        processes = dataclasses.replace(made, out=tmp_path / "processes").run(other)
    assert masks_of(threads) == masks_of(processes)
    assert (threads.out / "dtm.tif").read_bytes() == (processes.out / "dtm.tif").read_bytes()


def test_beyond_max_buffer_points_are_counted_and_the_run_is_partial(small_survey, client, tmp_path):
    params = RunParams(chunks=ChunkParams(chunk_size=40.0, buffer=3.0, max_buffer=3.0))
    made = plan(scan([small_survey / "tiles"]), params, out=tmp_path / "run")
    with pytest.raises(PartialRunError, match=r"\d+ points could not be proven within --max-buffer 3 m") as error:
        made.run(client)
    assert error.value.exit_code == 3
    result = Result(tmp_path / "run")
    listed = {
        ident: r["unproven"] for ident, r in Ledger(RunStore(str(result.out / "run.zarr"))).store.records("classify")
    }
    assert result.counts["unproven"] == sum(listed.values()) > 0
    assert len(result.tiles) == 9


def test_the_record_names_the_buffer_a_chunk_needed(small_survey, client, tmp_path):
    params = RunParams(chunks=ChunkParams(chunk_size=40.0, buffer=5.0))
    result = plan(scan([small_survey / "tiles"]), params, out=tmp_path / "run").run(client)
    records = [r for _, r in RunStore(str(result.out / "run.zarr")).records("classify")]
    assert max(r["buffer_m"] for r in records) > 5.0
    assert all(r["unproven"] == 0 and not r["full"] for r in records)
    assert all(r["loaded"] >= r["loaded_first"] >= r["points"] for r in records)


def test_the_store_stays_small(small_survey, client, tmp_path):
    params = RunParams(chunks=ChunkParams(chunk_size=60.0))
    result = plan(scan([small_survey / "tiles"]), params, out=tmp_path / "run").run(client)
    store = RunStore(str(result.out / "run.zarr"))
    objects = sum(1 for f in (result.out / "run.zarr").rglob("*") if f.is_file())
    fragments = sum(len(store.sources(c, part)) for c in store.chunks() for part in ("core", "buffer"))
    chunks, tiles = result.counts["chunks"], len(result.tiles)
    # A chunk: mask, ground (2 objects each), record, index; a tile: 2 records. The rest is the raster's and the run's.
    assert objects <= 20 * chunks + 2 * fragments
    assert fragments <= 2 * chunks * tiles
