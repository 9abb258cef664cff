"""What a run tells while it goes: plain records, for bars, widgets and log files alike."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

State = Literal["started", "stage", "sent", "done", "failed", "retried", "noted", "finished"]


@dataclass(frozen=True)
class Event:
    """One thing that happened.

    Attributes
    ----------
    stage : str
        ``tile``, ``classify``, ``merge``, ``dtm`` or ``run``.
    state : str
        ``stage`` when a stage begins (`total` and `record` hold what is to do, ``record["resumed"]`` the ids done by
        an earlier run), ``sent`` when one piece of work goes to the cluster, ``done``, ``failed`` or ``retried`` when
        it comes back, ``noted`` for what is odd (``record["warning"]``), ``finished`` at the end.
    ident : str
        Chunk id, source id or block id; empty for whole stages.
    points : int
        Points this event stands for: progress is counted in points, not in tasks.
    total : int
        Points of the whole stage, for ``stage`` events.
    record : dict
        The work's record, or what is worth telling.
    time : float
        Seconds since 1970 when it happened, for rates: who attaches late hears old events at once.
    """

    stage: str
    state: State
    ident: str = ""
    points: int = 0
    total: int = 0
    record: dict[str, Any] = field(default_factory=dict)
    time: float = field(default_factory=time.time, compare=False)


Listener = Callable[[Event], None]


def ignore(event: Event) -> None:
    """Listen to nothing."""
