"""The index in the store: what it says of a chunk, and what becomes of an older one."""

from __future__ import annotations

import pytest

from ppdf_dask.index import Index, owns_points, parts_of
from ppdf_dask.store import RunStore


def tile(*chunks):
    return {"fingerprint": "f", "chunks": {chunk: [5, 1, 2] for chunk in chunks}}


# The second shares a shard with the first, the others do not.
CHUNKS = ["c_0001_0000", "c_0001_0099", "c_0001_0100", "c_0002_0000", "c_m0001_m0001"]


@pytest.fixture
def store(tmp_path):
    made = RunStore(str(tmp_path / "run.zarr"))
    made.create({})
    return made


def test_each_chunk_is_found_in_its_shard(store):
    index = Index.of({"s_000000": tile(*CHUNKS)})
    index.publish(store)
    assert len(store.indexed()) == 4
    for chunk in CHUNKS:
        assert parts_of(store, chunk) == {"core": {"s_000000": [5, "f"]}, "buffer": {"s_000000": [2, "f"]}}
        assert owns_points(store, chunk)
    assert parts_of(store, "c_0001_0001") == parts_of(store, "c_0009_0000") == {}
    assert not owns_points(store, "c_0001_0001")


def test_nothing_of_an_older_index_is_left(store):
    Index.of({"s_000000": tile(*CHUNKS)}).publish(store)
    newer = Index.of({"s_000000": tile(*CHUNKS[:1])})
    newer.publish(store)
    assert newer.is_published(store)
    assert store.indexed() == ["ledger/index/c_0001_00"]
    assert [chunk for chunk in CHUNKS if parts_of(store, chunk)] == CHUNKS[:1]


def test_a_shard_that_was_lost_is_written_again(store):
    index = Index.of({"s_000000": tile(*CHUNKS)})
    index.publish(store)
    store.drop(store.indexed()[0])
    index.publish(store)
    assert all(parts_of(store, chunk) for chunk in CHUNKS)
