"""The whole way of the data on a small survey: exact, complete, resumable."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ppdf_dask import tasks
from ppdf_dask.errors import ParameterError, PlanError, ResumeError, SurveyError
from ppdf_dask.filters import classify_ground
from ppdf_dask.grid import ChunkGrid, Rect
from ppdf_dask.index import Index
from ppdf_dask.neighbourhood import Cut
from ppdf_dask.params import ChunkParams, ClassRules, DtmParams, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.result import Result
from ppdf_dask.single import classify_tile
from ppdf_dask.solve import ClassifyJob
from ppdf_dask.store import RunStore
from ppdf_dask.survey import scan
from ppdf_dask.synthetic import SyntheticParams, points, write_survey
from ppdf_dask.tiler import TileJob

FOREST = SyntheticParams(density=1.0, house_share=0.5, low_outliers=0.002)


def small(**chunks: float) -> RunParams:
    return RunParams(chunks=ChunkParams(**chunks))


@pytest.fixture(scope="module")
def finished(small_survey, client, tmp_path_factory) -> Result:
    out = tmp_path_factory.mktemp("run")
    return plan(scan([small_survey / "tiles"]), small(chunk_size=50.0), out=out).run(client)


@dataclass
class Points:
    """All points of a folder's tiles; each tile has offsets of its own, so coordinates are joined as metres."""

    xyz: np.ndarray
    classification: np.ndarray
    last: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        return self.last & ~np.isin(self.classification, (7, 9, 18))


def read_all(folder: Path) -> Points:
    parts = [laspy.read(path) for path in sorted(folder.glob("*.laz"))]
    return Points(
        np.concatenate([p.xyz for p in parts]),
        np.concatenate([np.asarray(p.classification) for p in parts]),
        np.concatenate([np.asarray(p.return_number) == np.asarray(p.number_of_returns) for p in parts]),
    )


def test_every_output_is_there(finished):
    names = {p.name for p in finished.out.iterdir()}
    assert names == {"laz", "dtm.tif", "run.zarr", "run.json"}
    assert finished.counts["points"] == scan([finished.out / "laz"]).point_count
    assert finished.counts["unproven"] == 0
    assert not list(finished.out.rglob("*.part"))


def test_only_classification_changed_and_in_the_original_order(small_survey, finished):
    changed = 0
    for path in finished.tiles:
        before, after = laspy.read(small_survey / "tiles" / path.name), laspy.read(path)
        for name in before.point_format.dimension_names:
            if name == "classification":
                changed += int((before[name] != after[name]).sum())
            else:
                np.testing.assert_array_equal(np.asarray(before[name]), np.asarray(after[name]), err_msg=name)
        assert [v.record_data_bytes() for v in before.header.vlrs if v.user_id != "laszip encoded"] == [
            v.record_data_bytes() for v in after.header.vlrs if v.user_id != "laszip encoded"
        ]
        noise = np.isin(np.asarray(before.classification), (7, 18))
        np.testing.assert_array_equal(np.asarray(after.classification)[noise], np.asarray(before.classification)[noise])
    assert changed > 1000


def test_the_mask_is_that_of_the_whole_survey_in_memory(small_survey, finished):
    las = read_all(small_survey / "tiles")
    ground = classify_ground(las.xyz[las.seen])
    found = read_all(finished.out / "laz").classification[las.seen] == 2
    np.testing.assert_array_equal(found, ground)
    assert ground.sum() > 1000


def test_terrain_model_is_the_tin_of_the_written_ground(finished):
    from scipy.interpolate import LinearNDInterpolator

    dtm = finished.dtm
    assert dtm.chunks is not None
    assert dtm.rio.crs.to_epsg() == 25832
    las = read_all(finished.out / "laz")
    ground = las.xyz[las.classification == 2] - (600.0, 600.0, 0.0)
    ground = ground[np.lexsort(ground.T)]  # lowest first, so that unique keeps the lowest of one place
    _, first = np.unique(ground[:, :2], axis=0, return_index=True)
    x, y = np.meshgrid(dtm.x.values - 600.0, dtm.y.values - 600.0)
    expected = LinearNDInterpolator(ground[first, :2], ground[first, 2])(x, y)
    # Flat triangles at the hull have circles beyond max_edge and give no height: tests/test_dtm.py looks at that rule.
    inside = np.isfinite(dtm.values)
    assert inside[(x > 5) & (x < 115) & (y > 5) & (y < 115)].mean() > 0.99
    # Heights come back as float32: half a unit in the last place of 1024 m, and SciPy's own rounding.
    np.testing.assert_allclose(dtm.values[inside], expected[inside], rtol=0, atol=2**-14 + 1e-6)


def test_points_open_as_xarray(finished):
    total, ground = 0, 0
    for chunk in finished.chunks:
        dataset = finished.open_points(chunk)
        assert set(dataset) == {"x", "y", "z", "ground", "source"}
        total += dataset.sizes["point"]
        ground += int(dataset.ground.sum())
    assert (total, ground) == (finished.counts["eligible"], finished.counts["ground"])


def test_reprs_tell_what_matters(small_survey, finished):
    survey = scan([small_survey / "tiles"])
    made = plan(survey, out=finished.out)
    for shown in (survey, made, finished):
        assert f"{survey.point_count:,}" in repr(shown)
        assert "<svg" in shown._repr_html_()


def test_a_second_run_does_nothing_again_and_gives_the_same_bytes(small_survey, finished, client):
    before = {p: p.read_bytes() for p in [*finished.tiles, finished.out / "dtm.tif"]}
    events = []
    again = plan(scan([small_survey / "tiles"]), small(chunk_size=50.0), out=finished.out)
    again.run(client, on_event=events.append)
    assert not [e for e in events if e.state == "done"]
    assert {p: p.read_bytes() for p in before} == before


def test_other_parameters_are_refused_by_name_and_accepted_on_request(small_survey, client, tmp_path):
    survey = scan([small_survey / "tiles"])
    plan(survey, small(chunk_size=100.0), out=tmp_path).run(client)
    other = RunParams(chunks=ChunkParams(chunk_size=100.0), dtm=DtmParams(resolution=2.0))
    with pytest.raises(ResumeError, match=r"params\.dtm\.resolution: was 1\.0, now 2\.0"):
        plan(survey, other, out=tmp_path).run(client)
    events = []
    result = plan(survey, other, out=tmp_path).run(client, on_event=events.append, accept_changes=True)
    assert {e.stage for e in events if e.state == "done"} == {"dtm", "cog"}
    assert float(result.dtm.x[1] - result.dtm.x[0]) == 2.0


def test_a_lost_output_is_written_again(small_survey, client, tmp_path):
    survey = scan([small_survey / "tiles"])
    result = plan(survey, small(chunk_size=100.0), out=tmp_path).run(client)
    content = result.tiles[3].read_bytes()
    result.tiles[3].unlink()
    events = []
    plan(survey, small(chunk_size=100.0), out=tmp_path).run(client, on_event=events.append)
    assert [e.stage for e in events if e.state == "done"] == ["merge"]
    assert result.tiles[3].read_bytes() == content


def test_classify_gives_the_bytes_of_a_run_on_the_same_tile(small_survey, client, tmp_path):
    tile = sorted((small_survey / "tiles").glob("*.laz"))[4]
    result = plan(scan([tile]), small(chunk_size=20.0), out=tmp_path / "run").run(client)
    classify_tile(scan([tile]), tmp_path / "alone.laz")
    assert (tmp_path / "alone.laz").read_bytes() == result.tiles[0].read_bytes()


def test_refine_keeps_given_ground_and_reset_clears_the_rest(small_survey, client, tmp_path):
    las = laspy.read(sorted((small_survey / "tiles").glob("*.laz"))[4])
    classes = np.asarray(las.classification).copy()
    classes[:200], classes[200:400] = 2, 5
    las.classification = classes
    (tmp_path / "in").mkdir()
    las.write(tmp_path / "in" / "a.laz")
    out = {}
    for mode in ("update", "refine", "reset"):
        params = RunParams(chunks=ChunkParams(chunk_size=20.0), classes=ClassRules(mode=mode))
        result = plan(scan([tmp_path / "in"]), params, out=tmp_path / mode).run(client)
        out[mode] = np.asarray(laspy.read(result.tiles[0]).classification)
        alone = tmp_path / f"{mode}.laz"
        classify_tile(scan([tmp_path / "in"]), alone, params)
        np.testing.assert_array_equal(np.asarray(laspy.read(alone).classification), out[mode])
    assert (out["refine"][:200] == 2).all()
    assert set(np.unique(out["update"][:200])) <= {1, 2}
    assert (out["update"][200:400] == 5).any()
    last = (np.asarray(las.return_number) == np.asarray(las.number_of_returns))[200:400]
    assert set(np.unique(out["reset"][200:400][last])) <= {1, 2}


def _masks(url: Path, folder: Path, size: float, buffer: float, order: int) -> dict[str, np.ndarray]:
    """Tile and classify without Dask, in any order; return the ground mask of each source in file order."""
    survey, grid, params = scan([folder]), ChunkGrid.from_metres(size), RunParams()
    stored = round(buffer * 1000) if buffer <= size else 0
    jobs = [
        TileJob(f"s_{k:06d}", tile, 1.0, 1.0, params, grid, stored) for k, tile in enumerate(survey.tiles)
    ]  # fmt: skip
    store = RunStore(str(url))
    store.create({})
    records = [tasks.tile(str(url), job, "f") for job in jobs]
    Index.of({job.source: record for job, record in zip(jobs, records, strict=True)}).publish(store)
    bounds = [Rect(*r["bounds"]) for r in records if r["eligible"]]
    extent = bounds[0]
    for b in bounds[1:]:
        extent = extent.union(b)
    ids = sorted({c for r in records for c, (core, _, _) in r["chunks"].items() if core})
    np.random.default_rng(order).shuffle(ids)
    # A cell size by hand: the density is the survey's, and has a test of its own.
    robust = params.filter.replace(cell_size=1.25, refinement=2)
    for ident in ids:
        job = ClassifyJob(grid.parse(ident), Cut(grid, stored, extent), robust, round(buffer * 1000), 10**7)
        record = tasks.classify(str(url), job, "f")
        assert record["unproven"] == 0
    found = {}
    from ppdf_dask.merge import _Masks

    for job in jobs:
        masks = _Masks(store, job)
        found[Path(job.tile.path).name] = np.concatenate([masks.ground(batch) for batch in job.batches()])
        masks.check_used_up()
    return found


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(
    place=st.tuples(st.integers(0, 40), st.integers(0, 40)),
    tile=st.sampled_from([25, 40, 80]),
    size=st.sampled_from([30.0, 50.0, 200.0]),
    buffer=st.sampled_from([0.0, 10.0, 35.0, 90.0]),
    order=st.integers(0, 9),
)
def test_the_result_does_not_depend_on_how_the_survey_was_cut(tmp_path_factory, place, tile, size, buffer, order):
    x0, y0 = (50 * k for k in place)
    extent = (x0, y0, x0 + 90, y0 + 70)
    folder = tmp_path_factory.mktemp("cut")
    write_survey(folder, FOREST, extent=extent, tile_size=tile, truth=False)
    found = _masks(folder / "run.zarr", folder / "tiles", size, buffer, order)
    las = read_all(folder / "tiles")
    from ppdf_dask import RobustParams

    seen = las.seen
    whole = classify_ground(las.xyz[seen], RobustParams(cell_size=1.25, refinement=2))
    got = np.concatenate([found[path.name] for path in sorted((folder / "tiles").glob("*.laz"))])
    np.testing.assert_array_equal(got[seen], whole)
    assert not got[~seen].any()


def test_plan_refuses_what_cannot_fit(small_survey, tmp_path):
    survey = scan([small_survey / "tiles"])
    with pytest.raises(PlanError, match=r"needs about \d+ MB but a worker has 100 MB"):
        plan(survey, small(chunk_size=1000.0), out=tmp_path, memory=1e8).check()
    with pytest.raises(ParameterError, match="chunk_size = -1"):
        small(chunk_size=-1.0)


def test_plan_touches_no_points(small_survey, tmp_path, monkeypatch):
    import lazrs

    def forbidden(*_: object) -> None:
        raise AssertionError("a plan must not decode points")

    monkeypatch.setattr(lazrs, "LasZipDecompressor", forbidden)
    made = plan(scan([small_survey / "tiles"]), small(chunk_size=50.0), out=tmp_path / "run")
    assert len(made.chunks) == 9
    assert not (tmp_path / "run").exists()


def test_classify_does_not_write_over_its_input(small_survey):
    tile = sorted((small_survey / "tiles").glob("*.laz"))[0]
    with pytest.raises(SurveyError, match="is the input itself"):
        classify_tile(scan([tile]), tile)


def test_run_json_names_versions_parameters_and_memory(finished):
    report = json.loads((finished.out / "run.json").read_text())
    assert {"dask", "numpy", "numba", "zarr", "laspy"} <= report["packages"].keys()
    assert report["filter"]["cell_size"] is not None
    assert report["stages"].keys() == {"tile", "classify", "merge", "dtm", "cog"}
    assert all(s["peak_mb"] > 0 for s in report["stages"].values())
    assert len(report["inputs"]) == 9


def test_synthetic_survey_has_what_the_engine_is_tested_on():
    cloud = points((600, 600, 720, 720), SyntheticParams(density=1.5))
    assert {1, 2} <= set(np.unique(cloud["classification"]).tolist()) | {1}
    assert cloud["number_of_returns"].max() > 1
