"""A run whose intermediate points were dropped: finished for good, and made again where it has to be."""

from __future__ import annotations

import pytest

from ppdf_dask import filters
from ppdf_dask.errors import StoreError
from ppdf_dask.params import ChunkParams, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.seams import measure
from ppdf_dask.store import RunStore
from ppdf_dask.survey import scan
from ppdf_dask.verify import verify


def test_dropped_points_are_gone_results_stay_and_come_again_when_needed(small_survey, client, tmp_path):
    survey = scan([small_survey / "tiles"])
    params = RunParams(chunks=ChunkParams(chunk_size=50.0))
    result = plan(survey, params, out=tmp_path / "run").run(client)
    before = {p: p.read_bytes() for p in [*result.tiles, result.out / "dtm.tif"]}
    size = sum(f.stat().st_size for f in (result.out / "run.zarr").rglob("*") if f.is_file())
    assert result.drop_intermediate() > 0.3 * size
    assert RunStore(str(result.out / "run.zarr")).chunks() == []
    assert not verify(result.out).findings
    with pytest.raises(StoreError, match="were dropped"):
        measure(result.out)

    events = []
    again = plan(survey, params, out=result.out).run(client, on_event=events.append)
    assert not [e for e in events if e.state == "done"]
    assert {p: p.read_bytes() for p in before} == before

    # A lost tile is written again from the source, for its labels are gone too.
    result.tiles[0].unlink()
    events.clear()
    plan(survey, params, out=result.out).run(client, on_event=events.append)
    assert [e.stage for e in events if e.state == "done"] == ["merge"]
    assert {p: p.read_bytes() for p in before} == before

    # A lost mask needs its points: all tiles are cut again, one chunk is classified again.
    store = RunStore(str(result.out / "run.zarr"))
    chunk = store.classified()[0]
    store.drop_record("classify", chunk)
    store.drop(f"classification/{chunk}")
    events.clear()
    plan(survey, params, out=result.out).run(client, on_event=events.append)
    done = [e.stage for e in events if e.state == "done"]
    assert done.count("tile") == len(survey.tiles)
    assert done.count("classify") == 1
    assert {p: p.read_bytes() for p in before} == before
    assert not verify(again.out).findings

    # Other parameters after dropping: the same as a run of their own.
    result.drop_intermediate()
    other = RunParams(filter=filters.parameters("ppdf").replace(tolerance=0.4), chunks=params.chunks)
    changed = plan(survey, other, out=result.out).run(client, accept_changes=True)
    fresh = plan(survey, other, out=tmp_path / "fresh").run(client)
    assert [p.read_bytes() for p in changed.tiles] == [p.read_bytes() for p in fresh.tiles]
