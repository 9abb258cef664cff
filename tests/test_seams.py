"""Neighbours that disagree are counted, and PPDF's never do."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from ppdf_dask import filters
from ppdf_dask.cli.scale import seams as command
from ppdf_dask.params import ChunkParams, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.seams import measure
from ppdf_dask.survey import scan


@pytest.fixture(scope="module", params=["robust", "paper"])
def exact(request, small_survey, client, tmp_path_factory):
    params = RunParams(
        filter=filters.parameters("ppdf", request.param), chunks=ChunkParams(chunk_size=40.0, buffer=12.0)
    )
    out = tmp_path_factory.mktemp("run")
    plan(scan([small_survey / "tiles"]), params, out=out).run(client)
    return out


def test_ppdf_has_no_seams(exact):
    found = measure(exact)
    assert len(found.seams) == 12  # 3 x 3 chunks: 6 edges each way
    assert found.points > 5000
    assert (found.differ, found.unproven) == (0, 0)


def test_a_filter_with_too_little_buffer_shows_its_seams(small_survey, client, tmp_path, monkeypatch):
    import dataclasses

    from ppdf_dask.filters import smrf

    # A plan refuses a buffer below the filter's reach, so the filter has to lie about it.
    lying = dataclasses.replace(smrf.FILTER, required_buffer=lambda params: 2.0)
    monkeypatch.setattr(smrf, "FILTER", lying)
    params = RunParams(filter=filters.parameters("smrf"), chunks=ChunkParams(chunk_size=40.0, buffer=2.0))
    plan(scan([small_survey / "tiles"]), params, out=tmp_path / "run").run(client)
    found = measure(tmp_path / "run")
    assert found.differ > 0
    assert "have two answers" in found.markdown()
    assert "| c_" in found.markdown()


def test_command_prints_json_and_draws_a_map(exact, tmp_path):
    done = CliRunner().invoke(command, [str(exact), "--json", "--plot", str(tmp_path / "map")])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["differ"] == 0
    assert len(told["seams"]) == 12
    assert b"<svg" in (tmp_path / "map.svg").read_bytes()
    assert (tmp_path / "map.png").stat().st_size > 1000
