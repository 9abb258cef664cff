"""The measuring of scale, on surveys of a size for tests."""

from __future__ import annotations

import json
from functools import reduce

import pytest
from click.testing import CliRunner

from ppdf_dask.cli.scale import scale as command
from ppdf_dask.dtm import MAX_PIXELS, DtmGrid, Raster
from ppdf_dask.experiments.processes import cluster
from ppdf_dask.experiments.scale import PER_M2, TILE, ScaleTable, extent_of, measure
from ppdf_dask.experiments.simulate import PER_TILE, country, resolution, simulate
from ppdf_dask.filters.cloud import Density
from ppdf_dask.grid import Rect
from ppdf_dask.params import ChunkParams, DtmParams, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.store import RunStore
from ppdf_dask.survey import scan


def test_a_job_is_measured_beside_its_copy(small_survey, tmp_path):
    tiles = sorted((small_survey / "tiles").glob("*.laz"))
    with cluster(1) as (client, pids):
        assert {role: len(p) for role, p in pids.items()} == {"workers": 1, "nannies": 1, "scheduler": 1, "client": 1}
        assert len({p for found in pids.values() for p in found}) == 4
        row = measure(client, pids, tiles, tmp_path, RunParams(chunks=ChunkParams(chunk_size=60.0)))
    assert (row.points, row.workers) == (scan([small_survey / "tiles"]).point_count, 1)
    assert list(row.stages) == ["tile", "classify", "merge", "dtm", "cog"]
    assert 0 < row.idle < 1
    assert row.seconds > max(c.seconds for c in row.copies)
    store = RunStore(str(tmp_path / "run" / "run.zarr"))
    assert row.fragments == sum(len(store.sources(c, part)) for c in store.chunks() for part in ("core", "buffer"))
    assert row.objects <= 20 * row.chunks + 2 * row.fragments
    assert row.usage["workers"].cpu_seconds > 0
    assert all(u.peak_mb > 20 for u in row.usage.values())
    assert set(row.work) == {"decode", "encode", "verify", "buffers", "retries"}
    assert row.work["decode"] > 0
    assert not (tmp_path / "copy").exists()
    table = ScaleTable((row,))
    assert f"| {row.points:,} | 1 |" in table.markdown()
    assert json.loads(json.dumps(table.as_dict()))["rows"][0]["ratio"] == round(row.ratio, 2)


def test_a_country_is_planned_and_scheduled_with_records_of_every_task(tmp_path):
    found = simulate(45, tmp_path, 1)
    assert found.chunks >= 45
    assert found.chunks == found.tiles * PER_TILE
    assert found.stages["classify"]["tasks"] == found.chunks
    assert found.stages["merge"]["tasks"] == found.tiles
    assert found.tasks == sum(int(s["tasks"]) for s in found.stages.values())
    assert len(list(RunStore(str(tmp_path / "simulated" / "run.zarr")).recorded("classify"))) == found.chunks
    assert f"{found.chunks:,} chunks" in found.markdown()


@pytest.mark.parametrize("chunks", [20_000, 150_000, 1_000_000])
def test_a_terrain_model_of_the_simulated_country_is_not_refused(chunks):
    place = reduce(Rect.union, [tile.bounds for tile in country(chunks).tiles])
    rows, columns = Raster.over(DtmGrid.from_params(DtmParams(resolution=resolution(chunks))), place).shape
    assert rows * columns <= MAX_PIXELS


@pytest.mark.parametrize("points", [1e6, 10e6, 40e6, 160e6, 640e6])
def test_extents_hold_about_the_points_asked_for(points):
    x0, y0, x1, y1 = extent_of(points)
    assert (x1 - x0) % TILE == (y1 - y0) % TILE == 0
    # Whole tiles, nearly square: at most a third off where there are few tiles, a tenth where there are many.
    assert (x1 - x0) * (y1 - y0) * PER_M2 == pytest.approx(points, rel=0.1 if points > 100e6 else 1.3)
    assert (x1 - x0) / (y1 - y0) <= 2


def test_chunks_do_not_grow_with_the_survey(tmp_path):
    made = {n: plan(country(n), RunParams(), out=tmp_path) for n in (30, 300, 3000)}
    assert len({m.grid.size for m in made.values()}) == 1
    assert len({round(m.task_mb) for m in made.values()}) == 1


def test_sparse_surveys_get_chunks_of_several_buffers(tmp_path):
    params = RunParams(chunks=ChunkParams(buffer=600.0))
    made = plan(country(300), params, out=tmp_path, memory=64e9)
    assert made.grid.size >= 3 * made.buffer
    narrow = plan(country(300), params, out=tmp_path, memory=2e9)
    assert narrow.grid.size < made.grid.size
    assert made.density == Density(made.survey.point_count, made.density.cells)


def test_command_refuses_sizes_that_are_none():
    done = CliRunner().invoke(command, ["--points", "10,x"])
    assert done.exit_code == 2
    assert "not a list of numbers" in done.output
    assert CliRunner().invoke(command, ["--points", "-1"]).exit_code == 2
