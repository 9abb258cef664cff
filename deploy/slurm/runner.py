"""What each task of `runner.sbatch` runs: rank 0 the scheduler, rank 1 the driver, all others workers."""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

from dask_jobqueue.slurm import SLURMRunner
from distributed import Client
from rich.console import Console

import ppdf_dask
from ppdf_dask import preflight
from ppdf_dask.progress import listen


def main() -> None:
    """Take a role; the driver plans and runs."""
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("tiles", nargs="+")
    ask.add_argument("--out", type=Path, required=True)
    ask.add_argument("--chunk-size", type=float)
    options = ask.parse_args()

    per_cpu = int(os.environ.get("SLURM_MEM_PER_CPU", "0")) * 2**20 * int(os.environ.get("SLURM_CPUS_PER_TASK", "1"))
    runner = SLURMRunner(
        scheduler_file=str(Path(os.environ["PPDF_PRIVATE"]) / "scheduler-{job_id}.json"),
        scheduler_options={"protocol": "tls", "dashboard_address": "127.0.0.1:0"},
        worker_options={
            "nthreads": 1,
            "protocol": "tls",
            "memory_limit": per_cpu or "auto",
            "local_directory": tempfile.gettempdir(),
            "dashboard_address": "127.0.0.1:0",
        },
    )
    # The runner's own end asks the scheduler without certificates, which fails, and the allocation would stay until its
    # walltime; the client's shutdown works.
    with Client(runner.scheduler_address) as client:
        try:
            work(client, options)
        finally:
            client.shutdown()
            runner.scheduler_comm = None


def work(client: Client, options: argparse.Namespace) -> None:
    """Plan and run; the driver's part."""
    survey = ppdf_dask.scan(options.tiles)
    params = ppdf_dask.RunParams(chunks=ppdf_dask.ChunkParams(chunk_size=options.chunk_size))
    plan = ppdf_dask.plan(survey, params, out=options.out, memory=preflight.worker_memory(client))
    with listen(Console(stderr=True)) as listener:
        print(plan.run(client, on_event=listener))


if __name__ == "__main__":
    main()
