"""Several hosts on one machine: network namespaces with addresses of their own, TLS, a killed worker, a cut link.

Needs root and iproute2: `sh deploy/test.sh` runs it.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from certificates import make

from ppdf_dask.plan import plan
from ppdf_dask.store import RunStore
from ppdf_dask.submit import Submission
from ppdf_dask.survey import scan
from ppdf_dask.synthetic import SyntheticParams, write_survey

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("ip"), reason="needs root and iproute2"),
]

SUBNET = "10.77.0"
SCHEDULER = f"{SUBNET}.1"


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


class Hosts:
    """Namespaces on one bridge; each is a host with an address of its own."""

    def __init__(self, stack: ExitStack, environment: dict[str, str]) -> None:
        self.mark, self.stack, self.environment = f"p{os.getpid() % 10_000}", stack, environment
        self.bridge = f"{self.mark}-net"
        # The bridge lives in a namespace of its own, so that nothing of this machine is touched.
        ip("netns", "add", self.bridge)
        stack.callback(ip, "netns", "delete", self.bridge)
        self.inside("net", "ip", "link", "add", "br0", "type", "bridge")
        self.inside("net", "ip", "link", "set", "br0", "up")

    def name(self, host: str) -> str:
        return f"{self.mark}-{host}"

    def inside(self, host: str, *command: str) -> None:
        subprocess.run(["ip", "netns", "exec", self.name(host), *command], check=True, capture_output=True)

    def add(self, host: str, address: str) -> None:
        space, link = self.name(host), f"{self.mark}{host}"
        ip("netns", "add", space)
        self.stack.callback(ip, "netns", "delete", space)
        ip("link", "add", link, "netns", self.bridge, "type", "veth", "peer", "name", "eth0", "netns", space)
        self.inside("net", "ip", "link", "set", link, "master", "br0", "up")
        self.inside(host, "ip", "address", "add", f"{address}/24", "dev", "eth0")
        for device in ("lo", "eth0"):
            self.inside(host, "ip", "link", "set", device, "up")

    def link(self, host: str, state: str) -> None:
        self.inside("net", "ip", "link", "set", f"{self.mark}{host}", state)

    def start(self, host: str, *arguments: str, log: Path) -> subprocess.Popen[bytes]:
        with log.open("ab") as out:
            process = subprocess.Popen(
                ["ip", "netns", "exec", self.name(host), sys.executable, *arguments],
                env=self.environment, stdout=out, stderr=out, start_new_session=True,
            )  # fmt: skip
        self.stack.callback(process.wait)
        self.stack.callback(end_group, process)
        return process

    def run(self, host: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["ip", "netns", "exec", self.name(host), sys.executable, *arguments],
            env=self.environment, capture_output=True, text=True, check=False, timeout=600,
        )  # fmt: skip


def end_group(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)


@pytest.fixture
def hosts(tmp_path):
    environment = os.environ | make(tmp_path / "tls") | {"DASK_DISTRIBUTED__COMM__TIMEOUTS__TCP": "15s"}
    with ExitStack() as stack:
        made = Hosts(stack, environment)
        for k, host in enumerate(("s", "a", "b", "c", "me")):
            made.add(host, f"{SUBNET}.{k + 1}")
        made.start(
            "s", "-m", "distributed.cli.dask_scheduler", "--protocol", "tls", "--host", f"tls://{SCHEDULER}:8786",
            "--dashboard-address", "127.0.0.1:0", log=tmp_path / "scheduler.log",
        )  # fmt: skip
        yield made


def worker(hosts: Hosts, host: str, folder: Path) -> subprocess.Popen[bytes]:
    return hosts.start(
        host, "-m", "distributed.cli.dask_worker", f"tls://{SCHEDULER}:8786", "--nthreads", "1",
        "--memory-limit", "2GiB",
        "--dashboard-address", "127.0.0.1:0", "--local-directory", str(folder / host), "--name", host,
        log=folder / f"{host}.log",
    )  # fmt: skip


def digests(out: Path) -> dict[str, str]:
    files = [*sorted((out / "laz").rglob("*.laz")), out / "dtm.tif"]
    return {str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def wait_for(condition, seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.1)


def test_a_worker_is_killed_and_a_link_is_cut_and_restored(hosts, tmp_path, client):
    write_survey(tmp_path, SyntheticParams(density=2.0), extent=(600, 600, 800, 800), tile_size=50, truth=False)
    reference = tmp_path / "reference"
    plan(scan([tmp_path / "tiles"]), out=reference).run(client)
    workers = {host: worker(hosts, host, tmp_path) for host in "abc"}

    out, address = tmp_path / "run", f"tls://{SCHEDULER}:8786"
    command = ["-m", "ppdf_dask", "submit", str(tmp_path / "tiles"), "--out", str(out), "--scheduler"]
    plain = hosts.run("me", *command, f"tcp://{SCHEDULER}:8786")
    assert plain.returncode == 4
    assert "not encrypted" in plain.stderr
    sent = hosts.run("me", *command, address, "--chunk-size", "20")
    assert sent.returncode == 0, sent.stderr

    ledger = RunStore(str(out / "run.zarr"))

    def done() -> int:
        return sum(1 for _ in ledger.records("classify"))

    wait_for(lambda: done() >= 5)
    end_group(workers["a"])
    before = done()
    wait_for(lambda: done() >= before + 5)
    hosts.link("b", "down")
    time.sleep(25)
    hosts.link("b", "up")
    end = Submission(out).follow(lambda _: None)
    assert end["state"] == "finished", Submission(out).log()
    assert digests(out) == digests(reference)
