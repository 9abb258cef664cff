"""What a run tells while it goes: plain records, for bars, widgets and log files alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

State = Literal["started", "done", "failed", "retried", "stage", "finished", "note"]


@dataclass(frozen=True)
class Event:
    """One thing that happened.

    Attributes
    ----------
    stage : str
        ``tile``, ``classify``, ``merge``, ``dtm`` or ``run``.
    state : str
        ``stage`` when a stage begins (`total` and `record` hold what is to do, ``record["resumed"]`` the ids done by
        an earlier run), ``done`` or ``failed`` for one piece of work, ``finished`` at the end.
    ident : str
        Chunk id, source id or block id; empty for whole stages.
    points : int
        Points this event stands for: progress is counted in points, not in tasks.
    total : int
        Points of the whole stage, for ``stage`` events.
    record : dict
        The work's record, or what is worth telling.
    """

    stage: str
    state: State
    ident: str = ""
    points: int = 0
    total: int = 0
    record: dict[str, Any] = field(default_factory=dict)


Listener = Callable[[Event], None]


def ignore(event: Event) -> None:
    """Listen to nothing."""
