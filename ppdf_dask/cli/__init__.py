"""The command line: thin, it parses, calls the library and turns errors into a sentence and an exit code."""

from __future__ import annotations

import os
import signal
import sys
from typing import Any

import click

from ppdf_dask import __version__
from ppdf_dask.errors import PpdfError

COMMANDS = {
    "demo": ("jobs", "a small synthetic survey with known ground: the whole job, the errors"),
    "scan": ("jobs", "what is there: tiles, CRS, units, density, overlaps, problems"),
    "plan": ("jobs", "what a run will take: chunks, points, memory, disk"),
    "run": ("jobs", "classify a survey; on an existing run it resumes"),
    "status": ("care", "what of a run is done, failed and left"),
    "verify": ("care", "read everything a run left and compare it with the ledger"),
    "retry": ("care", "do what failed or is left of a run"),
    "debug": ("care", "replay one chunk of a run in this process"),
    "classify": ("jobs", "one tile in memory, no cluster"),
    "seams": ("scale", "how far neighbouring chunks disagree: 0 for ppdf"),
    "evaluate": ("studies", "compare a classified tile with its reference"),
    "benchmark": ("benchmark", "accuracy on labelled clouds; speed; runtime against density"),
    "ablation": ("studies", "what each part of PPDF contributes"),
    "sensitivity": ("studies", "how much the result depends on single parameters"),
    "stages": ("studies", "the published method step by step, in pictures"),
    "outliers": ("studies", "what injected low outliers do"),
    "raised": ("studies", "how much ground on ridges and hilltops is found"),
    "compare": ("compare", "every filter on sites with known ground: errors, terrain models, times"),
    "sites": ("compare", "slope, canopy cover and canopy height of sites with known ground"),
    "submit": ("remote", "hand a run to a cluster and return at once"),
    "attach": ("remote", "progress of a submitted run; no scheduler needed"),
    "logs": ("remote", "what the driver of a submitted run wrote down"),
    "cancel": ("remote", "stop a submitted run; submitting again goes on"),
    "doctor": ("remote", "what a bug report needs"),
}
"""Command name to the module of this package that holds it, loaded when it is called, and what it does."""


class Lazy(click.Group):
    """A group that imports a command's module only when the command is asked for."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands without importing them: `--help` must answer at once."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return a command."""
        if cmd_name not in COMMANDS:
            return None
        from importlib import import_module

        module = import_module(f"ppdf_dask.cli.{COMMANDS[cmd_name][0]}")
        command: click.Command = getattr(module, cmd_name)
        return command


@click.group(cls=Lazy, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="ppdf-dask")
def group() -> None:
    """Tell ground from vegetation and buildings in airborne LiDAR surveys of any size.

    \b
    ppdf-dask demo                         a small synthetic survey, the whole job, the errors
    ppdf-dask scan tiles/                  what is there
    ppdf-dask plan tiles/                  what a run will take
    ppdf-dask run  tiles/ --out RUN        classified tiles, terrain model; run again to resume
    ppdf-dask classify in.laz out.laz      one tile, no cluster
    """


def _interrupts(error: BaseException | None) -> int:
    """Count the interrupts that led to an error: a second one arrives while the first is being handled."""
    found = 0
    while error is not None:
        found += isinstance(error, KeyboardInterrupt)
        error = error.__cause__ or error.__context__
    return found


def _stop(*_: Any) -> None:
    raise KeyboardInterrupt


def _stop_on_signals() -> None:
    """Let an end that a queue or a closed terminal asks for be the same as Ctrl-C; who ignores it keeps doing so."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _stop)


def main() -> None:
    """Run the command line; the console script."""
    _stop_on_signals()
    try:
        group(standalone_mode=False)
    except (click.exceptions.Abort, KeyboardInterrupt) as stop:
        click.echo("stopped; the same command goes on where it stopped", err=True)
        if _interrupts(stop) > 1:
            os._exit(130)  # Threads of the cluster may still wait for something: a second Ctrl-C must not.
        sys.exit(130)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except BrokenPipeError:
        sys.exit(141)
    except PpdfError as error:
        click.echo(f"ppdf-dask: {error}", err=True)
        sys.exit(error.exit_code)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        click.echo(
            f"ppdf-dask: {place}{error.strerror or error}; mend that and give the same command again, it goes on where "
            "it stopped",
            err=True,
        )
        sys.exit(1)
