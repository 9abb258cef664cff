"""What exact seams cost is measured where it arises."""

from __future__ import annotations

import json

import pytest

from ppdf_dask.experiments.proof import Bit, Proof, bit_cost, cut_and_classify
from ppdf_dask.params import ChunkParams, RunParams
from ppdf_dask.survey import scan


def test_buffers_and_reruns_are_counted_apart(small_survey):
    survey = scan([small_survey / "tiles"])
    narrow, wide = (
        cut_and_classify(survey, RunParams(chunks=ChunkParams(chunk_size=60.0, buffer=buffer)))
        for buffer in (5.0, 60.0)
    )
    assert narrow.points == wide.points
    assert narrow.unproven == wide.unproven == 0
    assert narrow.first - narrow.points < wide.first - wide.points
    assert narrow.again > wide.again
    assert narrow.widest_m >= narrow.buffer_m == 5.0
    found = Proof(Bit(1000, (1.2, 1.1, 1.3), (1.0, 1.0, 1.0)), (narrow, wide))
    assert found.bit.cost == pytest.approx(0.2)
    assert "(+20.0%)" in found.markdown()
    assert json.loads(json.dumps(found.as_dict()))["cuts"][1]["first"] == wide.first


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["robust", "paper"])
def test_the_filter_is_timed_without_its_bit(small_survey, profile):
    from ppdf_dask import filters

    params = RunParams(filter=filters.parameters("ppdf", profile))
    found = bit_cost(scan([small_survey / "tiles"]), params, profile, 2)
    assert found.points > 1000
    assert len(found.with_bit) == len(found.without) == 2
    assert min(found.with_bit + found.without) > 0
