"""Points at the place of another: counted against a plain dictionary, refused where two tiles hold the same ones."""

import json
from collections import defaultdict
from itertools import combinations

import numpy as np
import pytest
from faulty import Inline
from hypothesis import given, settings
from hypothesis import strategies as st
from lasfiles import points, write

from ppdf_dask import repeats as module
from ppdf_dask.errors import SurveyError
from ppdf_dask.params import ChunkParams, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.repeats import repeats
from ppdf_dask.survey import scan


def plainly(points, counts):
    at = defaultdict(list)
    names = [name for name, n in counts.items() for _ in range(n)]
    for place, name in zip(points[:3].T.tolist(), names, strict=True):
        at[tuple(place)].append(name)
    shared = defaultdict(int)
    for held in at.values():
        for a, b in combinations(sorted(set(held)), 2):
            shared[f"{a} {b}"] += 1
    return len(names) - len(at), dict(sorted(shared.items()))


small = st.sampled_from([-(2**31), -5, -1, 0, 1, 7, 2**31 - 1])


@settings(deadline=None)
@given(st.lists(st.lists(st.tuples(small, small, small), max_size=12), max_size=5), st.booleans())
def test_f10_repeats_are_counted(parts, alike):
    """`alike`: every place has the same key, as if all of them collided."""
    counts = {f"s_{k:06d}": len(part) for k, part in enumerate(parts)}
    places = np.array([p for part in parts for p in part], np.int32).reshape(-1, 3).T
    with pytest.MonkeyPatch.context() as patch:
        if alike:
            patch.setattr(module, "_keys", lambda points: np.zeros(points.shape[1], np.uint64))
        assert repeats(places, counts) == plainly(places, counts)


def east(mm, metres):
    return mm + np.array([round(metres * 1000), 0, 0], mm.dtype)


def test_f11_tiles_with_common_points_are_refused_by_name(tmp_path):
    """The eastern tile was delivered with a buffer: a quarter of its width are points of the western one."""
    west, own = points(4000), points(4000, seed=1)
    width = int(west[:, 0].max() - west[:, 0].min()) / 1000
    buffer = west[west[:, 0] > west[:, 0].min() + round(width * 750)]
    write(tmp_path / "west.laz", west)
    write(tmp_path / "east.laz", np.concatenate([buffer, east(own, width + 0.001)]))
    for policy in ("error", "first"):
        with pytest.raises(SurveyError, match=r"(?s)same points.*east\.laz and .*west\.laz overlap.*--duplicates keep"):
            scan(tmp_path, duplicates=policy)
    assert len(scan(tmp_path, duplicates="keep").tiles) == 2


def test_f11_flight_lines_over_one_another_are_no_duplicates(tmp_path):
    for k in range(2):
        write(tmp_path / f"line{k}.laz", points(4000, seed=k))
    survey = scan(tmp_path)
    assert len(survey.overlaps) == 1


def test_f11_the_pairs_that_overlap_most_are_looked_at(tmp_path, monkeypatch):
    """A tile delivered anew among many that overlap a little is found first; no more than four pairs are read."""
    mm = points(2000)
    width = int(mm[:, 0].max() - mm[:, 0].min()) / 1000
    for k in range(8):
        write(tmp_path / f"t{k}.laz", east(points(2000, seed=k), k * (width - 0.5)))
    write(tmp_path / "younger.laz", east(points(2000, seed=7), 7 * (width - 0.5))[:-1])
    read = []
    truly = module.share_of_same_points
    monkeypatch.setattr(
        "ppdf_dask.pairs.share_of_same_points", lambda a, b, *units: read.append(1) or truly(a, b, *units)
    )
    with pytest.raises(SurveyError, match=r"t7\.laz and .*younger\.laz overlap by .* 100% of"):
        scan(tmp_path)
    assert len(read) == module.PAIRS


def test_f10_f11_a_run_counts_them_and_names_the_tiles(tmp_path):
    mm = points(3000)
    write(tmp_path / "in" / "a.laz", np.concatenate([mm, mm[:50]]))
    write(tmp_path / "in" / "b.laz", np.concatenate([mm[:600], points(900, seed=5)]))
    made = plan(
        scan(tmp_path / "in", duplicates="keep"), RunParams(chunks=ChunkParams(chunk_size=25.0)), out=tmp_path / "run"
    )
    said = []
    result = made.run(Inline(), on_event=lambda event: said.append(event.record.get("warning", "")))
    assert result.counts["repeated"] == 650
    assert any("shares 600 places with" in line for line in said)
    report = json.loads((tmp_path / "run" / "run.json").read_text())
    assert [p["path"] for p in report["warnings"] if p["code"] == "shared"] == [str(tmp_path / "in" / "b.laz")]
