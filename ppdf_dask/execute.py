"""One stage on a cluster: a bounded window of futures, retries, the culprit alone, failures by name.

Neither the client nor the scheduler ever holds more than the window, so their memory does not grow with the survey.
What comes back together is fetched together, and what there is room for goes out together: each message costs the
client, the scheduler and the workers a few milliseconds, however many pieces of work it is about. So does each task;
pieces that take less than that travel several to a task. Each still publishes its own record when it is done.
Keys are ``<stage>-<id>-<token>``, with ``+<n>`` after the id when n more pieces travel with it: the dashboard groups
by stage, two runs do not collide.

A piece of work that raises something unforeseen is tried again; one that says in plain words what is wrong (a
`PpdfError`) would say it again and is not. When a worker dies, Dask blames every task that was on it: such work is
tried again at the end of the stage, one piece at a time, so that only the culprit is given up. A piece that raises in
company sends those behind it back, and all of them are tried again alone.
"""

from __future__ import annotations

import contextlib
import json
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from ppdf_dask.errors import ClusterError, DamagedError, DiskFullError, PpdfError
from ppdf_dask.events import Event, Listener
from ppdf_dask.ledger import lean
from ppdf_dask.quarantine import Failure

if TYPE_CHECKING:
    from distributed import Client, Future

RETRIES = 2
"""How often a task that raised is tried again; a worker that died is counted by the scheduler itself."""

WINDOW_PER_THREAD = 3
"""Tasks in flight per worker thread: one running, the next ones already there."""

AHEAD = 1.0
"""Seconds of work in flight at least: pieces that take less than a message would else keep no worker busy."""

OVERDUE = 1.0
"""Seconds after which a task sends back what it has not begun: the pieces were expected to take a third of that."""

LINGER = 0.05
"""Seconds that what came back waits for more to be fetched with it: the workers have their next pieces already."""

WIDEST_PER_THREAD = 128
"""Pieces of work in flight per worker thread at most, however short they are."""

POLL = 1.0
"""Seconds between two looks at scheduler and lock while no result comes."""

PATIENCE = 15.0
"""Seconds without any worker after which the user hears of it: more than a worker takes to be started again."""


def _as_given(given: Any) -> Any:
    return given


@dataclass(frozen=True, slots=True)
class Work:
    """One piece of work of a stage.

    Attributes
    ----------
    ident : str
        Chunk, source or block id.
    points : int
        What it counts for in the progress.
    given : object
        What the job is made of.
    fingerprint : str
        What its record is published with.
    make : callable
        Makes the job of what is given, when it is sent: a million jobs made in advance are most of a driver's memory.
        Default: what is given is the job.
    """

    ident: str
    points: int
    given: Any
    fingerprint: str
    make: Callable[[Any], Any] = _as_given

    @property
    def job(self) -> Any:
        """First argument of a stage's function after the store's path; small, picklable."""
        return self.make(self.given)


@dataclass(frozen=True)
class Stage:
    """A stage: the function its workers run and what it is called with.

    Attributes
    ----------
    name : str
        As in the ledger and on the dashboard.
    function : callable
        ``function(url, job, fingerprint) -> record``.
    url : str
        Passed through.
    token : str
        Tells the keys of this run from those of another on the same scheduler.
    """

    name: str
    function: Callable[..., dict[str, Any]]
    url: str
    token: str


@dataclass
class _Flight:
    """The work of one stage on its way."""

    client: Client
    stage: Stage
    on_event: Listener
    check: Callable[[], None]
    arrived: SimpleQueue[Future[bytes]] = field(default_factory=SimpleQueue)
    flying: dict[str, tuple[list[Work], Future[bytes]]] = field(default_factory=dict)
    tries: dict[str, int] = field(default_factory=dict)
    suspects: list[Work] = field(default_factory=list)
    room: int = 0
    aloft: int = 0
    together: int = 1
    landed: int = 0
    asked: float = float("-inf")
    alone: float | None = None
    address: str = field(init=False)

    def __post_init__(self) -> None:
        # A client that was closed no longer knows it.
        self.address = str(getattr(self.client.scheduler, "address", "?"))

    def submit(self, works: list[Work], together: int = 1) -> None:
        """Send pieces of work to the cluster in one message, so many of them to a task."""
        from distributed.protocol.pickle import dumps

        stage, batches = self.stage, [works[k : k + together] for k in range(0, len(works), together)]
        keys = [self._key(batch) for batch in batches]
        # Packed here, a job is opened by its worker alone; the scheduler would else open and pack each anew.
        packed = [dumps([(w.job, w.fingerprint) for w in batch]) for batch in batches]
        functions, urls = [stage.function] * len(batches), [stage.url] * len(batches)
        with self._cluster_faults(works[0]):
            futures = self.client.map(_packed, functions, urls, packed, key=keys, pure=False)
        self.flying.update(zip(keys, zip(batches, futures, strict=True), strict=True))
        self.aloft += len(works)
        for work in works:
            self.on_event(Event(stage.name, "sent", work.ident))
        for future in futures:
            future.add_done_callback(self.arrived.put)

    def _key(self, batch: list[Work]) -> str:
        for work in batch:
            self.tries[work.ident] = self.tries.get(work.ident, 0) + 1
        first, more, tries = batch[0].ident, len(batch) - 1, self.tries[batch[0].ident]
        return (
            f"{self.stage.name}-{first}"
            + (f"+{more}" if more else "")
            + f"-{self.stage.token}"
            + (f"-{tries}" if tries > 1 else "")
        )

    def window(self) -> int:
        """Return how many pieces may fly; the cluster is asked once a second at most."""
        now = time.monotonic()
        if now >= self.asked + POLL:
            with self._cluster_faults(None):
                threads = sum(self.client.nthreads().values())
            busy = min(AHEAD * self.landed / (now - self.asked), WIDEST_PER_THREAD * threads)
            tasks = max(4, WINDOW_PER_THREAD * threads)
            self.room, self.asked, self.landed = max(tasks, round(busy)), now, 0
            self.together = self.room // tasks
            self._say_when_alone(threads, now)
        return self.room

    def _say_when_alone(self, threads: int, now: float) -> None:
        if threads:
            self.alone = None
        elif self.alone is None:
            self.alone = now
        elif now >= self.alone + PATIENCE:
            self.alone = float("inf")
            warning = (
                f"the scheduler at {self.address} has had no worker for {PATIENCE:g} s; the run goes on as soon as one "
                "comes. Ctrl-C ends it and nothing is lost"
            )
            self.on_event(Event(self.stage.name, "noted", record={"warning": warning}))

    def land(self) -> Iterator[tuple[Work, dict[str, Any] | Failure]]:
        """Wait for work to come back; yield records and failures of what does not fly again."""
        back = [(future, self.flying.pop(str(future.key))[0]) for future in self._arrivals()]
        self.aloft -= sum(len(works) for _, works in back)
        packed = self._fetch(back)
        for future, works in back:
            error, trace = None, None
            if future.status == "error":
                with self._cluster_faults(works[0]):
                    error, trace = future.exception(), future.traceback()
            future.release()
            landed = (
                self._open(works, packed[future.key])
                if error is None
                else filter(None, [self._judge(work, error, trace) for work in works])
            )
            for work, outcome in landed:
                self.landed += 1
                del self.tries[work.ident]
                yield work, outcome

    def _open(self, works: list[Work], packed: bytes) -> Iterator[tuple[Work, dict[str, Any]]]:
        """Yield the records of a task; what it has not done flies again, each piece alone, and was not tried."""
        records = json.loads(packed)
        left = works[len(records) :]
        for work in left:
            self.tries[work.ident] -= 1
        if left:
            self.submit(left)
        for work, record in zip(works, records, strict=False):
            yield work, lean(record)

    def _fetch(self, back: list[tuple[Future[bytes], list[Work]]]) -> dict[Any, bytes]:
        """Return the packed records of those that are finished, by key, in one message."""
        self._refuse_lost(back)
        finished = {future.key: future for future, _ in back if future.status == "finished"}
        if not finished:
            return {}
        with self._cluster_faults(back[0][1][0]):
            # A record whose worker died meanwhile is made again; that can fail, or be the end of the scheduler.
            records: dict[Any, bytes] = self.client.gather(finished, errors="skip")
        self._refuse_lost(back)
        return records

    def _refuse_lost(self, back: list[tuple[Future[bytes], list[Work]]]) -> None:
        for future, works in back:
            if future.status not in ("finished", "error"):
                raise self._lost(works[0])

    def _arrivals(self) -> list[Future[bytes]]:
        """Wait for a future that is done; return it and those that come soon after."""
        while True:
            try:
                found = [self.arrived.get(timeout=POLL)]
                break
            except Empty:
                self.check()
                if self.client.status != "running":
                    raise self._lost(None) from None
                self.window()
        if self.arrived.qsize() + 1 < len(self.flying):
            time.sleep(LINGER)
        return found + [self.arrived.get_nowait() for _ in range(self.arrived.qsize())]

    def _judge(self, work: Work, error: Any, trace: Any) -> tuple[Work, Failure] | None:
        if isinstance(error, DiskFullError):
            raise error
        killed = type(error).__name__ == "KilledWorker"
        if not isinstance(error, PpdfError) and self.tries[work.ident] <= (1 if killed else RETRIES):
            reason = "its worker died" if killed else f"{type(error).__name__}: {error}"
            self.on_event(Event(self.stage.name, "retried", work.ident, record={"error": reason}))
            if killed:
                self.suspects.append(work)
            else:
                self.submit([work])
            return None
        text = str(error) or type(error).__name__
        if killed:
            text = "ended its worker each time it was tried, also alone: most often for want of memory"
        elif not isinstance(error, PpdfError):
            text = f"{type(error).__name__}: {text}"
        detail = "".join(traceback.format_exception(type(error), error, trace))
        damaged = error.path if isinstance(error, DamagedError) else ""
        return work, Failure(self.stage.name, work.ident, text, detail, damaged)

    @contextlib.contextmanager
    def _cluster_faults(self, work: Work | None) -> Iterator[None]:
        """Name a lost scheduler as what it is."""
        if self.client.status != "running":
            raise self._lost(work)
        try:
            yield
        except (OSError, TimeoutError, RuntimeError) as error:
            raise self._lost(work) from error
        except Exception as error:
            if type(error).__name__ in ("CancelledError", "FutureCancelledError", "FuturesCancelledError"):
                raise self._lost(work) from error
            raise

    def _lost(self, work: Work | None) -> ClusterError:
        return ClusterError(
            f"the scheduler at {self.address} was lost during {self.stage.name}"
            f"{f' {work.ident}' if work else ''}; start it again and give the same command, it goes on where it stopped"
        )

    def abandon(self) -> None:
        """Let go of what still flies."""
        futures = [future for _, future in self.flying.values()]
        self.flying.clear()
        if futures and self.client.status == "running":
            with contextlib.suppress(Exception):
                self.client.cancel(futures, force=True)


def _packed(function: Callable[..., dict[str, Any]], url: str, packed: bytes) -> bytes:
    """Run pieces of work; their records as in the ledger, else Dask measures and packs each value of them anew.

    Ends early when a piece raises in company, or when the pieces are longer than those before them were.
    """
    from distributed.protocol.pickle import loads

    pieces, begin = loads(packed), time.monotonic()
    records: list[dict[str, Any]] = []
    for job, fingerprint in pieces:
        try:
            records.append(function(url, job, fingerprint))
        except Exception:
            if len(pieces) == 1:
                raise
            break
        if time.monotonic() >= begin + OVERDUE:
            break
    return json.dumps(records).encode()


def nothing() -> None:
    """Check nothing."""


def execute(
    client: Client,
    stage: Stage,
    todo: Iterable[Work],
    on_event: Listener,
    check: Callable[[], None] = nothing,
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
    check : callable
        Called about once a second; what it raises ends the stage.

    Raises
    ------
    ClusterError
        The scheduler was lost; what is done is in the ledger.
    DiskFullError
        There is no room: everything else would fail as well.
    """
    flight = _Flight(client, stage, on_event, check)
    waiting = iter(todo)
    try:
        while True:
            works = list(islice(waiting, max(0, flight.window() - flight.aloft)))
            if not works and not flight.flying:
                if not flight.suspects:
                    return
                works = [flight.suspects.pop(0)]
            if works:
                flight.submit(works, flight.together)
            for work, outcome in flight.land():
                check()
                if isinstance(outcome, Failure):
                    on_event(Event(stage.name, "failed", work.ident, work.points, record={"error": outcome.error}))
                else:
                    on_event(Event(stage.name, "done", work.ident, work.points, record=outcome))
                yield work, outcome
    finally:
        flight.abandon()
