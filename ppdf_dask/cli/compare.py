"""Commands that compare: every filter on one engine, and the sites themselves."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ppdf_dask.cli.options import stack
from ppdf_dask.cli.show import json_option, save, score_option, show, site_size_option
from ppdf_dask.errors import ParameterError, PartialRunError, SurveyError

if TYPE_CHECKING:
    from distributed import Client
    from matplotlib.axes import Axes

    from ppdf_dask.events import Listener
    from ppdf_dask.experiments.workers import SiteFile

SIX_SITES, TERRESTRIAL = "six-sites", "terrestrial"

study_options = stack(
    click.argument("data", metavar="DATA|six-sites"),
    click.option(
        "--out", type=click.Path(file_okay=False, path_type=Path), help="Folder for tables, figures, rasters."
    ),
    score_option,
    site_size_option,
    click.option("--workers", type=click.IntRange(1), metavar="N", help="Local worker processes [default: all CPUs]."),
    click.option("--scheduler", metavar="ADDRESS", help="Use this Dask scheduler instead of a local cluster."),
    click.option("--insecure", is_flag=True, help="Allow an unencrypted scheduler on another machine."),
    click.option("--quiet", is_flag=True, help="No progress."),
    json_option,
)


@click.command()
@study_options
@click.option("--filters", "names", default="all", show_default=True, metavar="LIST", help="Such as ppdf,smrf, or all.")
@click.option(
    "--profiles",
    default="default,paper",
    show_default=True,
    metavar="LIST",
    help="Parameter sets; default is each filter's first, paper every reading of the paper's Table 2, all are all; a "
    "filter without one is left out there.",
)
@click.option(
    "--config",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="TOML file with tables [FILTER.NAME]: more parameter sets, such as [smrf.steep] with slope = 0.3.",
)
@click.option("--tune", is_flag=True, help="Also a grid search per filter, leave one site out.")
@click.option("--seeds", default="11,12,13", show_default=True, metavar="LIST", help="terrestrial: plots to score.")
@click.option("--tuning-seed", default=10, show_default=True, help="terrestrial: plot to choose parameters on.")
def compare(data: str, as_json: bool, seeds: str, tuning_seed: int, **options: Any) -> None:
    """Compare filters on sites with known ground: errors, terrain models, run times.

    DATA is a folder of labelled LAS or LAZ files (class 2 is the reference ground, each file is a site), the word
    six-sites for the six synthetic sites, or the word terrestrial for PCOM against the voxel filter on scanned plots.

    \b
    ppdf-dask compare six-sites --filters all --tune --out study/
    ppdf-dask compare tiles/ --filters ppdf,smrf --profiles default --score "user_data==0"
    ppdf-dask compare six-sites --tune --out study/ --scheduler tls://10.0.0.1:8786
    ppdf-dask compare terrestrial --out study/
    """
    if data == TERRESTRIAL:
        _terrestrial(options["out"], _numbers(seeds), tuning_seed, as_json)
        return
    from ppdf_dask.experiments import compare as study
    from ppdf_dask.experiments.reports import SIX, Report, sites_csv
    from ppdf_dask.experiments.tuning import grids

    names = _names(options["names"])
    cases = study.cases(names, _names(options["profiles"]))
    if options["config"] is not None:
        cases += study.configured(options["config"])
    if len({case.name for case in cases}) < len(cases):
        raise ParameterError("two parameter sets have the same name; rename the tables of --config")
    searched = grids(list(dict.fromkeys(case.filter for case in cases))) if options["tune"] else []
    with _studied(data, options) as (out, files, client, listener):
        found = study.compare(client, files, cases, out, grids=searched, on_event=listener)
        report = Report(found, SIX if data == SIX_SITES else "")
        if options["out"] is not None:
            _write(out, "compare", report.markdown(), report.csv(), report.as_dict())
            (out / "sites.csv").write_text(sites_csv(found.sites), encoding="utf-8")
            _figures(out, found)
        click.echo(json.dumps(report.as_dict(), indent=1) if as_json else report.summary())
    if found.failures:
        lines = "\n".join(f"  {f.stage} {f.ident}: {f.error}" for f in found.failures)
        raise PartialRunError(f"{len(found.failures)} of the comparisons could not be done:\n{lines}")


@click.command()
@study_options
def sites(data: str, as_json: bool, **options: Any) -> None:
    """Measure sites with known ground: slope, canopy cover, canopy height, as table, maps and rasters.

    DATA is a folder of labelled LAS or LAZ files (class 2 is the reference ground, each file is a site), or the word
    six-sites for the six synthetic sites.

    \b
    ppdf-dask sites six-sites --out sites/
    ppdf-dask sites tiles/ --json
    """
    from ppdf_dask.experiments.compare import measure_sites
    from ppdf_dask.experiments.reports import SIX, sites_csv, sites_markdown

    with _studied(data, options) as (out, files, client, listener):
        records = measure_sites(client, files, out, on_event=listener)
        table, remark = sites_markdown(records), SIX if data == SIX_SITES else ""
        found = {"remark": remark, "sites": records}
        if options["out"] is not None:
            text = "\n\n".join(part for part in ("# Sites", remark, table) if part)
            _write(out, "sites", text, sites_csv(records), found)
            _site_maps(out, records)
        click.echo(json.dumps(found, indent=1) if as_json else table)


@contextmanager
def _studied(data: str, options: dict[str, Any]) -> Iterator[tuple[Path, list[SiteFile], Client, Listener]]:
    """Give the folder to work in, the sites, a cluster and a listener; without --out the folder goes at the end."""
    from rich.console import Console

    from ppdf_dask.cli.jobs import _connect
    from ppdf_dask.experiments.compare import site_files, write_six_sites
    from ppdf_dask.progress import listen

    console = Console(stderr=True)
    with tempfile.TemporaryDirectory(prefix="ppdf-dask-") as temporary:
        out = options["out"] or Path(temporary)
        if data != SIX_SITES and not Path(data).is_dir():
            raise SurveyError(f"{data} is no folder; give the folder of the labelled tiles, or the word {SIX_SITES}")
        folder = write_six_sites(out, options["site_size"]) if data == SIX_SITES else Path(data)
        files = site_files(folder, options["score"])
        with _connect(options) as client, listen(console, quiet=options["quiet"]) as listener:
            yield out, files, client, listener


def _figures(out: Path, found: Any) -> None:
    from ppdf_dask.experiments import figures

    folder = out / "figures"
    save(figures.errors_figure(found), folder / "errors")
    save(figures.runtime_figure(found), folder / "runtime")
    for site in (record["site"] for record in found.sites):
        if any(row.site == site for row in found.rows):
            save(figures.terrain_figure(found, out, site), folder / f"terrain-{site}")
            save(figures.difference_figure(found, out, site), folder / f"difference-{site}")
    _site_maps(out, found.sites)


def _site_maps(out: Path, records: Sequence[dict[str, Any]]) -> None:
    from ppdf_dask.experiments.figures import LAYERS, site_figure

    for layer in LAYERS:
        save(site_figure(records, out, layer), out / "figures" / f"sites-{layer}")


def _terrestrial(out: Path | None, seeds: Sequence[int], tuning_seed: int, as_json: bool) -> None:
    from ppdf_dask.experiments.reports import csv_text
    from ppdf_dask.experiments.terrestrial import removed_figure, thesis_table, total_error_figure
    from ppdf_dask.synthetic import terrestrial_plot

    table = thesis_table(seeds, tuning_seed=tuning_seed)
    if out is not None:
        rates = next(iter(next(iter(table.lines().values())).values()))
        lines = [
            [line, method, *values.values()]
            for line, methods in table.lines().items()
            for method, values in methods.items()
        ]
        _write(out, TERRESTRIAL, table.markdown(), csv_text(["data", "method", *rates], lines), table.as_dict())
        _saved(total_error_figure(table), out / "figures" / TERRESTRIAL)
        for kind in table.kinds:
            plain, clustered = (table.row(kind, method).params for method in ("3D Forest", "PCOM"))
            drawn = removed_figure(*terrestrial_plot(kind, seeds[0]), plain, clustered)
            _saved(drawn, out / "figures" / f"{TERRESTRIAL}-{kind}-removed")
    show(table, as_json=as_json)


def _saved(axes: Axes, name: Path) -> None:
    figure = axes.get_figure(root=True)
    assert figure is not None
    save(figure, name)


def _write(out: Path, name: str, text: str, lines: str, values: dict[str, Any]) -> None:
    """Write the three forms of a table."""
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.md").write_text(text + "\n", encoding="utf-8")
    (out / f"{name}.csv").write_text(lines, encoding="utf-8")
    (out / f"{name}.json").write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


def _names(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _numbers(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise ParameterError(f"--seeds {text!r} is not a list of whole numbers such as 11,12,13") from None
