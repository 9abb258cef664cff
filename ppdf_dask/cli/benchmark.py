"""Commands that measure the product itself: how right, how fast."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ppdf_dask.cli.show import chosen, chosen_filter, json_option, score_option, show, tracked


@click.group()
def benchmark() -> None:
    """Measure accuracy on labelled clouds, and speed."""


@benchmark.command()
@click.argument("data", type=click.Path(exists=True, file_okay=False, path_type=Path), metavar="DATA_DIR")
@score_option
@chosen_filter
@json_option
def accuracy(data: Path, score: str | None, as_json: bool, **options: Any) -> None:
    """Score one filter, with one set of parameters, on every labelled cloud of a folder.

    Class 2 is the reference ground. DATA_DIR's subfolder als is taken if there is one. Where the reference's ground is
    thinned (r30 above 0.5: seen from the data), type II and kappa mean nothing and the cloud is not in the means.

    \b
    ppdf-dask benchmark accuracy DATA --score "user_data==0"
    ppdf-dask benchmark accuracy DATA --score "user_data==0" --profile paper --json
    ppdf-dask benchmark accuracy DATA --filter smrf --set threshold=0.3
    """
    from ppdf_dask.experiments.accuracy import AccuracyTable, measure
    from ppdf_dask.experiments.labelled import files_in, read

    params = chosen(**options)
    rows = [measure(read(path, score), params) for path in tracked(files_in(data), "clouds")]
    show(AccuracyTable(params, tuple(rows)), as_json=as_json)
