"""A run with workers in SLURM jobs; this process, on a login or service node, drives it and may be started again.

    python deploy/slurm/jobqueue.py tiles/ --out RUN --jobs 20 --queue normal

Connections are encrypted with certificates made for this run alone, kept below --shared, readable by you only.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

from dask_jobqueue import SLURMCluster
from distributed import Client
from rich.console import Console

import ppdf_dask
from ppdf_dask import preflight
from ppdf_dask.cluster import ENVIRONMENT, dashboard
from ppdf_dask.progress import listen


def main() -> None:
    """Plan, ask for jobs, run."""
    ask = argparse.ArgumentParser(description=__doc__)
    ask.add_argument("tiles", nargs="+")
    ask.add_argument("--out", type=Path, required=True, help="folder of the run, on a shared file system")
    ask.add_argument("--jobs", type=int, default=4, help="jobs of one worker each")
    ask.add_argument("--memory", default="4GiB", help="of a worker")
    ask.add_argument("--minutes", type=int, default=60, help="walltime of a job; ended ones are replaced")
    ask.add_argument("--queue", help="partition")
    ask.add_argument("--interface", help="network of the compute nodes, such as ib0")
    ask.add_argument("--shared", type=Path, default=Path.home(), help="where jobs can read the certificates")
    ask.add_argument("--chunk-size", type=float)
    options = ask.parse_args()

    private = Path(tempfile.mkdtemp(prefix=".ppdf-dask-", dir=options.shared))  # mode 0700
    survey = ppdf_dask.scan(options.tiles)
    params = ppdf_dask.RunParams(chunks=ppdf_dask.ChunkParams(chunk_size=options.chunk_size))
    cluster = SLURMCluster(
        cores=1,
        processes=1,
        memory=options.memory,
        queue=options.queue,
        walltime=f"{options.minutes // 60:02d}:{options.minutes % 60:02d}:00",
        interface=options.interface,
        security=True,
        shared_temp_directory=str(private),
        log_directory=str(private),
        scheduler_options={"dashboard_address": "127.0.0.1:0"},
        job_script_prologue=[f"export {name}={value}" for name, value in ENVIRONMENT.items()],
        # A worker leaves before its job is killed, so that nothing is blamed for it.
        worker_extra_args=[
            *("--lifetime", f"{max(options.minutes - 3, 1)}m", "--lifetime-stagger", "1m"),
            # Also without a dashboard a worker answers HTTP, on all addresses unless told where.
            *("--dashboard-address", "127.0.0.1:0"),
        ],
    )
    console = Console(stderr=True)
    try:
        with cluster, Client(cluster) as client:
            cluster.adapt(minimum_jobs=options.jobs, maximum_jobs=options.jobs)
            for line in dashboard(client):
                console.print(line, markup=False)
            plan = ppdf_dask.plan(survey, params, out=options.out, memory=preflight.worker_memory(client, wait=86_400))
            with listen(console) as listener:
                print(plan.run(client, on_event=listener))
    finally:
        shutil.rmtree(private, ignore_errors=True)


if __name__ == "__main__":
    main()
