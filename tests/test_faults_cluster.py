"""Real processes: workers, scheduler and client are killed, stopped and interrupted; the command is given again."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest
from faulty import Inline, finished, outputs

from ppdf_dask.params import ChunkParams, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.survey import scan

HERE = Path(__file__).parent
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


@pytest.fixture(scope="module")
def expected(tiles, tmp_path_factory) -> dict[str, int]:
    out = tmp_path_factory.mktemp("expected")
    plan(scan([tiles]), RunParams(chunks=ChunkParams(chunk_size=25.0, buffer=20.0)), out=out).run(Inline())
    return outputs(out)


class Command:
    """A `ppdf-dask run` in a process group of its own, as a terminal starts it."""

    def __init__(self, tiles: Path, out: Path, *options: str, sleep: float = 0.4) -> None:
        self.log = out.parent / f"{out.name}-{time.monotonic_ns()}.jsonl"
        environment = os.environ | {
            "DASK_DISTRIBUTED__WORKER__PRELOAD": json.dumps([str(HERE / "slow_preload.py")]),
            "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "4s",
            "FAULTY_SLEEP": str(sleep),
        }
        arguments = ["run", tiles, "--out", out, "--chunk-size", "25", "--buffer", "20", "--json-log", self.log]
        arguments += options or ["--workers", "2"]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "ppdf_dask", *map(str, arguments)],
            env=environment,
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
            text=True,
        )

    def wait_for(self, stage: str) -> None:
        """Wait until a first piece of a stage is done."""
        end = time.monotonic() + 120
        while time.monotonic() < end:
            lines = self.log.read_text().splitlines() if self.log.exists() else []
            events = [json.loads(line) for line in lines if line.endswith("}")]
            if any(e["stage"] == stage and e["state"] == "done" for e in events):
                return
            if self.process.poll() is not None:
                break
            time.sleep(0.05)
        self.process.kill()
        raise AssertionError(f"no {stage} in time: {self.process.communicate()[1]}")

    def workers(self) -> list[psutil.Process]:
        """Return the worker processes, oldest first."""
        found = []
        for p in psutil.Process(self.process.pid).children(recursive=True):
            if "spawn_main" in " ".join(p.cmdline()):
                found.append(p)
        return found

    def end(self, within: float = 180) -> tuple[int, str]:
        """Wait for the end; return exit code and what was said."""
        said = self.process.communicate(timeout=within)[1]
        return self.process.returncode, said


def gone(processes: list[psutil.Process], within: float = 30) -> bool:
    return not psutil.wait_procs(processes, timeout=within)[1]


def test_f30_f34_workers_are_killed_and_stopped_in_each_stage(tiles, expected, tmp_path):
    out = tmp_path / "run"
    command = Command(tiles, out)
    for stage, number in (("tile", signal.SIGKILL), ("classify", signal.SIGSTOP), ("merge", signal.SIGKILL)):
        command.wait_for(stage)
        for worker in command.workers()[:1]:
            worker.send_signal(number)
    code, said = command.end()
    assert code == 0, said
    assert outputs(out) == expected


def test_f31_f32_interrupted_killed_and_given_again(tiles, expected, tmp_path):
    out = tmp_path / "run"

    def once(command: Command) -> None:
        os.killpg(command.process.pid, signal.SIGINT)
        began = time.monotonic()
        code, said = command.end()
        assert time.monotonic() - began < 10
        assert code == 130, said
        assert "the same command goes on" in said
        assert "Traceback" not in said

    def twice(command: Command) -> None:
        os.killpg(command.process.pid, signal.SIGINT)
        time.sleep(0.3)
        os.killpg(command.process.pid, signal.SIGINT)
        began = time.monotonic()
        assert command.end()[0] in (130, -signal.SIGINT)
        assert time.monotonic() - began < 5

    def client_dies(command: Command) -> None:
        command.process.kill()

    def all_die(command: Command) -> None:
        for process in [*command.workers(), psutil.Process(command.process.pid)]:
            process.kill()

    steps: list[tuple[str, Callable[[Command], None]]] = [
        ("tile", once),
        ("classify", client_dies),
        ("classify", twice),
        ("merge", all_die),
    ]
    for stage, fault in steps:
        before = finished(out)
        command = Command(tiles, out)
        command.wait_for(stage)
        workers = command.workers()
        fault(command)
        command.process.communicate(timeout=60)
        assert gone(workers), "workers outlive their client"
        assert finished(out) >= before
        assert not (out / "run.json").exists()
    before = finished(out)
    command = Command(tiles, out, sleep=0.0)
    code, said = command.end()
    assert code == 0, said
    done = [json.loads(line) for line in command.log.read_text().splitlines()]
    again = {f"{e['stage']}-{e['ident']}" for e in done if e["state"] == "done"} & before
    assert not again, "finished work was done again"
    assert outputs(out) == expected


@contextmanager
def scheduler(folder: Path, port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Start a scheduler and a worker of their own."""
    environment = os.environ | {
        "DASK_DISTRIBUTED__WORKER__PRELOAD": json.dumps([str(HERE / "slow_preload.py")]),
        "FAULTY_SLEEP": "0.4",
        "PYTHONWARNINGS": "ignore",
    }
    said = (folder / "dask.log").open("ab")
    dask = [sys.executable, "-m", "dask"]
    host = ["--host", "127.0.0.1"]
    alone = ["--no-dashboard", "--nthreads", "1", "--death-timeout", "20", "--local-directory", str(folder)]
    commands = (
        [*dask, "scheduler", *host, "--port", str(port), "--no-dashboard"],
        [*dask, "worker", f"tcp://127.0.0.1:{port}", *host, *alone],
    )
    started = [subprocess.Popen(c, env=environment, stdout=said, stderr=said) for c in commands]
    try:
        yield started[0]
    finally:
        for process in started:
            process.kill()
            process.wait()
        said.close()


def test_f31_a_lost_scheduler_is_named_and_a_new_one_goes_on(tiles, expected, tmp_path):
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    out = tmp_path / "run"
    with scheduler(tmp_path, port) as process:
        command = Command(tiles, out, "--scheduler", f"tcp://127.0.0.1:{port}")
        command.wait_for("classify")
        process.kill()
        code, said = command.end(60)
    assert code == 4, said
    assert "was lost during classify" in said
    assert "the same command" in said
    before = finished(out)
    with scheduler(tmp_path, port):
        command = Command(tiles, out, "--scheduler", f"tcp://127.0.0.1:{port}")
        code, said = command.end()
    assert code == 0, said
    assert before < finished(out)
    assert outputs(out) == expected
