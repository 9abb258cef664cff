"""Damage after the fact: `verify` names it, the next run mends it; one bad piece costs only what depends on it."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from pathlib import Path

import laspy
import numpy as np
import pytest
from click.testing import CliRunner
from faulty import Inline, finished, outputs, same, small_plan

from ppdf_dask import RobustParams
from ppdf_dask.care import replay, status
from ppdf_dask.cli import group
from ppdf_dask.errors import LockedError, ParameterError, PartialRunError, ResumeError, StoreError, SurveyError
from ppdf_dask.lock import hold
from ppdf_dask.params import ClassRules
from ppdf_dask.store import RunStore, index_path
from ppdf_dask.verify import verify

CHUNK = "c_0025_0024"


@pytest.fixture
def run(undisturbed, tmp_path) -> Path:
    """A finished run to be damaged."""
    out = tmp_path / "run"
    shutil.copytree(undisturbed, out)
    (out / "puts.txt").unlink()
    return out


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def swap(path: Path) -> None:
    """Put a whole, valid object of another place there."""
    other = next(p for p in sorted(path.parent.glob("c_*")) if p != path)
    shutil.rmtree(path)
    shutil.copytree(other, path)


CORE = f"chunks/{CHUNK}/core/s_000000"
DAMAGE = [
    (flip, f"{CORE}/c/0/0", "flipped", "tile s_000000"),
    (cut_off, f"{CORE}/c/0/0", "flipped", "tile s_000000"),
    (remove, f"{CORE}/c/0/0", "missing", "tile s_000000"),
    (cut_off, f"{CORE}/zarr.json", "torn", "tile s_000000"),
    (remove, f"{CORE}/zarr.json", "missing", "tile s_000000"),
    (remove, f"chunks/{CHUNK}", "missing", "tile s_000000"),
    (flip, "labels/s_000000/000000/c/0/0", "flipped", "tile s_000000"),
    (remove, "labels/s_000000", "missing", "tile s_000000"),
    (flip, f"classification/{CHUNK}/c/0", "flipped", f"classify {CHUNK}"),
    (swap, f"classification/{CHUNK}", "foreign", f"classify {CHUNK}"),
    (remove, f"classification/{CHUNK}", "missing", f"classify {CHUNK}"),
    (remove, f"ground/{CHUNK}", "missing", f"classify {CHUNK}"),
    (flip, f"ground/{CHUNK}/c/0/0", "flipped", f"classify {CHUNK}"),
    (cut_off, "dtm/height/c/0/0", "flipped", "dtm b_m0002_0001"),
    (flip, "dtm/height/c/0/0", "flipped", "dtm b_m0002_0001"),
    (remove, "dtm/height/c/0/0", "missing", "dtm b_m0002_0001"),
    (cut_off, "dtm/height/zarr.json", "torn", "raster layout"),
    (cut_off, f"{index_path(CHUNK)}/zarr.json", "torn", "index key"),
]


@pytest.mark.parametrize(("harm", "path", "kind", "redo"), DAMAGE)
def test_f36_verify_finds_damage_and_the_next_run_mends_it(
    tiles, undisturbed, run, harm, path, kind, redo
):  # fmt: skip
    assert verify(run).redo == []
    harm(run / "run.zarr" / path)
    report = verify(run)
    assert kind in {f.kind for f in report.findings}
    assert redo in report.redo
    assert all(f.redo == redo for f in report.findings if f.kind == kind and path.startswith(f.path))
    client = Inline()
    small_plan(tiles, run).run(client)
    assert set(client.ran) <= {w.replace(" ", "-") for w in report.redo} | {"dtm-b_m0002_0001", "cog-dtm.tif"}
    assert same(run, undisturbed)
    assert verify(run).findings == []


@pytest.mark.parametrize(
    ("harm", "path", "kind", "redo"),
    [
        (flip, "laz/x000600_y000600.laz", "", "merge s_000000"),
        (cut_off, "laz/x000600_y000600.laz", "", "merge s_000000"),
        (remove, "laz/x000600_y000600.laz", "missing", "merge s_000000"),
        (flip, "dtm.tif", "flipped", "cog dtm.tif"),
        (remove, "dtm.tif", "missing", "cog dtm.tif"),
    ],
)
def test_f36_damaged_outputs_are_written_again(tiles, undisturbed, run, harm, path, kind, redo):
    harm(run / path)
    report = verify(run)
    assert report.redo == [redo]
    assert kind in report.findings[0].kind
    client = Inline()
    small_plan(tiles, run).run(client)
    assert client.ran == [redo.replace(" ", "-")]
    assert same(run, undisturbed)


def test_f36_what_nobody_claims_is_listed_and_goes_away(tiles, undisturbed, run):
    store = run / "run.zarr"
    shutil.copytree(store / CORE, store / "chunks/c_0099_0099/core/s_000000")
    shutil.copytree(store / CORE, store / f"chunks/{CHUNK}/core/s_000077")
    shutil.copytree(store / "labels/s_000000/000000", store / "labels/s_000000/000007")
    (store / CORE / "c/0/0.abc.partial").write_bytes(b"half")
    (run / "laz" / ".a.laz.123.part").write_bytes(b"half")
    (run / "laz" / "stranger.laz").write_bytes(b"not ours")
    report = verify(run)
    assert {f.kind for f in report.findings} == {"orphaned", "foreign"}
    assert len(report.findings) == 6
    assert report.redo == []
    # Foreign fragments are never read, whether or not anyone looked for them.
    assert replay(run, CHUNK) == replay(undisturbed, CHUNK) | {"peak_mb": replay(run, CHUNK)["peak_mb"]}
    client = Inline()
    small_plan(tiles, run).run(client)
    assert client.ran == []
    assert [f.path for f in verify(run).findings] == [str(run / "laz" / "stranger.laz")]
    (run / "laz" / "stranger.laz").unlink()
    assert same(run, undisturbed)


@pytest.mark.parametrize(
    "path",
    [f"{CORE}/c/0/0", f"chunks/{CHUNK}", "labels/s_000001", index_path(CHUNK), f"classification/{CHUNK}"],
)
def test_a_run_finds_damage_itself_goes_back_and_mends_it(tiles, undisturbed, run, path):
    """Nobody asked `verify`: the stage that needs the object stumbles, its maker works again, then the stage."""
    for stage in ("classify", "merge", "dtm", "cog"):
        if stage != "classify" or not path.startswith("classification"):
            shutil.rmtree(run / "run.zarr" / "ledger" / stage)
    remove(run / "run.zarr" / path)
    client = Inline()
    small_plan(tiles, run).run(client)
    assert same(run, undisturbed)


def test_verify_counts_points_and_classes_again(tiles, run):
    counts = verify(run).counts
    parts = [laspy.read(p) for p in sorted((run / "laz").glob("*.laz"))]
    classes = np.concatenate([np.asarray(p.classification) for p in parts])
    assert counts["points"] == len(classes) == sum(len(laspy.read(p)) for p in tiles.glob("*.laz"))
    assert counts["classes"] == {str(c): int(n) for c, n in zip(*np.unique(classes, return_counts=True), strict=True)}
    assert counts["ground"] == (classes == 2).sum()


def test_a_fill_value_is_never_data(run):
    store = RunStore(str(run / "run.zarr"))
    remove(run / "run.zarr" / f"classification/{CHUNK}/c/0")
    with pytest.raises(StoreError, match="has lost data"):
        store.read_classification(CHUNK)
    with pytest.raises(StoreError, match="is missing"):
        store.read_points("c_9999_9999", "core", "s_000000")


def test_verify_status_debug_on_the_command_line(run):
    shell = CliRunner()
    clean = shell.invoke(group, ["verify", str(run), "--json"])
    assert (clean.exit_code, json.loads(clean.output)["findings"]) == (0, [])
    record = json.loads(shell.invoke(group, ["debug", str(run), "c_0024_0024"]).output)
    assert record["points"] > 0
    for piece in ("s_000001", "b_m0002_0001"):
        assert shell.invoke(group, ["debug", str(run), piece]).exit_code == 0
    flip(run / "run.zarr" / f"{CORE}/c/0/0")
    damaged = shell.invoke(group, ["verify", str(run)])
    assert damaged.exit_code == 1
    assert f"flipped   {CORE}" in damaged.output
    assert "the next run will do: tile s_000000" in damaged.output
    found = json.loads(shell.invoke(group, ["status", str(run), "--json"]).output)
    assert found["finished"]
    assert found["stages"]["classify"]["done"] == found["stages"]["classify"]["tasks"] == 8
    with pytest.raises(ParameterError, match="one of its chunks is c_0024_0024"):
        replay(run, "c_7777_7777")


def test_no_run_is_said_so(tmp_path):
    for command in (verify, status):
        with pytest.raises(StoreError, match="is not a run's store"):
            command(tmp_path)


# A filter that looks only a few metres far, so that a small survey has places far from any other.
SHORT = RobustParams(cell_size=1.5, largest_building=0.0, search_radius=5.0, passes=1)

# -- one bad piece ----------------------------------------------------------------------------------------------------


@pytest.fixture
def three(tmp_path) -> Path:
    """Three tiles in a row; the middle one's body is broken behind a good header."""
    from ppdf_dask.synthetic import SyntheticParams, write_survey

    write_survey(tmp_path, SyntheticParams(density=1.0), extent=(600, 600, 900, 640), tile_size=100, truth=False)
    return tmp_path / "tiles"


def test_f5_a_broken_tile_leaves_its_place_unknown_and_the_rest_is_done(three, tmp_path):
    names = sorted(p.name for p in three.glob("*.laz"))
    whole = tmp_path / "whole"
    small_plan(three, whole, filter=SHORT).run(Inline())
    good = (three / names[2]).read_bytes()
    status_before = (three / names[2]).stat()
    # Break the body, keep size and time: the header scan cannot see it.
    broken = bytearray(good)
    start = int.from_bytes(good[96:100], "little")
    broken[start + 200 : start + 2000] = bytes(1800)
    (three / names[2]).write_bytes(broken)
    os.utime(three / names[2], ns=(status_before.st_atime_ns, status_before.st_mtime_ns))
    out = tmp_path / "run"
    with pytest.raises(PartialRunError, match=f"tile s_000002 .*{names[2]}.* cannot be|corrupt"):
        small_plan(three, out, filter=SHORT).run(Inline())
    found = json.loads((out / "failures.json").read_text())
    failure = found["failures"][0]
    assert (failure["stage"], failure["id"], failure["files"]) == ("tile", "s_000002", [str(three / names[2])])
    assert failure["bounds_m"][0] == pytest.approx(800, abs=1)
    assert "Traceback" in failure["traceback"]
    assert not (out / "run.json").exists()
    assert not (out / "dtm.tif").exists()
    assert sorted(p.name for p in (out / "laz").iterdir()) == names[:2]
    # Near the broken tile points say that they are not proven; what is proven is as if it were there.
    known, full_store = RunStore(str(out / "run.zarr")), RunStore(str(whole / "run.zarr"))
    records = dict(known.records("classify"))
    assert records["c_0031_0024"]["unproven"] > 0
    proven = [chunk for chunk, record in records.items() if record["unproven"] == 0]
    assert proven
    for chunk in proven:
        np.testing.assert_equal(known.read_classification(chunk), full_store.read_classification(chunk))
    # The file is mended: the same bytes as ever.
    (three / names[2]).write_bytes(good)
    os.utime(three / names[2], ns=(status_before.st_atime_ns, status_before.st_mtime_ns))
    client = Inline()
    small_plan(three, out, filter=SHORT).run(client)
    assert not {"tile-s_000000", "tile-s_000001"} & set(client.ran)
    assert outputs(out) == outputs(whole)


def test_a_file_that_is_left_out_leaves_its_place_unknown_too(three, tmp_path):
    """Cut off in the middle, as a download that broke: the header still says where its points are."""
    names = sorted(p.name for p in three.glob("*.laz"))
    whole, out = tmp_path / "whole", tmp_path / "run"
    small_plan(three, whole, filter=SHORT).run(Inline())
    good = (three / names[2]).read_bytes()
    (three / names[2]).write_bytes(good[: len(good) // 2])
    with pytest.raises(SurveyError, match="1 file cannot be used"):
        small_plan(three, out, filter=SHORT)
    with pytest.raises(PartialRunError, match=rf"(?s)scan chunk-table \(.*{names[2]}\): .*--accept-changes"):
        small_plan(three, out, skip_bad=True, filter=SHORT).run(Inline())
    failure = json.loads((out / "failures.json").read_text())["failures"][0]
    assert (failure["stage"], failure["id"], failure["files"]) == ("scan", "chunk-table", [str(three / names[2])])
    assert failure["bounds_m"][0] == pytest.approx(800, abs=1)
    assert not (out / "dtm.tif").exists()
    assert (out / "dtm.partial.tif").exists()
    known, full_store = RunStore(str(out / "run.zarr")), RunStore(str(whole / "run.zarr"))
    records = dict(known.records("classify"))
    assert records["c_0031_0024"]["unproven"] > 0
    proven = [chunk for chunk, record in records.items() if record["unproven"] == 0]
    assert proven
    for chunk in proven:
        np.testing.assert_equal(known.read_classification(chunk), full_store.read_classification(chunk))
    (three / names[2]).write_bytes(good)
    client = Inline()
    small_plan(three, out, filter=SHORT).run(client, accept_changes=True)
    assert not {"tile-s_000000", "tile-s_000001"} & set(client.ran)
    assert outputs(out) == outputs(whole)


def test_a_file_whose_place_nobody_knows_is_left_out_by_name(three, tmp_path):
    (three / "z.laz").write_bytes(b"<html>not found</html>")
    with pytest.raises(PartialRunError, match=r"1 pieces of work failed and 0 wait .*\n  scan signature \(.*z\.laz\)"):
        small_plan(three, tmp_path / "run", skip_bad=True).run(Inline())
    report = json.loads((tmp_path / "run" / "run.json").read_text())
    assert [(p["path"], p["code"]) for p in report["left_out"]] == [(str(three / "z.laz"), "signature")]
    assert (tmp_path / "run" / "dtm.tif").exists()
    assert len(list((tmp_path / "run" / "laz").iterdir())) == 3


def test_f23_a_tile_replaced_after_the_scan_is_set_aside(three, tmp_path):
    made = small_plan(three, tmp_path / "run")
    os.utime(sorted(three.glob("*.laz"))[1], ns=(1, 1))
    with pytest.raises(PartialRunError, match="changed since the scan"):
        made.run(Inline())


def test_one_failing_chunk_costs_only_its_tiles_and_blocks(three, tmp_path):
    def fault(key, job):
        if key == "classify-c_0035_0024":
            raise MemoryError("no more")

    whole, out = tmp_path / "whole", tmp_path / "run"
    small_plan(three, whole).run(Inline())
    with pytest.raises(PartialRunError, match="MemoryError: no more"):
        small_plan(three, out).run(Inline(fault))
    report = json.loads((out / "failures.json").read_text())
    assert report["failures"][0]["need_mb"] > 0
    assert report["failures"][0]["files"] == [str(sorted(three.glob("*.laz"))[2])]
    assert {(w["stage"], w["ident"]) for w in report["waiting"]} >= {("merge", "s_000002")}
    assert len(list((out / "laz").iterdir())) == 2
    found = status(out)
    assert found["stages"]["merge"] == {"tasks": 3, "done": 2}
    assert not found["finished"]
    assert {"classify c_0035_0024", "merge s_000002"} <= set(verify(out).redo)
    assert verify(out).findings == []
    assert replay(out, "c_0035_0024")["ground"] > 0
    client = Inline()
    small_plan(three, out).run(client)
    assert client.ran[:2] == ["classify-c_0035_0024", "merge-s_000002"]
    assert not (out / "failures.json").exists()
    assert not (out / "dtm.partial.tif").exists()
    assert outputs(out) == outputs(whole)


# -- lock, facts, targets ---------------------------------------------------------------------------------------------


def test_f37_a_second_run_is_refused_by_name(tiles, tmp_path):
    store = RunStore(str(tmp_path / "run.zarr"))
    with hold(store):
        with pytest.raises(LockedError, match=rf"in use by .* process {os.getpid()}, since .*--force-unlock"):
            small_plan(tiles, tmp_path).run(Inline())
        assert status is not None
    small_plan(tiles, tmp_path).run(Inline())
    assert store.lock() is None


def test_f37_locks_of_the_dead_and_of_other_machines(tmp_path, monkeypatch):
    from ppdf_dask import lock

    monkeypatch.setattr(lock, "PATIENCE", 0.6)
    monkeypatch.setattr(lock, "BEAT", 0.1)
    store = RunStore(str(tmp_path))
    mine = lock._me()
    # A process that is gone, on this machine: at once, whatever the clocks say.
    monkeypatch.setattr(lock, "PATIENCE", 1e9)
    store.claim(mine | {"token": "x", "pid": 2**22 + 5, "since": "3000-01-01"})
    with hold(store):
        assert store.lock()["pid"] == os.getpid()
    # The number lives again as another process.
    store.claim(mine | {"token": "x", "started": "1"})
    with hold(store):
        pass
    # Another machine that stands still: after patience. Its clock does not matter.
    monkeypatch.setattr(lock, "PATIENCE", 0.6)
    store.claim(mine | {"token": "x", "host": "elsewhere", "since": "1970-01-01"})
    with hold(store):
        pass
    # Another machine that beats: refused; by force: taken, and the loser notices.
    other = mine | {"token": "y", "host": "elsewhere"}
    store.claim(other)
    stop = threading.Event()

    def beat() -> None:
        count = 0
        while not stop.wait(0.05):
            count += 1
            store.renew(other | {"beat": count})

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        with pytest.raises(LockedError, match="elsewhere"), hold(store):
            pass
    finally:
        stop.set()
        thread.join()
    with hold(store, force=True) as check:
        store.renew(other)
        time.sleep(0.5)
        with pytest.raises(LockedError, match=r"was taken over by .* on elsewhere"):
            check()
    assert store.lock() == other, "a lock that was lost is not removed"


def test_f38_changed_inputs_and_versions_are_refused_side_by_side(tiles, run, monkeypatch):
    from ppdf_dask import stages

    with pytest.raises(ResumeError, match=r"params\.classes\.ground_class: was 2, now 8"):
        small_plan(tiles, run, classes=ClassRules(ground_class=8)).run(Inline())
    monkeypatch.setattr(stages, "__version__", "99")
    with pytest.raises(ResumeError, match=r"version: was .*, now 99"):
        small_plan(tiles, run).run(Inline())
    monkeypatch.undo()
    monkeypatch.setattr(stages, "code", lambda: "0123456789ab")
    with pytest.raises(ResumeError, match=r"code: was [0-9a-f]{12}, now 0123456789ab"):
        small_plan(tiles, run).run(Inline())
    monkeypatch.undo()
    fewer = run.parent / "fewer"
    fewer.mkdir()
    shutil.copy2(sorted(tiles.glob("*.laz"))[0], fewer)
    with pytest.raises(ResumeError, match=r"inputs\..*was \["):
        small_plan(fewer, run).run(Inline())
    small_plan(fewer, run).run(Inline(), accept_changes=True)
    assert [p.name for p in (run / "laz").iterdir()] == [p.name for p in fewer.iterdir()]
    alone = run.parent / "alone"
    small_plan(fewer, alone).run(Inline())
    assert outputs(run) == outputs(alone), "nothing of the tile that is gone was used"
    assert verify(run).findings == []


def test_f38_a_run_of_other_code_is_named_and_not_called_damaged(run, monkeypatch):
    from ppdf_dask.care import replay, status
    from ppdf_dask.seams import measure

    assert status(run)["other_code"] is None
    monkeypatch.setattr("ppdf_dask.codeprint.code", lambda: "0123456789ab")
    for look in (verify, measure, lambda out: replay(out, "s_000000")):
        with pytest.raises(StoreError, match=r"was made by ppdf_dask .*here is .*0123456789ab.*--accept-changes"):
            look(run)
    assert "0123456789ab" in status(run)["other_code"]
    assert not (run / "damage.json").exists()


def test_f24_f22_no_run_over_its_inputs_or_out_of_its_folder(tiles, tmp_path):
    shutil.copytree(tiles, tmp_path / "laz")
    with pytest.raises(SurveyError, match="inputs are never written to"):
        small_plan(tmp_path / "laz", tmp_path).run(Inline())
    (tmp_path / "out").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out" / "laz").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(SurveyError, match="leads out of"):
        small_plan(tiles, tmp_path / "out").run(Inline())


def test_run_json_tells_versions_and_peak_memory(run):
    report = json.loads((run / "run.json").read_text())
    assert {"zarr", "dask", "laspy"} <= report["packages"].keys()
    assert 0 < report["memory"]["peak_mb"] < report["memory"]["limit_mb"]
    assert report["memory"]["planned_task_mb"] > 0
    assert report["memory"]["bytes_per_point"] > 24
    assert finished(run) >= {"cog-dtm.tif"}
