"""New classes by replacing one layer: the bytes of a full rewrite, every other byte of the source, damage is seen."""

from __future__ import annotations

import resource

import laspy
import lazrs
import numpy as np
import pytest
from lasfiles import LEGACY_COUNT, patch, points, write

from ppdf_dask import kept, merge, relabel
from ppdf_dask.errors import DamagedError, TileError
from ppdf_dask.grid import ChunkGrid
from ppdf_dask.lasheader import read_header
from ppdf_dask.layers import chunks
from ppdf_dask.merge import MergeJob
from ppdf_dask.params import RunParams
from ppdf_dask.relabel import can_relabel, differs
from ppdf_dask.store import RunStore
from ppdf_dask.survey import scan
from ppdf_dask.tiler import TileJob, cut

N = 120_000
"""Points of three chunks."""


def source(path, point_format=7, **dims):
    """Write returns, channels, classes and flags that change from point to point, and an EVLR."""
    rng = np.random.default_rng(3)
    returns = rng.integers(1, 6, N)
    write(
        path,
        points(N),
        point_format=point_format,
        return_number=np.minimum(returns, rng.integers(1, 6, N)),
        number_of_returns=returns,
        scanner_channel=rng.integers(0, 4, N),
        classification=rng.choice([1, 2, 5, 7, 20], N),
        edge_of_flight_line=rng.random(N) < 0.01,
        intensity=rng.integers(0, 65536, N),
        gps_time=np.cumsum(rng.random(N)),
        **dims,
    )
    las = laspy.read(path)
    las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("somebody", 4712, "EVLR", rng.bytes(1000))])
    las.write(path, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
    return path


def every_third(batch):
    return (np.arange(batch.start, batch.start + batch.n) % 3 == 0) & batch.eligible


def job_of(path):
    survey = scan([path], assume_units="m")
    return TileJob("s_000000", survey.tiles[0], 1.0, 1.0, RunParams(), ChunkGrid(1_000_000), 0)


@pytest.mark.parametrize("point_format", [6, 8])
def test_one_new_layer_gives_the_bytes_of_a_full_rewrite(tmp_path, monkeypatch, point_format):
    job = job_of(source(tmp_path / "a.laz", point_format))
    assert can_relabel(read_header(job.tile.path), merge.BATCH)
    quick = merge.rewrite(job, tmp_path / "quick.laz", every_third)
    monkeypatch.setattr(merge, "can_relabel", lambda header, most: False)
    full = merge.rewrite(job, tmp_path / "full.laz", every_third)
    assert quick == full
    assert 0 < quick["changed"] < N
    header = read_header(job.tile.path)
    old, new, slow = (
        (tmp_path / name).read_bytes()[header.offset_to_points :] for name in ("a.laz", "quick.laz", "full.laz")
    )
    assert new == slow
    assert new != old


def test_batches_end_with_chunks(tmp_path, monkeypatch):
    job = job_of(source(tmp_path / "a.laz"))
    merge.rewrite(job, tmp_path / "one.laz", every_third)
    monkeypatch.setattr(merge, "at_once", lambda header: 60_000)
    merge.rewrite(job, tmp_path / "three.laz", every_third)
    assert (tmp_path / "one.laz").read_bytes() == (tmp_path / "three.laz").read_bytes()


def places(path):
    """Return a byte of every kind: a header field, z and the classes of the second chunk, the EVLR."""
    header = read_header(str(path))
    with path.open("rb") as file:
        _, second, _ = chunks(file, header.laszip, header.record_length, header.offset_to_points + 8, "a")
    begin, end = second.classes
    z = second.position + second.head + second.layers[0] + 7
    return {"header": 90, "z": z, "classes": second.position + (begin + end) // 2, "evlr": header.evlrs[1] - 3}


@pytest.mark.parametrize("what", ["header", "z", "classes", "evlr"])
def test_a_byte_that_is_not_as_written_is_seen(tmp_path, monkeypatch, what):
    job, write_new = job_of(source(tmp_path / "a.laz")), merge.relabel

    def careless(path, header, part, labelled):
        write_new(path, header, part, labelled)
        data = bytearray(part.read_bytes())
        data[places(part)[what]] ^= 0x10
        part.write_bytes(data)

    monkeypatch.setattr(merge, "relabel", careless)
    with pytest.raises(TileError, match="does not read back as written"):
        merge.rewrite(job, tmp_path / "b.laz", every_third)
    assert [p.name for p in tmp_path.iterdir()] == ["a.laz"]


def test_a_chunk_table_that_is_not_as_written_is_seen(tmp_path):
    """Readers that go from start to end do not need it, so that nothing else would tell."""
    job = job_of(source(tmp_path / "a.laz"))
    target = tmp_path / "b.laz"
    merge.rewrite(job, target, every_third)
    old, new = read_header(job.tile.path), read_header(str(target))
    good = target.read_bytes()

    def table():
        with target.open("rb") as file:
            file.seek(new.offset_to_points)
            return lazrs.read_chunk_table(file, lazrs.LazVlr(new.laszip.record))

    right, wrong = table(), 0
    for byte in range(new.laszip.table + 12, new.evlrs[0]):
        for bit in (0x01, 0x40):
            target.write_bytes(good[:byte] + bytes((good[byte] ^ bit,)) + good[byte + 1 :])
            if table() != right:
                wrong += 1
                assert "chunk table" in differs(job.tile.path, old, target)
    assert wrong > 0


@pytest.mark.parametrize("point_format", [3, 7])
def test_f35_a_full_disk_is_a_sentence_whichever_way_a_tile_is_written(tmp_path, point_format):
    path = tmp_path / "a.laz"
    noise = np.random.default_rng(1).integers(0, 65536, N)
    write(path, points(N), point_format=point_format, intensity=noise)
    job, soft = job_of(path), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, soft[1]))  # met by the encoder itself, in its own words
    try:
        with pytest.raises(TileError, match=r"a\.laz could not be written to .*b\.laz"):
            merge.rewrite(job, tmp_path / "b.laz", every_third)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, soft)
    assert [p.name for p in tmp_path.iterdir()] == ["a.laz"]


def test_untidy_files_are_written_in_full(tmp_path):
    path = write(tmp_path / "a.laz", points(1000), point_format=7)
    path.write_bytes(path.read_bytes()[:-5] + bytes(5))
    header = read_header(str(path))
    assert [code for code, _ in header.warnings] == ["chunk-table"]
    assert not can_relabel(header, merge.BATCH)
    merge.rewrite(job_of(path), tmp_path / "b.laz", every_third)
    assert read_header(str(tmp_path / "b.laz")).warnings == ()


def test_a_wrong_old_count_is_handed_on_by_both(tmp_path, monkeypatch):
    path = patch(source(tmp_path / "a.laz"), LEGACY_COUNT, "I", 7)
    merge.rewrite(job_of(path), tmp_path / "quick.laz", every_third)
    monkeypatch.setattr(merge, "can_relabel", lambda header, most: False)
    merge.rewrite(job_of(path), tmp_path / "full.laz", every_third)
    assert (tmp_path / "quick.laz").read_bytes() == (tmp_path / "full.laz").read_bytes()
    assert [code for code, _ in read_header(str(tmp_path / "full.laz")).warnings] == ["legacy-count"]
    assert laspy.read(tmp_path / "full.laz").header.point_count == N


def test_other_formats_large_chunks_and_large_records_are_written_in_full(tmp_path, monkeypatch):
    layered = read_header(str(source(tmp_path / "a.laz")))
    assert can_relabel(layered, 50_000)
    assert not can_relabel(layered, 49_999)
    assert not can_relabel(read_header(str(write(tmp_path / "old.laz", point_format=1))), merge.BATCH)
    assert not can_relabel(read_header(str(write(tmp_path / "plain.las"))), merge.BATCH)
    monkeypatch.setattr(relabel, "_LARGE", 1000)  # of the EVLR, and its head
    assert not can_relabel(layered, 50_000)


def cut_small(tmp_path, most_owners):
    """Cut a tile with chunks of 20 m and answer every chunk; return the store, the job and the tile's record."""
    source(tmp_path / "a.laz")
    survey = scan([tmp_path / "a.laz"], assume_units="m")
    job = TileJob("s_000000", survey.tiles[0], 1.0, 1.0, RunParams(), ChunkGrid(20_000), 0)
    store = RunStore(str(tmp_path / "run.zarr"), "key")
    store.create({})
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(kept, "MOST_OWNERS", most_owners)
        record = cut(store, job)
    for number, (chunk, (core, _, _)) in enumerate(sorted(record["chunks"].items())):
        mask = np.random.default_rng(number).random(core) < 0.5
        store.write_classification(chunk, mask, {"s_000000": core})
    return store, job, record


def test_with_labels_the_source_is_not_decoded_again(tmp_path, monkeypatch):
    store, job, record = cut_small(tmp_path, 1000)
    assert record["labels"] == 1
    assert len(record["chunks"]) > 20
    again = merge.write_tile(store, MergeJob(job, str(tmp_path / "again.laz")))
    monkeypatch.setattr(merge, "tile_records", None)
    once = merge.write_tile(store, MergeJob(job, str(tmp_path / "once.laz"), labels=1, cut_by="key"))
    assert once == again
    assert (tmp_path / "once.laz").read_bytes() == (tmp_path / "again.laz").read_bytes()
    with pytest.raises(DamagedError, match="of another run"):
        merge.write_tile(store, MergeJob(job, str(tmp_path / "other.laz"), labels=1, cut_by="other"))


def test_labels_of_too_many_owners_are_not_kept(tmp_path):
    store, _, record = cut_small(tmp_path, 20)
    assert record["labels"] == 0
    assert store.children("labels") == []
