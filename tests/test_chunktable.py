"""Arrays in the place of dicts: the same answers for any chunks, and a few bytes of each."""

from __future__ import annotations

import dataclasses
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ppdf_dask import estimate as estimates
from ppdf_dask.chunktable import ChunkRecords, ChunkTable, chunk_at, place, places
from ppdf_dask.experiments.simulate import country
from ppdf_dask.grid import ChunkGrid, Rect, chunk_id, parse_id
from ppdf_dask.index import Index, packed
from ppdf_dask.plan import plan
from ppdf_dask.stages import Cutting, Inputs, brief
from ppdf_dask.store import RunStore, index_path
from ppdf_dask.survey import Survey

ROWS = st.integers(-250, 250) | st.integers(-(1 << 31) + 1, (1 << 31) - 1)
CHUNKS = st.tuples(ROWS, ROWS)
COUNTS = st.integers(0, 3) | st.integers(0, (1 << 32) - 1)
# Mostly of few places, so that tiles share chunks.
SHARED = st.tuples(st.integers(-1, 1), st.integers(-1, 1))
RECORDS = st.dictionaries(
    st.integers(0, 20).map("s_{:06d}".format),
    st.dictionaries(
        (SHARED | CHUNKS).map(lambda c: chunk_id(*c)), st.tuples(COUNTS, COUNTS, COUNTS).map(list), max_size=8
    ),
    max_size=6,
)


@given(st.lists(CHUNKS, unique=True))
def test_a_number_says_which_chunk(chunks):
    numbers = places(*(np.array([c[k] for c in chunks], np.int64) for k in (0, 1)))
    assert numbers.tolist() == [place(chunk_id(*c)) for c in chunks]
    assert [parse_id(chunk_at(n)) for n in numbers.tolist()] == chunks
    assert sorted(chunks) == [parse_id(chunk_at(n)) for n in sorted(numbers.tolist())]


@pytest.mark.parametrize("other", ["b_0000_0001", "s_000000", "c_0000_0002", "", "c_x_1"])
def test_what_is_no_chunk_has_no_record(other):
    table = ChunkTable(places(np.array([0]), np.array([1])), np.array([10]))
    assert "c_0000_0001" in table
    assert other not in table
    records = ChunkRecords(table, ("ground",), "shared")
    assert other not in records
    with pytest.raises(KeyError):
        records[other] = {"ground": 1, "shared": {}}


@given(st.dictionaries(CHUNKS, st.lists(st.tuples(st.integers(0, 1 << 40), st.booleans()), max_size=2)))
def test_records_are_what_was_put_last(given_records):
    chunks = sorted(given_records)
    numbers = np.array([place(chunk_id(*c)) for c in chunks], np.int64)
    records, expected = ChunkRecords(ChunkTable(numbers, numbers), ("ground",), "shared"), {}
    for chunk in chunks:
        for ground, some in given_records[chunk]:
            record = {"ground": ground, "shared": {"a b": ground} if some else {}}
            records[chunk_id(*chunk)] = expected[chunk_id(*chunk)] = record
    assert list(records.items()) == list(expected.items())
    assert len(records) == len(expected)
    assert all((chunk_id(*c) in records) == bool(given_records[c]) for c in chunks)


@given(RECORDS)
def test_the_index_says_what_the_tiles_say(tiles):
    """The oracle is a dict of each chunk."""
    expected: dict = {}
    cells, several = {}, {}
    for source, chunks in sorted(tiles.items()):
        for chunk, (core, occupied, buffer) in chunks.items():
            parts = expected.setdefault(chunk, {"core": {}, "buffer": {}})
            for part, count in (("core", core), ("buffer", buffer)):
                if count:
                    parts[part][source] = (count, f"of {source}")
            if core:
                cells[chunk] = occupied
                several.setdefault(chunk, []).append(source)
    records = {s: {"fingerprint": f"of {s}", "chunks": packed(chunks)} for s, chunks in tiles.items()}
    index = Index.of(records)
    assert dict(index.each()) == {chunk: index.parts(chunk) for chunk in expected} == expected
    points = {c: sum(n for n, _ in p["core"].values()) for c, p in expected.items()}
    assert dict(index.points) == {c: n for c, n in points.items() if n}
    assert dict(index.loaded) == {
        c: sum(n for p in parts.values() for n, _ in p.values()) for c, parts in expected.items()
    }
    alone, shared = index.cells()
    assert alone == sum(n for c, n in cells.items() if len(several[c]) == 1)
    assert dict(shared) == {c: sources for c, sources in several.items() if len(sources) > 1}
    shards: dict = {}
    for chunk, parts in expected.items():
        shards.setdefault(index_path(chunk), {})[chunk] = parts
    found = list(index.shards())
    assert len(found) == len(shards)
    assert dict(found) == shards


BOXES = st.builds(
    lambda x, y, w, h, n: (Rect(x, y, x + w, y + h), n),
    st.integers(-30_000, 30_000),
    st.integers(-30_000, 30_000),
    st.integers(0, 40_000),
    st.integers(0, 40_000),
    st.integers(0, 100_000),
)


@given(st.lists(BOXES, max_size=6), st.sampled_from([5_000, 15_000]), st.integers(0, 12_000), st.integers(1, 40))
def test_points_are_spread_over_the_chunks_of_a_tile(boxes, size, buffer, together):
    """The oracle goes from chunk to chunk; how often the sums are drawn does not show."""
    tile = country(1).tiles[0]
    tiles = [dataclasses.replace(tile, bounds=b, point_count=n, first_returns=n) for b, n in boxes]
    grid = ChunkGrid(size)
    points: dict = {}
    loaded: dict = {}
    for bounds, n in boxes:
        per_area = n / max(bounds.width * bounds.height, 1)
        for chunk in grid.over(bounds.grow(buffer)):
            points[chunk.id] = points.get(chunk.id, 0.0) + per_area * _shared(bounds, chunk.core)
            loaded[chunk.id] = loaded.get(chunk.id, 0.0) + per_area * _shared(bounds, chunk.core.grow(buffer))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimates, "TOGETHER", together)
        found = estimates.estimate(Survey(tuple(tiles), "/", None, 1.0, 1.0), grid, buffer, last=False)
    assert {c.id: c.points for c in found} == pytest.approx({c: n for c, n in points.items() if n})
    assert {c.id: c.loaded for c in found} == pytest.approx({c: loaded[c] for c, n in points.items() if n})
    assert [c.loaded for c in found] == sorted((c.loaded for c in found), reverse=True)
    assert len(found) == len(list(found))


def _shared(a: Rect, b: Rect) -> int:
    return max(0, min(a.x1, b.x1) - max(a.x0, b.x0)) * max(0, min(a.y1, b.y1) - max(a.y0, b.y0))


def test_a_driver_keeps_few_bytes_of_a_chunk(tmp_path):
    """Two surveys of as many files, one in four times as many chunks: what each chunk more costs at most.

    24 bytes in the plan, 24 in the index and 8 for its place, 32 for its first row and the two tables, 33 for its
    record; an integer in a list would be 36 alone.
    """
    survey = country(400)

    def kept(size: float) -> tuple[int, int]:
        params = dataclasses.replace(made.params, chunks=made.params.chunks.replace(chunk_size=size))
        cut = plan(survey, params, out=tmp_path)
        tracemalloc.start()
        inputs = Inputs(cut)
        tiles = {
            source: brief("tile", {"fingerprint": "f", "chunks": {c.id: [9, 1, 0] for c in cut.grid.over(t.bounds)}})
            for source, t in inputs.sources.items()
        }
        cutting = Cutting(inputs, RunStore(str(tmp_path)), tiles)
        works, records = cutting.index.points, cutting.chunk_records()
        for chunk in works:
            records[chunk] = {"ground": 10**6, "unproven": 10**6, "repeated": 10**6, "shared": {}}
        assert len(cut.chunks) == len(records) == len(cutting.index.loaded)
        now, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return len(records), now

    made = plan(survey, out=tmp_path)
    (few, least), (many, most) = kept(500.0), kept(125.0)
    assert many == 16 * few
    assert most - least < (24 + 24 + 8 + 32 + 33 + 24) * (many - few)
