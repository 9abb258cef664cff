"""Runs that live in a cluster: submit, attach, logs, cancel; and doctor."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import click

from ppdf_dask.cli.options import filter_options, run_options, run_params, survey_options, tiles_argument

run_argument = click.argument("run", type=click.Path(file_okay=False, path_type=Path), metavar="RUN")


@click.command()
@tiles_argument
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Folder of the run.")
@click.option("--scheduler", metavar="ADDRESS", required=True, help="Dask scheduler, or a scheduler file.")
@click.option("--insecure", is_flag=True, help="Allow an unencrypted scheduler on another machine.")
@survey_options
@filter_options
@run_options
@click.option("--overwrite", is_flag=True, help="Start anew where a run exists.")
@click.option("--accept-changes", is_flag=True, help="Go on with changed inputs or parameters; redo what they touch.")
def submit(tiles: tuple[str, ...], out: Path, scheduler: str, insecure: bool, **options: Any) -> None:
    """Hand a run to a cluster and return at once; the same command goes on where an earlier one stopped.

    \b
    ppdf-dask submit tiles/ --out RUN --scheduler tls://10.0.0.1:8786
    ppdf-dask attach RUN
    """
    from ppdf_dask.cluster import connect, dashboard
    from ppdf_dask.plan import plan as make_plan
    from ppdf_dask.preflight import worker_memory
    from ppdf_dask.survey import scan

    again = {name: options.pop(name) for name in ("overwrite", "accept_changes")}
    params = run_params(options)
    survey = scan(list(tiles), **options)
    for problem in survey.problems:
        click.echo(f"{problem.path}: {problem.message}", err=True)
    with connect(scheduler, insecure=insecure) as client:
        made = make_plan(survey, params, out=out, memory=worker_memory(client))
        click.echo(repr(made), err=True)
        made.submit(client, **again)
        for line in dashboard(client):
            click.echo(line)
    click.echo(f"submitted; look at it with: ppdf-dask attach {out}")


@click.command()
@run_argument
@click.option("--quiet", is_flag=True, help="No progress, only the end.")
def attach(run: Path, quiet: bool) -> None:
    """Show the progress of a submitted run until it ends; Ctrl-C leaves it running. Needs no scheduler.

    \b
    ppdf-dask attach RUN
    """
    from rich.console import Console

    from ppdf_dask.cluster import dashboard_lines
    from ppdf_dask.progress import listen
    from ppdf_dask.submit import ENDED, Submission

    submission = Submission(run)
    state = submission.state()
    if not quiet:
        click.echo(f"{run}: {state['state']} since {state.get('since', '?')}", err=True)
        for line in dashboard_lines(submission.dashboard) if state["state"] not in ENDED else ():
            click.echo(line, err=True)
    try:
        with listen(Console(stderr=True), quiet=quiet) as listener:
            state = submission.follow(listener)
    except KeyboardInterrupt:
        click.echo(f"left; the run goes on. ppdf-dask attach {run}, or ppdf-dask cancel {run}", err=True)
        sys.exit(130)
    click.echo(f"{run}: {state['state']}" + (f": {state['error']}" if state["error"] else ""))
    sys.exit(state["exit_code"])


@click.command()
@run_argument
@click.option("--json", "as_json", is_flag=True, help="The events as JSON lines.")
def logs(run: Path, as_json: bool) -> None:
    """Print the log of a submitted run: starts, stages, failures with their reasons. Needs no scheduler.

    \b
    ppdf-dask logs RUN
    """
    import dataclasses

    from ppdf_dask.submit import Submission

    submission = Submission(run)
    if as_json:
        for event in submission.events():
            click.echo(json.dumps(dataclasses.asdict(event)))
    else:
        click.echo(submission.log(), nl=False)


@click.command()
@run_argument
@click.option("--wait", type=float, default=60.0, show_default=True, metavar="S", help="Seconds to wait for the end.")
def cancel(run: Path, wait: float) -> None:
    """Stop a submitted run; what is done stays, and the same submit command goes on. Needs no scheduler.

    \b
    ppdf-dask cancel RUN
    """
    from ppdf_dask.submit import ENDED, Submission

    submission = Submission(run)
    state = submission.state()["state"]
    if state not in ENDED:
        submission.cancel()
        end = time.monotonic() + wait
        while state not in ENDED and time.monotonic() < end:
            time.sleep(0.5)
            state = submission.state()["state"]
    if state in ENDED:
        click.echo(f"{run}: {state}")
    else:
        click.echo(f"{run}: asked to stop, but its driver does not answer; it stops as soon as it looks")


@click.command()
@click.option("--scheduler", metavar="ADDRESS", help="Also ask this Dask scheduler's workers.")
@click.option("--insecure", is_flag=True, help="Allow an unencrypted scheduler on another machine.")
@click.option("--json", "as_json", is_flag=True, help="Machine-readable output.")
def doctor(scheduler: str | None, insecure: bool, as_json: bool) -> None:
    """Print what a bug report needs: versions, machine, memory, disk, where kernels are kept. No environment, no paths.

    \b
    ppdf-dask doctor
    ppdf-dask doctor --scheduler tls://10.0.0.1:8786
    """
    from ppdf_dask.doctor import cluster_facts, facts

    found = facts()
    if scheduler:
        from ppdf_dask.cluster import connect

        with connect(scheduler, insecure=insecure) as client:
            found["workers"] = cluster_facts(client)
    if as_json:
        click.echo(json.dumps(found, indent=1))
        return
    for name, value in found.items():
        if isinstance(value, dict):
            click.echo(f"{name}:")
            for key, part in value.items():
                click.echo(f"  {key:<14} {part}")
        else:
            click.echo(f"{name}: {value}")
