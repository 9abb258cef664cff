"""Options that several commands share, and the parameter objects they become."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from ppdf_dask.errors import ParameterError
from ppdf_dask.params import ChunkParams, ClassRules, DtmParams, Parameters, RunParams

F = TypeVar("F", bound=Callable[..., Any])

TABLES: dict[str, type[Parameters]] = {"classes": ClassRules, "chunks": ChunkParams, "dtm": DtmParams}


def stack(*decorators: Callable[[F], F]) -> Callable[[F], F]:
    """Make one decorator of several, applied in the order given."""

    def apply(function: F) -> F:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return apply


tiles_argument = click.argument("tiles", nargs=-1, required=True, metavar="TILES...")

survey_options = stack(
    click.option("--assume-crs", metavar="CRS", help="CRS of tiles that carry none, such as EPSG:25832."),
    click.option(
        "--assume-units", type=click.Choice(["m", "ft", "us-ft"]), help="Units of coordinates where nothing tells."
    ),
    click.option(
        "--duplicates",
        type=click.Choice(["error", "keep", "first"]),
        default="error",
        show_default=True,
        help="What to do with a tile given twice, or with points that two tiles share (error or keep).",
    ),
    click.option("--skip-bad", is_flag=True, help="Leave out unreadable tiles instead of stopping."),
    click.option(
        "--checksums",
        type=click.Path(exists=True, dir_okay=False),
        metavar="LIST",
        help="List as sha256sum writes it; each tile is compared with it when it is read.",
    ),
)

filter_options = stack(
    click.option("--filter", "filter_name", default="ppdf", show_default=True, help="Ground filter to use."),
    click.option("--profile", help="Parameter set of the filter: for ppdf robust (default) or paper."),
    click.option("--returns", type=click.Choice(["last", "all"]), help="Returns the filter sees [default: its own]."),
    click.option(
        "--mode",
        type=click.Choice(["update", "refine", "reset"]),
        help="update: only ground and former ground change; refine: existing ground stays; reset: the rest becomes 1.",
    ),
    click.option("--ground-class", type=int, help="Class written for ground [default: 2]."),
    click.option("--from-classes", metavar="LIST", help="Only these classes are looked at, such as 0,1,2."),
    click.option("--skip-overlap", is_flag=True, default=None, help="Do not look at overlap points."),
    click.option("--use-withheld", is_flag=True, default=None, help="Look at withheld points too."),
    click.option(
        "--config",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        help="TOML file with tables [filter], [classes], [chunks], [dtm]; options win.",
    ),
)

run_options = stack(
    click.option("--chunk-size", type=float, metavar="M", help="Edge of a chunk in metres [default: by density]."),
    click.option("--buffer", type=float, metavar="M", help="First guess of the buffer [default: the filter's]."),
    click.option("--max-buffer", type=float, metavar="M", help="Widest buffer to try [default: 2000]."),
    click.option("--resolution", type=float, metavar="M", help="Pixel of the terrain model [default: 1]."),
    click.option("--max-edge", type=float, metavar="M", help="No height across longer triangle edges [default: 50]."),
)


def run_params(options: dict[str, Any]) -> RunParams:
    """Turn options and the configuration file into `RunParams`; takes its keys out of `options`."""
    config = _config(options.pop("config", None))
    from_classes = options.pop("from_classes", None)
    given: dict[str, dict[str, Any]] = {
        "classes": {
            k: options.pop(k, None) for k in ("returns", "mode", "ground_class", "skip_overlap", "use_withheld")
        },
        "chunks": {k: options.pop(k, None) for k in ("chunk_size", "buffer", "max_buffer")},
        "dtm": {k: options.pop(k, None) for k in ("resolution", "max_edge")},
    }
    if from_classes is not None:
        given["classes"]["from_classes"] = _class_list(from_classes)
    parts: dict[str, Any] = {
        name: kind.from_dict(config.get(name, {}) | {k: v for k, v in given[name].items() if v is not None})
        for name, kind in TABLES.items()
    }
    return RunParams(
        filter=_filter(options.pop("filter_name"), options.pop("profile"), config.get("filter", {})), **parts
    )


def _filter(name: str, profile: str | None, table: dict[str, Any]) -> Parameters:
    from ppdf_dask import filters

    chosen = {"name": table.pop("name", name), "profile": table.pop("profile", None)}
    for key, value in chosen.items():
        if not isinstance(value, str | None):
            raise ParameterError(f"[filter] {key} = {value!r} is not a text")
    base = filters.parameters(chosen["name"], profile or chosen["profile"])
    return base.replace(**table)


def _config(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ParameterError(f"{path} cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ParameterError(f"{path} is not valid TOML: {error}") from error
    except RecursionError:
        raise ParameterError(f"{path} is not valid TOML: it is nested too deeply") from None
    known = {"filter", *TABLES}
    for name, table in found.items():
        if name not in known or not isinstance(table, dict):
            raise ParameterError(f"{path}: {name!r} is unknown; the tables are {', '.join(sorted(known))}")
    return found


def _class_list(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ParameterError(f"--from-classes {text!r} is not a list of class numbers such as 0,1,2") from None
