"""A live map for notebooks: tiles and chunks coloured by state, drawn from the same events as the terminal's bars."""

from __future__ import annotations

import time
from html import escape
from importlib import import_module
from typing import TYPE_CHECKING, Any

from ppdf_dask.events import Event
from ppdf_dask.grid import Rect
from ppdf_dask.maps import PALETTE, Patch, svg_map
from ppdf_dask.progress import TITLES, rate

if TYPE_CHECKING:
    from ppdf_dask.plan import Plan

STATES = {"waiting": "pale", "in the cluster": "sky", "tried again": "orange", "done": "green", "failed": "red"}
"""State of a piece of work and its colour."""

OPACITY = 0.85
"""Of the pieces: fainter, grey and green look alike to readers who confuse red and green."""

_BY_TILE = ("tile", "merge")


class LiveMap:
    """A map of the survey that follows a run; pass it as `on_event`.

    Parameters
    ----------
    plan : Plan
        The plan that is run.
    every : float
        Seconds between two drawings at least; drawing a large map takes a twentieth of the time at most.

    Examples
    --------
    In a notebook::

        live = LiveMap(plan)
        live.show()
        result = plan.run(client, on_event=live)
    """

    def __init__(self, plan: Plan, *, every: float = 0.5) -> None:
        tiles = plan.survey.tiles
        self._tiles: dict[str, Rect] = {f"s_{k:06d}": t.bounds for k, t in enumerate(tiles) if t.point_count}
        self._names = {f"s_{k:06d}": t.name for k, t in enumerate(tiles)}
        self._chunks = {c.id: c.core for c in plan.chunks}
        self._grid = plan.grid
        self._states: dict[str, str] = {}
        self._stages: dict[str, _Bar] = {}
        self._stage = "tile"
        self._end = ""
        self._every, self._next = every, 0.0
        self._handle: Any = None

    def __call__(self, event: Event) -> None:
        """Take one event."""
        if event.stage == "run":
            self._end = event.state if event.state == "finished" else ""
        elif event.state == "stage":
            self._stage = event.stage
            self._stages[event.stage] = _Bar(event)
            self._states = dict.fromkeys(event.record.get("resumed", ()), "done")
        else:
            self._one(event)
        self._draw(now=event.state in ("stage", "finished"))

    def _one(self, event: Event) -> None:
        states = {"sent": "in the cluster", "done": "done", "failed": "failed", "retried": "tried again"}
        if event.state not in states:
            return
        if event.state != "sent" or self._states.get(event.ident) != "tried again":
            self._states[event.ident] = states[event.state]
        if event.stage == "classify" and event.ident not in self._chunks:
            self._chunks[event.ident] = self._grid.parse(event.ident).core
        if event.state in ("done", "failed") and event.stage in self._stages:
            self._stages[event.stage].advance(event)

    def html(self) -> str:
        """Return the map and the bars as an HTML fragment."""
        by_tile = self._stage in _BY_TILE
        places = self._tiles if by_tile else self._chunks
        patches = []
        for ident, rect in places.items():
            # Blocks of the raster are not chunks: once they are computed, all chunks are done.
            state = "done" if self._stage in ("dtm", "cog") else self._states.get(ident, "waiting")
            name = self._names[ident] if by_tile else ident
            patches.append(Patch(rect, f"{name}: {state}", STATES[state]))
        legend = {colour: f"{'tile' if by_tile else 'chunk'} {state}" for state, colour in STATES.items()}
        rows = "".join(bar.html() for bar in self._stages.values())
        end = f"<p>{escape(self._end)}</p>" if self._end else ""
        return f"<div>{svg_map(patches, width=420, legend=legend, opacity=OPACITY)}<table>{rows}</table>{end}</div>"

    def show(self) -> None:
        """Display the map in the notebook; it is redrawn in place from then on.

        Raises
        ------
        ImportError
            Outside of IPython.
        """
        show: Any = import_module("IPython.display")
        self._handle = show.display(show.HTML(self.html()), display_id=True)

    def _repr_html_(self) -> str:
        return self.html()

    def _draw(self, *, now: bool) -> None:
        began = time.monotonic()
        if self._handle is None or (began < self._next and not now):
            return
        show: Any = import_module("IPython.display")
        self._handle.update(show.HTML(self.html()))
        end = time.monotonic()
        self._next = end + max(self._every, 20 * (end - began))


class _Bar:
    """Progress of one stage, in points."""

    def __init__(self, event: Event) -> None:
        self._title = TITLES.get(event.stage, event.stage)
        self._total, self._done = max(event.total, 1), event.points
        self._pieces, self._of = event.record.get("done", 0), event.record.get("tasks", 0)
        self._new, self._began, self._last = 0, event.time, 0.0

    def advance(self, event: Event) -> None:
        self._done += event.points
        self._new += event.points
        self._pieces += 1
        self._last = event.time - self._began

    def html(self) -> str:
        share = min(self._done / self._total, 1.0) if self._pieces < self._of else 1.0
        width, colour = round(200 * share), PALETTE["blue"]
        bar = f'<div style="width:200px;background:#ddd"><div style="width:{width}px;height:0.8em;background:{colour}">'
        speed = rate(self._new, self._last) if self._new else ""
        return (
            f"<tr><td>{escape(self._title)}</td><td>{bar}</div></div></td>"
            f"<td>{self._pieces} of {self._of}</td><td>{speed}</td></tr>"
        )
