"""Submit and walk away: the driver in the cluster, its folder, two runs at once, a lost driver."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from distributed import Client, LocalCluster

from ppdf_dask.cli import group
from ppdf_dask.errors import ClusterError, LockedError, StoreError
from ppdf_dask.events import Event
from ppdf_dask.params import ChunkParams, RunParams
from ppdf_dask.plan import Plan, plan
from ppdf_dask.result import Result
from ppdf_dask.store import RunStore
from ppdf_dask.submit import Submission, _Reader
from ppdf_dask.survey import scan


@pytest.fixture(scope="module")
def cluster():
    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        memory_limit="3GiB",
        dashboard_address="127.0.0.1:0",
    ) as made:
        yield made


def small(survey: Path, out: Path, size: float = 40.0) -> Plan:
    return plan(scan([survey / "tiles"]), RunParams(chunks=ChunkParams(chunk_size=size)), out=out)


def digests(out: Path) -> dict[str, str]:
    files = [*sorted((out / "laz").rglob("*.laz")), out / "dtm.tif"]
    return {str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def reference(small_survey, client, tmp_path_factory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("reference") / "run"
    small(small_survey, out).run(client)
    return digests(out)


def wait_for(condition, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def test_the_run_ends_without_its_client(small_survey, cluster, tmp_path, reference):
    made = small(small_survey, tmp_path / "run")
    with Client(cluster.scheduler_address) as client:
        began = time.monotonic()
        submission = made.submit(client)
        returned = time.monotonic() - began
    assert submission.state()["state"] in ("submitted", "running")
    heard: list[Event] = []
    end = submission.follow(heard.append)
    assert (end["state"], end["exit_code"]) == ("finished", 0)
    assert digests(tmp_path / "run") == reference
    assert Result(tmp_path / "run").counts["unproven"] == 0
    assert [e.stage for e in heard if e.state == "stage"] == ["tile", "classify", "merge", "dtm", "cog"]
    assert sum(e.state == "done" and e.stage == "tile" for e in heard) == 9
    assert returned < time.monotonic() - began


def test_the_driver_blocks_no_worker_and_two_runs_do_not_meet(small_survey, cluster, tmp_path, reference):
    # Two workers of one thread each: were the drivers to keep their threads, no task could run at all.
    with Client(cluster.scheduler_address) as client:
        both = [small(small_survey, tmp_path / name).submit(client) for name in ("a", "b")]
    assert [s.follow(lambda _: None)["state"] for s in both] == ["finished", "finished"]
    assert digests(tmp_path / "a") == digests(tmp_path / "b") == reference


def test_commands_need_only_the_folder(small_survey, cluster, tmp_path):
    out = tmp_path / "run"
    options = ["--out", str(out), "--scheduler", cluster.scheduler_address, "--chunk-size", "40"]
    run = CliRunner().invoke(group, ["submit", str(small_survey / "tiles"), *options], catch_exceptions=False)
    assert run.exit_code == 0
    assert "ppdf-dask attach" in run.stdout
    attached = CliRunner().invoke(group, ["attach", str(out)])
    assert (attached.exit_code, attached.stdout.strip()) == (0, f"{out}: finished")
    log = CliRunner().invoke(group, ["logs", str(out)]).stdout
    assert "driver starts" in log
    assert "run finished" in log
    events = [json.loads(line) for line in CliRunner().invoke(group, ["logs", str(out), "--json"]).stdout.splitlines()]
    assert events[-1]["state"] == "finished"
    assert CliRunner().invoke(group, ["cancel", str(out)]).stdout.strip() == f"{out}: finished"


def test_cancel_stops_and_the_same_submission_goes_on(small_survey, cluster, tmp_path, reference):
    made = small(small_survey, tmp_path / "run")
    with Client(cluster.scheduler_address) as client:
        submission = made.submit(client)
        wait_for(lambda: any(e.state == "done" for e in submission.events()))
        submission.cancel()
        end = submission.follow(lambda _: None)
        assert (end["state"], end["exit_code"]) == ("cancelled", 130)
        assert not (tmp_path / "run" / "run.json").exists()
        done = sum(1 for _ in RunStore(str(tmp_path / "run" / "run.zarr")).records("tile"))
        assert done > 0
        again = made.submit(client)
        assert again.follow(lambda _: None)["state"] == "finished"
    first = next(e for e in again.events() if e.state == "stage")
    assert first.record["done"] >= done
    assert digests(tmp_path / "run") == reference


def test_a_lost_driver_is_started_again_elsewhere(small_survey, cluster, tmp_path, reference):
    made = small(small_survey, tmp_path / "run", 20.0)
    with Client(cluster.scheduler_address) as client:
        submission = made.submit(client)
        wait_for(lambda: sum(e.stage == "classify" and e.state == "done" for e in submission.events()) >= 2)
        os.kill(submission.state()["pid"], signal.SIGKILL)
        assert submission.follow(lambda _: None)["state"] == "finished"
    assert submission.log().count("driver starts") == 2
    assert digests(tmp_path / "run") == reference


def test_a_folder_in_use_is_refused(small_survey, cluster, tmp_path):
    made = small(small_survey, tmp_path / "run", 20.0)
    with Client(cluster.scheduler_address) as client:
        submission = made.submit(client)
        wait_for(lambda: submission.state()["state"] == "running")
        with pytest.raises(LockedError, match="attach"):
            made.submit(client)
        submission.cancel()
        submission.follow(lambda _: None)


def test_with_no_sign_of_a_driver_the_follower_is_told(tmp_path):
    (tmp_path / "driver").mkdir()
    (tmp_path / "driver" / "request.json").write_text("{}")
    (tmp_path / "driver" / "state.json").write_text('{"state": "running"}')
    with pytest.raises(ClusterError, match="same submit command"):
        Submission(tmp_path).follow(lambda _: None, patience=0.2)


def test_nothing_submitted_is_said_so(tmp_path):
    with pytest.raises(StoreError, match="ppdf-dask submit"):
        Submission(tmp_path)


def test_a_torn_line_is_skipped_and_an_unfinished_one_waits(tmp_path):
    path = tmp_path / "events.jsonl"
    line = '{"time": 1.0, "stage": "tile", "state": "done", "ident": "s_000001", "points": 3, "total": 0, "record": {}}'
    path.write_text(line[:40] + line + "\n" + line + "\n" + line[:50])
    reader = _Reader(path)
    assert list(reader.events()) == [Event("tile", "done", "s_000001", 3)]
    with path.open("a") as file:
        file.write(line[50:] + "\n")
    assert list(reader.events()) == [Event("tile", "done", "s_000001", 3)]
    assert list(reader.events()) == []


def test_a_run_with_faults_says_what_and_keeps_the_rest(small_survey, cluster, tmp_path):
    import shutil

    shutil.copytree(small_survey / "tiles", tmp_path / "tiles")
    made = plan(scan([tmp_path / "tiles"]), RunParams(chunks=ChunkParams(chunk_size=40.0)), out=tmp_path / "run")
    bad = sorted((tmp_path / "tiles").iterdir())[4]
    with Client(cluster.scheduler_address) as client:
        data = bytearray(bad.read_bytes())
        data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
        stamp = bad.stat()
        bad.write_bytes(data)
        os.utime(bad, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
        end = made.submit(client).follow(lambda _: None)
    assert (end["state"], end["exit_code"]) == ("partial", 3)
    assert bad.name in end["error"]


def test_a_run_that_no_worker_took_up_yet_has_a_status(small_survey, cluster, tmp_path):
    made = small(small_survey, tmp_path / "run")
    with Client(cluster.scheduler_address) as client:
        submission = made.submit(client)
        assert submission.dashboard == client.dashboard_link
    (tmp_path / "copy" / "driver").mkdir(parents=True)
    request = (tmp_path / "run" / "driver" / "request.json").read_text()
    (tmp_path / "copy" / "driver" / "request.json").write_text(request)
    waiting = Submission(tmp_path / "copy").status()
    assert waiting["stages"]["tile"] == {"tasks": 9, "done": 0}
    assert waiting["submitted"] == {"state": "submitted"}
    submission.follow(lambda _: None)
    found = submission.status()
    assert found["stages"]["tile"] == {"tasks": 9, "done": 9}
    assert (found["submitted"]["state"], found["finished"]) == ("finished", True)
    said = CliRunner().invoke(group, ["status", str(tmp_path / "copy")]).stdout
    assert "submitted  submitted" in said


class Cluster:
    """A scheduler and a worker as processes of their own."""

    def __init__(self, folder: Path, environment: dict[str, str] | None = None) -> None:
        self.file, self.folder = folder / "scheduler.json", folder
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", self.file)
        wait_for(lambda: self.file.is_file() and self.file.stat().st_size)
        self.worker = self._start("worker", "--scheduler-file", self.file, "--nthreads", "1", "--no-nanny",
                                  "--memory-limit", "3GiB", "--local-directory", folder / "space")  # fmt: skip

    def _start(self, part: str, *options: object) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{part}", *map(str, options)]
        with (self.folder / f"{part}.log").open("ab") as log:
            return subprocess.Popen([*command, "--dashboard-address", "127.0.0.1:0"], stdout=log, stderr=log)

    def end(self) -> None:
        for process in (self.worker, self.scheduler):
            process.kill()
            process.wait()


@pytest.mark.slow
def test_a_lost_scheduler_and_the_same_command_on_another(small_survey, tmp_path, reference, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["submit", str(small_survey / "tiles"), "--out", "run", "--scheduler", "scheduler.json"]
    command += ["--chunk-size", "40"]
    first = Cluster(tmp_path)
    try:
        assert CliRunner().invoke(group, command, catch_exceptions=False).exit_code == 0
        submission = Submission("run")
        wait_for(lambda: any(e.stage == "classify" and e.state == "done" for e in submission.events()))
        first.scheduler.kill()
        with pytest.raises(ClusterError, match="same submit command"):
            submission.follow(lambda _: None, patience=5.0)
        assert "the scheduler at" in submission.log()
    finally:
        first.end()
    (tmp_path / "scheduler.json").unlink()
    second = Cluster(tmp_path)
    try:
        assert CliRunner().invoke(group, command, catch_exceptions=False).exit_code == 0
        assert Submission("run").follow(lambda _: None)["state"] == "finished"
    finally:
        second.end()
    assert next(e for e in Submission("run").events() if e.stage == "classify").record["done"] > 0
    assert digests(tmp_path / "run") == reference
