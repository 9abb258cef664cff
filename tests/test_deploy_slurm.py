"""A whole SLURM on this machine: jobs as workers, one allocation for everything, a walltime that ends in the middle.

Needs Debian's slurm-wlm and munge, root, and dask-jobqueue: `sh deploy/test.sh` brings all of it.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from ppdf_dask.plan import plan
from ppdf_dask.survey import scan
from ppdf_dask.synthetic import SyntheticParams, write_survey

DEPLOY = Path(__file__).parents[1] / "deploy"
NEEDS = ("slurmctld", "slurmd", "munged", "sbatch", "srun")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(os.geteuid() != 0 or not all(map(shutil.which, NEEDS)), reason="needs root, slurm-wlm, munge"),
]

CONF = """\
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmctldPort={port0}
SlurmdPort={port1}
AuthType=auth/munge
AuthInfo=socket={place}/munge.sock
CredType=cred/munge
StateSaveLocation={place}/state
SlurmdSpoolDir={place}/spool
SlurmctldPidFile={place}/slurmctld.pid
SlurmdPidFile={place}/slurmd.pid
SlurmctldLogFile={place}/slurmctld.log
SlurmdLogFile={place}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=1,batch_sched_delay=1
MpiDefault=none
KillWait=5
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs=8 RealMemory=16000 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    """Start munged, slurmctld and slurmd; return the environment in which their commands work."""
    place = tmp_path_factory.mktemp("slurm")
    for folder in (place, *place.parents[:2]):
        folder.chmod(0o755)
    for name in ("state", "spool", "home"):
        (place / name).mkdir()
    conf = place / "slurm.conf"
    host = socket.gethostname().split(".")[0]
    conf.write_text(CONF.format(host=host, place=place, port0=free_port(), port1=free_port()))
    (place / "munge.key").write_bytes(os.urandom(128))
    (place / "munge.key").chmod(0o400)
    environment = os.environ | {
        "SLURM_CONF": str(conf),
        "PPDF_DEPLOY": str(DEPLOY),
        "PPDF_SHARED": str(place / "home"),
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(DEPLOY.parent),
    }
    names = ("socket=munge.sock", "key-file=munge.key", "pid-file=munge.pid", "log-file=munge.log", "seed-file=seed")
    munge = ["munged", "--force", "--foreground", *(f"--{n.replace('=', f'={place}/')}" for n in names)]
    with ExitStack() as stack:
        for command in (munge, ["slurmctld", "-D"], ["slurmd", "-D", "-N", host]):
            with (place / f"{command[0]}.out").open("wb") as out:
                daemon = subprocess.Popen(command, env=environment, stdout=out, stderr=out)
            stack.callback(daemon.wait)
            stack.callback(daemon.terminate)
            time.sleep(1)
        end = time.monotonic() + 60
        while subprocess.run(["srun", "-t", "1", "true"], env=environment, capture_output=True).returncode:
            assert time.monotonic() < end, "\n".join(p.read_text() for p in place.glob("slurm*.log"))
            time.sleep(1)
        yield environment
        subprocess.run(["scancel", "-u", "root"], env=environment, check=False)
        time.sleep(2)


@pytest.fixture(scope="module")
def survey(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    write_survey(folder, SyntheticParams(density=2.0), extent=(600, 600, 840, 840), tile_size=80, truth=False)
    return folder / "tiles"


@pytest.fixture(scope="module")
def reference(survey, client, tmp_path_factory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("reference") / "run"
    plan(scan([survey]), out=out).run(client)
    return digests(out)


def digests(out: Path) -> dict[str, str]:
    files = [*sorted((out / "laz").rglob("*.laz")), out / "dtm.tif"]
    return {str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_workers_in_jobs(slurm, survey, reference, tmp_path):
    pytest.importorskip("dask_jobqueue")
    out = tmp_path / "run"
    command = [sys.executable, str(DEPLOY / "slurm" / "jobqueue.py"), str(survey), "--out", str(out), "--jobs", "2"]
    command += ["--queue", "main", "--interface", "lo", "--memory", "2GiB", "--minutes", "10"]
    ran = subprocess.run(
        [*command, "--shared", slurm["PPDF_SHARED"]],
        env=slurm, capture_output=True, text=True, check=False, timeout=900,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert digests(out) == reference
    assert not list(Path(slurm["PPDF_SHARED"]).iterdir()), "certificates are left behind"


def submit(slurm, survey: Path, out: Path, *options: str) -> str:
    """Run the batch script to its end; return how SLURM says it ended."""
    script = str(DEPLOY / "slurm" / "runner.sbatch")
    log = out.with_suffix(".log")
    command = ["sbatch", "--parsable", "--mem-per-cpu=1500", f"--output={log}", "--open-mode=append", *options, script]
    job = subprocess.run(
        [*command, str(survey), "--out", str(out), "--chunk-size", "15"],
        env=slurm, capture_output=True, text=True, check=True,
    ).stdout.strip()  # fmt: skip
    state, end = "PENDING", time.monotonic() + 900
    while state in ("PENDING", "RUNNING", "COMPLETING"):
        assert time.monotonic() < end, log.read_text()
        time.sleep(1)
        told = subprocess.run(["scontrol", "show", "job", job], env=slurm, capture_output=True, text=True, check=True)
        state = told.stdout.split("JobState=")[1].split()[0]
    return state


def test_a_walltime_that_ends_in_the_middle_and_the_same_line_again(slurm, survey, reference, tmp_path):
    pytest.importorskip("dask_jobqueue")
    out = tmp_path / "run"
    assert submit(slurm, survey, out, "--ntasks=3", "--time=1") == "TIMEOUT"
    assert not (out / "run.json").exists()
    assert any((out / "run.zarr" / "ledger" / "tile").iterdir()), "nothing was done before the walltime"
    assert submit(slurm, survey, out, "--ntasks=4", "--time=20") == "COMPLETED"
    log = out.with_suffix(".log").read_text()
    assert digests(out) == reference, log
