"""Real processes: workers, scheduler and client are killed, stopped and interrupted; the command is given again."""

from __future__ import annotations

import getpass
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
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


STAGES = ("tile", "classify", "merge", "dtm", "cog")


@pytest.fixture(autouse=True, scope="module")
def interruptible() -> Iterator[None]:
    """A suite started in the background ignores SIGINT, and so would the commands it starts: no terminal does that."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Command:
    """A `ppdf-dask` command in a process group of its own, as a terminal starts it."""

    def __init__(self, tiles: Path, out: Path, *options: str, sleep: float = 0.4, **environment: str) -> None:
        self.log = out.parent / f"{out.name}-{time.monotonic_ns()}.jsonl"
        arguments = ["run", tiles, "--out", out, "--chunk-size", "25", "--buffer", "20", "--json-log", self.log]
        arguments += options or ["--workers", "2"]
        self.process = start(arguments, FAULTY_SLEEP=str(sleep), **environment)

    def wait_for(self, stage: str) -> None:
        """Wait until a piece of a stage is done, or under way where there is only one."""
        end = time.monotonic() + 120
        while time.monotonic() < end:
            lines = self.log.read_text().splitlines() if self.log.exists() else []
            events = [json.loads(line) for line in lines if line.endswith("}")]
            mine = [e for e in events if e["stage"] == stage]
            if any(e["state"] == "done" for e in mine):
                return
            if any(e["record"].get("tasks") == 1 for e in mine):
                time.sleep(0.2)
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


def start(arguments: list[object], **environment: str) -> subprocess.Popen[str]:
    variables = {
        "DASK_DISTRIBUTED__WORKER__PRELOAD": json.dumps([str(HERE / "slow_preload.py")]),
        "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "10s",
        # With Dask's own way with lost workers, no worker would ever come back: ours has to win.
        "DASK_DISTRIBUTED__DEPLOY__LOST_WORKER_TIMEOUT": "100ms",
        "FAULTY_SLEEP": "0.0",
    }
    return subprocess.Popen(
        [sys.executable, "-m", "ppdf_dask", *map(str, arguments)],
        env=os.environ | variables | environment,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        text=True,
    )


def told(*arguments: object, **environment: str) -> tuple[int, str]:
    """Run a command to its end; return exit code and what was said, which is never a traceback."""
    process = start(list(arguments), **environment)
    said = process.communicate(timeout=180)[1]
    assert "Traceback" not in said, said
    return process.returncode, said


def gone(processes: list[psutil.Process], within: float = 30) -> bool:
    return not psutil.wait_procs(processes, timeout=within)[1]


def hit(command: Command, stage: str, number: signal.Signals) -> None:
    """Send a signal to one worker, to all where only one of them has something to do."""
    command.wait_for(stage)
    for worker in command.workers()[: None if stage in ("dtm", "cog") and number == signal.SIGKILL else 1]:
        worker.send_signal(number)


def test_f30_f34_workers_are_killed_and_stopped_in_each_stage(tiles, expected, tmp_path):
    out = tmp_path / "run"
    command = Command(tiles, out)
    for stage in STAGES:
        hit(command, stage, signal.SIGSTOP if stage == "classify" else signal.SIGKILL)
    code, said = command.end()
    assert code == 0, said
    assert outputs(out) == expected


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_f30_f34_any_signal_in_any_stage(tiles, expected, tmp_path, stage, number):
    command = Command(tiles, tmp_path / "run")
    hit(command, stage, number)
    code, said = command.end()
    assert code == 0, said
    assert outputs(tmp_path / "run") == expected


def once(command: Command, number: signal.Signals = signal.SIGINT) -> None:
    os.killpg(command.process.pid, number)
    code, said = command.end(60)  # seconds on a machine with nothing else to do; this tells a hang
    assert code == 130, said
    assert "the same command goes on" in said
    assert "Traceback" not in said


def ended_by_the_queue(command: Command) -> None:
    """As a batch system does before the time is up, and a terminal that is closed: the command alone."""
    command.process.send_signal(signal.SIGTERM)
    code, said = command.end(30)
    assert code == 130, said
    assert "the same command goes on" in said


def twice(command: Command) -> None:
    os.killpg(command.process.pid, signal.SIGINT)
    time.sleep(0.3)
    os.killpg(command.process.pid, signal.SIGINT)
    assert command.end(60)[0] in (130, -signal.SIGINT)


def client_dies(command: Command) -> None:
    command.process.kill()


def all_die(command: Command) -> None:
    for process in [*command.workers(), psutil.Process(command.process.pid)]:
        process.kill()


FAULTS = (once, twice, ended_by_the_queue, client_dies, all_die)


def harm(tiles: Path, out: Path, stage: str, fault: Callable[[Command], None]) -> None:
    """Start or go on, do harm in a stage: workers end, nothing that was done is lost, nothing looks finished."""
    before = finished(out)
    command = Command(tiles, out)
    command.wait_for(stage)
    workers = command.workers()
    fault(command)
    command.process.communicate(timeout=60)
    assert gone(workers), "workers outlive their client"
    assert finished(out) >= before
    assert not (out / "run.json").exists()


def goes_on(tiles: Path, out: Path) -> dict[str, int]:
    """Give the command again: only what is not done yet is done; return what `outputs` does."""
    before = finished(out)
    command = Command(tiles, out, sleep=0.0)
    code, said = command.end()
    assert code == 0, said
    done = [json.loads(line) for line in command.log.read_text().splitlines()]
    again = {f"{e['stage']}-{e['ident']}" for e in done if e["state"] == "done"} & before
    assert not again, "finished work was done again"
    return outputs(out)


def test_f31_f32_interrupted_killed_and_given_again(tiles, expected, tmp_path):
    out = tmp_path / "run"
    for stage, fault in (
        ("tile", once),
        ("classify", client_dies),
        ("classify", twice),
        ("merge", all_die),
    ):  # the last stages are over in a moment: on a busy machine the harm may come too late, so they are slow tests
        harm(tiles, out, stage, fault)
    assert goes_on(tiles, out) == expected


@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_f31_f32_any_end_in_any_stage(tiles, expected, tmp_path, stage):
    for fault in FAULTS:
        out = tmp_path / fault.__name__
        harm(tiles, out, stage, fault)
        assert goes_on(tiles, out) == expected


def test_f37_f33_a_second_run_is_refused_and_the_culprit_alone_is_set_aside(tiles, expected, tmp_path):
    """Real deaths of real workers: the chunk is named with all that helps, replayed, tried again."""
    out = tmp_path / "run"
    command = Command(
        tiles, out, FAULTY_KILL="c_0025_0024", DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="1", sleep=0.5
    )
    command.wait_for("tile")
    code, said = told("run", tiles, "--out", out, "--chunk-size", "25", "--buffer", "20", "--workers", "1")
    assert code == 2, said
    assert f"is in use by {getpass.getuser()} on {socket.gethostname()}, process {command.process.pid}" in said
    code, said = command.end()
    assert code == 3, said
    assert re.search(r"classify c_0025_0024 \(needs about \d+ MB, a worker has \d+ MB\): ended its worker", said)
    report = json.loads((out / "failures.json").read_text())
    assert [f["id"] for f in report["failures"]] == ["c_0025_0024"]
    failure = report["failures"][0]
    assert failure["bounds_m"] == [625.0, 600.0, 650.0, 625.0]
    assert failure["files"] == [str(t) for t in sorted(tiles.glob("*.laz"))]
    assert "KilledWorker" in failure["traceback"]
    assert failure["need_mb"] > 0
    assert len([d for d in finished(out) if d.startswith("classify")]) == 7
    assert told("verify", out)[0] == 3
    assert told("debug", out, "c_0025_0024")[0] == 0
    before = finished(out)
    assert told("retry", out, "--workers", "1")[0] == 0
    assert before < finished(out)
    assert not (out / "failures.json").exists()
    assert outputs(out) == expected


@contextmanager
def small_disk(folder: Path, **limits: str) -> Iterator[Callable[..., None]]:
    """Mount a small disk; yields what gives it other limits."""
    folder.mkdir(parents=True)
    if os.getuid() != 0:
        pytest.skip("only root may mount a small disk")

    def options(given: dict[str, str]) -> str:
        return ",".join(f"{k}={v}" for k, v in given.items())

    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", options(limits), "tmpfs", folder], capture_output=True)
    if mounted.returncode:
        pytest.skip("no leave to mount a small disk here")
    try:
        yield lambda **now: subprocess.run(["mount", "-o", f"remount,{options(now)}", folder], check=True)
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


@pytest.mark.parametrize("moment", [70, *(pytest.param(n, marks=pytest.mark.slow) for n in (25, 160))])
def test_f35_no_files_left_under_a_run(tiles, expected, tmp_path, moment):
    """The disk has room but no more files to give: no pre-flight can see it, the run meets it on its way."""
    with small_disk(tmp_path / "disk", nr_inodes=str(moment)) as more:
        out = tmp_path / "disk" / "run"
        words = ("run", tiles, "--out", out, "--chunk-size", "25", "--buffer", "20", "--workers", "1", "--quiet")
        code, said = told(*words)
        assert code not in (0, 130), said
        assert "o space left on device" in said
        assert str(out) in said
        assert not (out / "run.json").exists()
        assert all(outputs(out)[name] == expected[name] for name in outputs(out) if not name.startswith("laz/."))
        more(nr_inodes="10000")
        assert told(*words)[0] == 0
        assert outputs(out) == expected


def test_f35_no_room_to_spill(tiles, expected, tmp_path):
    """Fragments wait on a temporary disk of their own while a tile is cut; it is too small for them."""
    with small_disk(tmp_path / "spill", size="16k", nr_inodes="1000") as more:
        out = tmp_path / "run"
        words = ("run", tiles, "--out", out, "--chunk-size", "25", "--buffer", "20", "--workers", "1", "--quiet")
        where = {"TMPDIR": str(tmp_path / "spill"), "DASK_TEMPORARY_DIRECTORY": str(tmp_path / "dask")}
        code, said = told(*words, **where, FAULTY_SPILL="10")
        assert code == 1, said
        assert f"the temporary folder {tmp_path / 'spill'}" in said
        assert not finished(out)
        more(size="20m")
        assert told(*words, **where, FAULTY_SPILL="10")[0] == 0
        assert outputs(out) == expected


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


@contextmanager
def scheduler(
    folder: Path, port: int, workers: Iterable[tuple[int, float]] = (), *, nanny: bool = True
) -> Iterator[subprocess.Popen[bytes]]:
    """Start a scheduler and workers of their own.

    `workers`: the port each one finds the scheduler at, and how many seconds its work takes longer; default: one.
    """
    environment = os.environ | {
        "DASK_DISTRIBUTED__WORKER__PRELOAD": json.dumps([str(HERE / "slow_preload.py")]),
        "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "5s",
        "PYTHONWARNINGS": "ignore",
    }
    said = (folder / "dask.log").open("ab")
    dask = [sys.executable, "-m", "dask"]
    host = ["--host", "127.0.0.1"]
    alone = ["--no-dashboard", "--nthreads", "1", "--death-timeout", "20", "--local-directory", str(folder)]
    commands = [([*dask, "scheduler", *host, "--port", str(port), "--no-dashboard"], 0.0)]
    how = [] if nanny else ["--no-nanny"]
    for at, sleep in workers or [(port, 0.4)]:
        commands.append(([*dask, "worker", f"tcp://127.0.0.1:{at}", *host, *alone, *how], sleep))
    started = [
        subprocess.Popen(c, env=environment | {"FAULTY_SLEEP": str(sleep)}, stdout=said, stderr=said)
        for c, sleep in commands
    ]
    try:
        yield started[0]
    finally:
        for process in started:
            process.kill()
            process.wait()
        said.close()


class Link:
    """A way to a port that can be cut as a network is: nobody is told, what is sent does not arrive."""

    def __init__(self, port: int) -> None:
        self._port, self._open = port, threading.Event()
        self._open.set()
        self._threads: list[threading.Thread] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._start(self._accept)

    def cut(self) -> None:
        self._open.clear()

    def end(self) -> None:
        self._open.set()
        self._listener.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(10)
        self._listener.close()

    def _start(self, call: Callable[..., None], *arguments: socket.socket) -> None:
        self._threads.append(threading.Thread(target=call, args=arguments, daemon=True))
        self._threads[-1].start()

    def _accept(self) -> None:
        while True:
            try:
                near = self._listener.accept()[0]
            except OSError:
                return
            try:
                far = socket.create_connection(("127.0.0.1", self._port))
            except OSError:
                near.close()
                continue
            self._start(self._pump, near, far)
            self._start(self._pump, far, near)

    def _pump(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                self._open.wait()
                target.sendall(data)
        with suppress(OSError):
            target.shutdown(socket.SHUT_RDWR)
        source.close()


@pytest.mark.slow
@pytest.mark.parametrize("nanny", [False, True])
def test_f34_a_cut_network_and_a_worker_twenty_times_slower(tiles, expected, tmp_path, nanny):
    """The work of the worker that cannot be heard is given to others; what it still writes does no harm.

    Where there is a nanny, Dask asks it twice for half a minute before it gives the worker up.
    """
    out, port = tmp_path / "run", free_port()
    link = Link(port)
    try:
        with scheduler(tmp_path, port, [(port, 0.2), (port, 4.0), (link.port, 3.0)], nanny=nanny):
            command = Command(tiles, out, "--scheduler", f"tcp://127.0.0.1:{port}")
            command.wait_for("tile")
            link.cut()
            code, said = command.end()
    finally:
        link.end()
    assert code == 0, said
    assert outputs(out) == expected


@pytest.mark.parametrize(
    "stage", ["classify", *(pytest.param(s, marks=pytest.mark.slow) for s in STAGES if s != "classify")]
)
def test_f31_a_lost_scheduler_is_named_and_a_new_one_goes_on(tiles, expected, tmp_path, stage):
    out, port = tmp_path / "run", free_port()
    with scheduler(tmp_path, port) as process:
        command = Command(tiles, out, "--scheduler", f"tcp://127.0.0.1:{port}")
        command.wait_for(stage)
        process.kill()
        code, said = command.end(60)
    assert code == 4, said
    assert f"was lost during {stage}" in said
    assert "the same command" in said
    before = finished(out)
    with scheduler(tmp_path, port):
        command = Command(tiles, out, "--scheduler", f"tcp://127.0.0.1:{port}")
        code, said = command.end()
    assert code == 0, said
    assert before < finished(out)
    assert outputs(out) == expected
