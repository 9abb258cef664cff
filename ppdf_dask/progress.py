"""Run events for people and machines: a terminal bar counted in points, plain lines elsewhere, JSON lines in a file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Self

from ppdf_dask.events import Event, Listener

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

TITLES = {
    "tile": "cut tiles into chunks",
    "classify": "classify chunks",
    "merge": "write classified tiles",
    "dtm": "terrain model blocks",
    "cog": "export dtm.tif",
}
"""What each stage does, in words."""


def rate(points: float, seconds: float) -> str:
    """Return points per second as people read it.

    Examples
    --------
    >>> rate(3_000_000, 2)
    '1.5 Mpts/s'
    >>> rate(500, 1)
    '500 pts/s'
    """
    per_second = points / seconds if seconds > 0 else 0.0
    if per_second >= 1e6:
        return f"{per_second / 1e6:.1f} Mpts/s"
    return f"{per_second / 1e3:.0f} kpts/s" if per_second >= 1e4 else f"{per_second:.0f} pts/s"


class TerminalProgress:
    """One bar per stage on a terminal; on anything else one line when a stage ends.

    Parameters
    ----------
    console : rich.console.Console
        Where to draw; it knows whether it is a terminal and whether colour is wanted.
    """

    def __init__(self, console: Console) -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        self._console = console
        self._bar: Progress = Progress(
            TextColumn("{task.description:<24}"),
            BarColumn(),
            TextColumn("{task.percentage:>4.0f} %"),
            TextColumn("{task.fields[note]}"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._task: TaskID | None = None
        self._stage: Event | None = None
        self._began = self._now = 0.0
        self._points = 0
        self._pieces = 0

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, tb: TracebackType | None) -> None:
        if kind is None:
            self._end_stage()
        self._bar.stop()

    def __call__(self, event: Event) -> None:
        """Take one event."""
        self._now = event.time
        if event.state == "stage":
            self._end_stage()
            self._begin_stage(event)
        elif event.state == "done" and self._task is not None:
            self._points += event.points
            self._pieces += 1
            note = rate(self._points, self._now - self._began)
            self._bar.update(self._task, advance=event.points, note=note)
        elif event.state == "failed":
            self._console.print(f"{event.stage} {event.ident} failed: {event.record.get('error', '')}", markup=False)
        elif event.state == "noted":
            self._console.print(event.record["warning"], markup=False, highlight=False)
        elif event.state == "finished":
            self._end_stage()

    def _begin_stage(self, event: Event) -> None:
        self._stage, self._began = event, event.time
        self._points, self._pieces = 0, event.record.get("done", 0)
        title = TITLES.get(event.stage, event.stage)
        self._task = self._bar.add_task(title, total=max(event.total, 1), completed=event.points, note="")

    def _end_stage(self) -> None:
        if self._stage is None or self._task is None:
            return
        self._bar.update(self._task, completed=max(self._stage.total, 1))
        if not self._console.is_terminal:
            seconds = self._now - self._began
            title = TITLES.get(self._stage.stage, self._stage.stage)
            tasks = self._stage.record.get("tasks", 0)
            self._console.print(
                f"{title}: {self._pieces} of {tasks} in {seconds:.1f} s, {rate(self._points, seconds)}", highlight=False
            )
        self._stage = self._task = None


class JsonLog:
    """Writes each event as one JSON line, flushed at once.

    Parameters
    ----------
    out : file object
        Open for writing text.
    """

    def __init__(self, out: IO[str]) -> None:
        self._out = out

    def __call__(self, event: Event) -> None:
        """Take one event."""
        line = dataclasses.asdict(event)
        self._out.write(json.dumps({"time": round(line.pop("time"), 3), **line}, default=str) + "\n")
        self._out.flush()


@contextmanager
def listen(console: Console, *, quiet: bool = False, json_log: str | Path | None = None) -> Iterator[Listener]:
    """Give the listener the command line asked for.

    Parameters
    ----------
    console : rich.console.Console
        For the bars.
    quiet : bool
        No bars, no lines.
    json_log : str or Path, optional
        File the JSON lines are appended to.
    """
    with ExitStack() as stack:
        listeners: list[Listener] = []
        if not quiet:
            listeners.append(stack.enter_context(TerminalProgress(console)))
        if json_log is not None:
            listeners.append(JsonLog(stack.enter_context(Path(json_log).open("a", encoding="utf-8"))))

        def tell(event: Event) -> None:
            for each in listeners:
                each(event)

        yield tell
