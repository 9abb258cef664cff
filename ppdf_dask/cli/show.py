"""What the studies share: one filter of the user's choice, progress, and how results are shown and saved."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import click

from ppdf_dask.cli.options import stack
from ppdf_dask.errors import ParameterError
from ppdf_dask.params import Parameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ppdf_dask.experiments.labelled import Labelled

T = TypeVar("T")


class Study(Protocol):
    """What an experiment returns."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""

    def markdown(self) -> str:
        """Return a table."""


json_option = click.option("--json", "as_json", is_flag=True, help="Machine-readable output.")

plot_option = click.option(
    "--plot",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="NAME",
    help="Write the figure to NAME.png and NAME.svg.",
)

score_option = click.option("--score", metavar="EXPRESSION", help="Points that count, such as 'user_data==0'.")

chosen_filter = stack(
    click.option("--filter", "filter_name", default="ppdf", show_default=True, help="Ground filter."),
    click.option("--profile", help="Parameter set of the filter [default: its first]."),
    click.option(
        "--set", "changes", multiple=True, metavar="NAME=VALUE", help="Change one parameter; may be repeated."
    ),
)


site_size_option = click.option(
    "--site-size",
    type=click.FloatRange(20, 300),
    default=300.0,
    show_default=True,
    metavar="M",
    help="This much of the edge of each synthetic site, around its middle.",
)

clouds_argument = stack(
    click.argument("clouds", nargs=-1, type=click.Path(exists=True, path_type=Path), metavar="[CLOUDS]..."),
    score_option,
    site_size_option,
)
"""Labelled files or folders; without any, the six synthetic sites."""


def sources(clouds: Sequence[Path], score: str | None, site_size: float) -> list[Callable[[], Labelled]]:
    """Return functions that load one cloud each, so that one is in memory at a time."""
    from ppdf_dask.experiments.labelled import files_in, read, site
    from ppdf_dask.synthetic import six_sites

    if not clouds:
        return [partial(site, s.middle(site_size)) for s in six_sites()]
    files = [path for given in clouds for path in (files_in(given) if given.is_dir() else [given])]
    return [partial(read, path, score) for path in files]


def chosen(filter_name: str, profile: str | None, changes: Sequence[str] = ()) -> Parameters:
    """Return the parameter object that `chosen_filter`'s options ask for.

    Examples
    --------
    >>> chosen("ppdf", None, ["tolerance=0.3"]).tolerance
    0.3
    >>> chosen("ppdf", None, ["steps=planes,growth"]).steps
    ('planes', 'growth')
    """
    from ppdf_dask import filters

    base = filters.parameters(filter_name, profile)
    values: dict[str, Any] = {}
    for change in changes:
        name, sign, text = change.partition("=")
        if not sign:
            raise ParameterError(f"--set {change!r} is not NAME=VALUE, such as tolerance=0.3")
        try:
            values[name.strip()] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            listed = isinstance(getattr(base, name.strip(), None), tuple)
            values[name.strip()] = tuple(part.strip() for part in text.split(",")) if listed else text.strip()
    return base.replace(**values)


def tracked(items: Sequence[T], title: str) -> Iterator[T]:
    """Yield the items and show on a terminal's error channel how many are done."""
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    yield from track(items, description=title, console=console, disable=not console.is_terminal, transient=True)


@contextmanager
def ticking(steps: int, title: str) -> Iterator[Callable[[str], None]]:
    """Give a function to be called with a name after each of `steps` steps; a terminal's error channel shows it."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task(title, total=steps)
        yield lambda name: progress.update(task, advance=1, description=f"{title}: {name}")


def show(found: Study, *, as_json: bool) -> None:
    """Print a result as a table or as JSON."""
    click.echo(json.dumps(found.as_dict(), indent=1) if as_json else found.markdown())


def save(figure: Figure, name: Path) -> None:
    """Write a figure as PNG and SVG, both without a clock."""
    stem = name.with_suffix("") if name.suffix.lower() in (".png", ".svg") else name
    stem.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(stem.with_name(stem.name + ".png"), dpi=150)
    figure.savefig(stem.with_name(stem.name + ".svg"), metadata={"Date": None})
    click.echo(f"{stem}.png, {stem}.svg", err=True)
