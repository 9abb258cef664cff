"""Commands that look after a run: status, verify, retry, debug. All need nothing but the run's folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from ppdf_dask.cli.jobs import _cluster, _run, json_option

run_argument = click.argument("run", type=click.Path(exists=True, file_okay=False, path_type=Path), metavar="RUN")


@click.command()
@run_argument
@json_option
def status(run: Path, as_json: bool) -> None:
    """Say what of a run is done, failed and left, from its ledger alone.

    \b
    ppdf-dask status RUN
    ppdf-dask status RUN --json
    """
    from ppdf_dask.care import status as of_run

    found = of_run(run)
    if as_json:
        click.echo(json.dumps(found, indent=1))
        return
    if found["other_code"]:
        click.echo(f"made by    {found['other_code']}: none of its work counts for this version")
    for name, s in found["stages"].items():
        click.echo(f"{name:<10} {s['done']:>8} of {s['tasks'] if s['tasks'] is not None else '?'} done")
    click.echo(f"running    {found['running'] or 'nobody'}")
    if sent := found["submitted"]:
        click.echo(f"submitted  {sent['state']} since {sent.get('since', '?')}" + _reason(sent))
    for f in found["failures"][:10]:
        click.echo(f"failed     {f['stage']} {f['id']} ({f['what']}): {f['error']}")
    if found["waiting"]:
        click.echo(f"waiting    {len(found['waiting'])} pieces for those that failed")
    click.echo(f"finished   {'yes' if found['finished'] else 'no'}")


def _reason(sent: dict[str, Any]) -> str:
    return f": {sent['error']}" if sent.get("error") else ""


@click.command()
@run_argument
@json_option
def verify(run: Path, as_json: bool) -> None:
    """Read everything a run left and compare it with the ledger. Exit code 1: damage, 3: not finished.

    What is damaged is listed, and noted in RUN/damage.json: the next `run` or `retry` makes it anew.

    \b
    ppdf-dask verify RUN
    ppdf-dask verify RUN --json
    """
    from ppdf_dask.verify import verify as check

    report = check(run)
    if as_json:
        click.echo(json.dumps(report.as_dict(), indent=1))
    else:
        for f in report.findings:
            click.echo(f"{f.kind:<9} {f.path}: {f.what}" + (f" -> {f.redo}" if f.redo else ""))
        c = report.counts
        click.echo(
            f"{c['points']:,} points in classified tiles, {c['eligible']:,} looked at, {c['ground']:,} ground; "
            f"{c['pixels']:,} pixels; {len(report.findings)} objects damaged or stray"
        )
        if report.running:
            click.echo(f"{report.running} works there now")
        if report.redo:
            more = f" and {len(report.redo) - 10} more" if len(report.redo) > 10 else ""
            click.echo(f"the next run will do: {', '.join(report.redo[:10])}{more}")
    damaged = any(f.redo for f in report.findings)
    raise SystemExit(1 if damaged else 3 if report.pending else 0)


@click.command()
@run_argument
@_cluster
@click.option("--force-unlock", is_flag=True, help="Take the folder's lock from a run that is surely gone.")
def retry(run: Path, force_unlock: bool, **cluster: Any) -> None:
    """Do what failed or is left of a run, with the inputs and parameters it has.

    \b
    ppdf-dask retry RUN
    ppdf-dask retry RUN --workers 1
    """
    from ppdf_dask.saved import load_plan

    result = _run(load_plan(run), cluster, force_unlock=force_unlock)
    if not cluster["quiet"]:
        click.echo(repr(result))


@click.command()
@run_argument
@click.argument("piece", metavar="CHUNK")
def debug(run: Path, piece: str) -> None:
    """Replay one chunk (or tile s_..., or terrain block b_...) of a run in this process; writes nothing to the run.

    \b
    ppdf-dask debug RUN c_0012_0034
    python -m pdb -m ppdf_dask debug RUN c_0012_0034
    """
    from ppdf_dask.care import replay

    click.echo(json.dumps(replay(run, piece), indent=1))
