"""Commands that measure: evaluate."""

from __future__ import annotations

import json
from pathlib import Path

import click


@click.command()
@click.argument("reference", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("classified", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--score", metavar="EXPRESSION", help="Points that count, such as 'user_data==0'.")
@click.option("--json", "as_json", is_flag=True, help="Machine-readable output.")
def evaluate(reference: Path, classified: Path, score: str | None, as_json: bool) -> None:
    """Compare a classified tile with its reference, point by point.

    \b
    ppdf-dask evaluate reference.laz classified.laz
    ppdf-dask evaluate reference.laz classified.laz --score "user_data==0" --json
    """
    from ppdf_dask.evaluate import evaluate as compare

    found = compare(reference, classified, score)
    if as_json:
        click.echo(json.dumps(found.as_dict(), indent=1))
        return
    s = found.scores
    click.echo(f"{found.scored:,} points scored, {found.left_out:,} left out")
    click.echo(f"total error {s.total:.2%}   type I {s.type_i:.2%}   type II {s.type_ii:.2%}   kappa {s.kappa:.1%}")
    click.echo(f"precision {s.precision:.2%}   recall {s.recall:.2%}   F1 {s.f1:.2%}")
    click.echo(f"height error of the ground TIN {found.dtm_rmse:.3f} (RMSE, units of the file)")
