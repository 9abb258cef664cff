"""One stage on a cluster: a bounded window of futures, retries, failures collected by name.

Neither the client nor the scheduler ever holds more than the window, so their memory does not grow with the survey.
Keys are ``<stage>-<id>-<token>``: the dashboard groups by stage, ids can be searched, two runs do not collide.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ppdf_dask.errors import ClusterError
from ppdf_dask.events import Event, Listener, State

if TYPE_CHECKING:
    from distributed import Client, Future

RETRIES = 2
"""How often a task that raised is tried again; a worker that died is counted by the scheduler itself."""

WINDOW_PER_THREAD = 3
"""Futures in flight per worker thread: one running, the next ones already there."""


@dataclass(frozen=True)
class Work:
    """One piece of work of a stage.

    Attributes
    ----------
    ident : str
        Chunk, source or block id.
    points : int
        What it counts for in the progress.
    job : object
        First argument after the store's path; small, picklable.
    """

    ident: str
    points: int
    job: Any


@dataclass(frozen=True)
class Failure:
    """A piece of work that could not be done.

    Attributes
    ----------
    stage, ident : str
        What it was.
    error : str
        The message in plain words.
    detail : str
        The traceback, for a bug report.
    """

    stage: str
    ident: str
    error: str
    detail: str


@dataclass(frozen=True)
class Stage:
    """A stage: the function its workers run and what it is called with.

    Attributes
    ----------
    name : str
        As in the ledger and on the dashboard.
    function : callable
        ``function(url, job, fingerprint) -> record``.
    url, fingerprint : str
        Passed through.
    token : str
        Tells the keys of this run from those of another on the same scheduler.
    """

    name: str
    function: Callable[..., dict[str, Any]]
    url: str
    fingerprint: str
    token: str

    def submit(self, client: Client, work: Work) -> Future[dict[str, Any]]:
        """Send one piece of work to the cluster."""
        return client.submit(
            self.function,
            self.url,
            work.job,
            self.fingerprint,
            key=f"{self.name}-{work.ident}-{self.token}",
            retries=RETRIES,
            pure=False,
        )


def execute(
    client: Client, stage: Stage, todo: Iterable[Work], on_event: Listener
) -> Iterator[tuple[Work, dict[str, Any] | Failure]]:
    """Run a stage's work and yield each record, or failure, as it comes.

    Parameters
    ----------
    client : distributed.Client
        Any client.
    stage : Stage
        What to run.
    todo : iterable of Work
        Taken as workers get free, in this order.
    on_event : callable
        Hears of each piece of work.

    Raises
    ------
    ClusterError
        The scheduler was lost; what is done is in the ledger.
    """
    from distributed import as_completed

    waiting = iter(todo)
    flying: dict[Any, Work] = {}
    finished = as_completed(with_results=True, raise_errors=False)

    def fill() -> None:
        window = max(4, WINDOW_PER_THREAD * sum(client.nthreads().values()))
        while len(flying) < window and (work := next(waiting, None)) is not None:
            future = stage.submit(client, work)
            flying[future.key] = work
            finished.add(future)

    fill()
    for future, result in finished:
        work = flying.pop(future.key)
        status = future.status
        if status in ("cancelled", "lost"):
            raise ClusterError(
                f"the scheduler at {client.scheduler.address if client.scheduler else '?'} was lost during "
                f"{stage.name} {work.ident}; start it again and give the same command, it goes on where it stopped"
            )
        outcome = _failure(stage.name, work.ident, result) if status == "error" else result
        future.release()
        state: State = "failed" if isinstance(outcome, Failure) else "done"
        record = {"error": outcome.error} if isinstance(outcome, Failure) else outcome
        on_event(Event(stage.name, state, work.ident, work.points, record=record))
        fill()
        yield work, outcome


def _failure(stage: str, ident: str, result: Any) -> Failure:
    error = result[1] if isinstance(result, tuple) else result
    detail = "".join(traceback.format_exception(*result)) if isinstance(result, tuple) else repr(error)
    text = str(error) or type(error).__name__
    if type(error).__name__ == "KilledWorker":
        text = (
            f"{stage} {ident} ended its worker {getattr(error, 'allowed_failures', 3) + 1} times, most often for want "
            "of memory; give a smaller --chunk-size or workers with more memory"
        )
    return Failure(stage, ident, text, detail)
