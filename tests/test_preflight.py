"""Pre-flight on workers that really lack something: each is a process of its own."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from distributed import Client, LocalCluster

from ppdf_dask import preflight
from ppdf_dask.errors import ClusterError
from ppdf_dask.params import ChunkParams, RunParams
from ppdf_dask.plan import Plan, plan
from ppdf_dask.survey import scan

PACKAGE = Path(preflight.__file__).parent


@pytest.fixture
def made(small_survey, tmp_path) -> Plan:
    shutil.copytree(small_survey / "tiles", tmp_path / "tiles")
    params = RunParams(chunks=ChunkParams(chunk_size=60.0))
    return plan(scan([tmp_path / "tiles"]), params, out=tmp_path / "runs" / "run")


@contextmanager
def workers(tmp_path: Path, **kinds: tuple[dict[str, str], list[str], str]) -> Iterator[tuple[Client, dict[str, str]]]:
    """Start a scheduler and one worker per kind: variables, options, and what to mount in its own namespace first."""
    with ExitStack() as stack:
        cluster = stack.enter_context(
            LocalCluster(n_workers=0, processes=False, host="tcp://127.0.0.1", dashboard_address="127.0.0.1:0")
        )
        for name, (variables, options, mounts) in kinds.items():
            command = [sys.executable, "-m", "distributed.cli.dask_worker", cluster.scheduler_address, "--no-nanny"]
            command += ["--nthreads", "1", "--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0"]
            command += ["--local-directory", str(tmp_path / "space"), "--name", name, *options]
            if mounts:
                command = ["unshare", "--mount", "sh", "-euc", f"{mounts}\nexec {shlex.join(command)}"]
            with (tmp_path / f"{name}.log").open("wb") as log:
                process = subprocess.Popen(
                    command, env=os.environ | variables, stdout=log, stderr=log, cwd=PACKAGE.parent
                )
            stack.callback(process.wait)
            stack.callback(process.kill)
        client = stack.enter_context(Client(cluster))
        client.wait_for_workers(len(kinds), timeout=120)
        names = {w: str(facts["name"]) for w, facts in client.scheduler_info(n_workers=-1)["workers"].items()}
        yield client, names


def another_zarr(tmp_path: Path) -> dict[str, str]:
    facts = tmp_path / "site" / "zarr-0.0.1.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: zarr\nVersion: 0.0.1\n")
    return {"PYTHONPATH": str(facts.parent)}


def refused(client: Client, names: dict[str, str], made: Plan) -> dict[str, set[str]]:
    """Return the checks that stopped the run, by the worker's name."""
    with pytest.raises(ClusterError, match="checks failed before the run") as caught:
        made.run(client)
    rows = str(caught.value).splitlines()[2:]
    found: dict[str, set[str]] = {}
    for row in rows:
        worker, check = row.split("  ", 1)[0], row.split("  ", 1)[1].lstrip().split("  ", 1)[0]
        found.setdefault(names[worker], set()).add(check)
    return found


def test_another_version_and_too_little_memory_stop_the_run(made, tmp_path):
    kinds = {"bad": (another_zarr(tmp_path), ["--memory-limit", "300MiB"], "")}
    with workers(tmp_path, **kinds) as (client, names):
        assert refused(client, names, made) == {"bad": {"version", "memory"}}
    assert not made.out.exists()


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("unshare"), reason="needs root and mount namespaces")
def test_each_worker_that_lacks_something_is_in_the_table(made, tmp_path):
    tiles, runs = tmp_path / "tiles", tmp_path / "runs"
    runs.mkdir()
    nowhere = {"NUMBA_CACHE_DIR": "/proc/nowhere", "HOME": "/proc/nowhere", "XDG_CACHE_HOME": "/proc/nowhere"}
    kinds = {
        "sound": ({}, [], ""),
        "old": (another_zarr(tmp_path), [], ""),
        "small": ({}, ["--memory-limit", "300MiB"], ""),
        "no_tiles": ({}, [], f"mount -t tmpfs none {tiles}"),
        "other_disk": ({}, [], f"mount -t tmpfs none {runs}"),
        "read_only": ({}, [], f"mount -o bind {runs} {runs}; mount -o remount,bind,ro {runs}"),
        "no_kernels": (nowhere, [], f"mount -o bind {PACKAGE} {PACKAGE}; mount -o remount,bind,ro {PACKAGE}"),
        "full_disk": ({}, [], f"mkdir -p {tmp_path}/space; mount -t tmpfs -o size=1m none {tmp_path}/space"),
    }
    with workers(tmp_path, **kinds) as (client, names):
        assert refused(client, names, made) == {
            "old": {"version"},
            "small": {"memory"},
            "no_tiles": {"source file"},
            "other_disk": {"shared folder"},
            "read_only": {"write"},
            "no_kernels": {"numba cache"},
            "full_disk": {"free disk"},
        }
