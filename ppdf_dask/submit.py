"""Submit and walk away: a run driven from inside the cluster, watched and stopped through its folder alone.

The driver is a task that gives its worker's thread back at once (it secedes) and then does what `Plan.run` does, with a
client of its own. Who submitted it may go: the scheduler keeps the task, and starts it again on another worker when its
own is lost; the ledger makes that a resumption, the lock keeps two drivers apart.

All that others need lies in ``RUN/driver``::

    request.json   the plan, the options, the dashboard's link
    state.json     submitted, running, lost, finished, partial, failed or cancelled; who, since when, why
    events.jsonl   every event with its time
    log.txt        the same in words, with tracebacks
    cancel         there while the run is asked to stop

so `attach`, `logs` and `cancel` work with no scheduler alive.
"""

from __future__ import annotations

import json
import os
import platform
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ppdf_dask.errors import ClusterError, LockedError, PartialRunError, PpdfError, StoppedError, StoreError
from ppdf_dask.events import Event, Listener
from ppdf_dask.ledger import digest
from ppdf_dask.lock import PATIENCE, holder
from ppdf_dask.progress import JsonLog
from ppdf_dask.quarantine import write_json
from ppdf_dask.store import RunStore

if TYPE_CHECKING:
    from distributed import Client

    from ppdf_dask.plan import Plan

ENDED = ("finished", "partial", "failed", "cancelled")
"""States after which nothing more comes."""

LOCKED_OUT = 120.0
"""Seconds a restarted driver waits for the lock of one that may be on its last breath."""

_LOOK = 0.5


class Submission:
    """A run that lives in a cluster, seen through its folder.

    Parameters
    ----------
    out : str or Path
        The run's folder.

    Raises
    ------
    StoreError
        When nothing was submitted there.
    """

    def __init__(self, out: str | Path) -> None:
        self.out = Path(out).absolute()
        self._place = self.out / "driver"
        if not (self._place / "request.json").is_file():
            raise StoreError(f"{self.out} holds no submitted run; `ppdf-dask submit TILES --out {self.out}` makes one")

    def state(self) -> dict[str, Any]:
        """Return what is known: ``state`` and, where they apply, ``error``, ``exit_code``, ``host``, ``since``."""
        try:
            found: dict[str, Any] = json.loads((self._place / "state.json").read_text(encoding="utf-8"))
        except FileNotFoundError:
            found = {"state": "submitted"}
        return found

    def status(self) -> dict[str, Any]:
        """Return what of the run is done, failed and left, from its ledger; see `ppdf_dask.care.status`."""
        from ppdf_dask.care import status

        return status(self.out)

    def plan(self) -> Plan:
        """Return the plan that was submitted."""
        from ppdf_dask.saved import plan_from_dict

        return plan_from_dict(self._request()["plan"], self.out)

    @property
    def dashboard(self) -> str:
        """Link of the cluster's dashboard as it was when the run was submitted; see `cluster.dashboard_lines`."""
        return str(self._request()["dashboard"] or "")

    def log(self) -> str:
        """Return the driver's log."""
        with suppress(FileNotFoundError):
            return (self._place / "log.txt").read_text(encoding="utf-8")
        return ""

    def cancel(self) -> None:
        """Ask the run to stop; it does within seconds, and the same submission goes on later."""
        (self._place / "cancel").touch()

    def events(self) -> list[Event]:
        """Return the events of the latest start of the driver."""
        return list(self._read(_Reader(self._place / "events.jsonl")))

    def follow(self, on_event: Listener, *, patience: float | None = None) -> dict[str, Any]:
        """Pass on the events as they come, those of the latest start first, until the run ends.

        Parameters
        ----------
        on_event : callable
            Takes each event: a `LiveMap`, a terminal's bars.
        patience : float, optional
            Seconds without a sign of a running driver after which it counts as lost; default a little more than the
            lock's own.

        Returns
        -------
        dict
            The last state, see `state`.

        Raises
        ------
        ClusterError
            When the driver was lost; submitting again goes on.
        """
        reader, sign = _Reader(self._place / "events.jsonl"), _Sign(self.out, patience or 1.5 * PATIENCE)
        while True:
            state = self.state()
            for event in self._read(reader):
                on_event(event)
            if state["state"] in ENDED:
                return state
            if state["state"] != "submitted" and not sign.alive():
                raise ClusterError(
                    f"the driver of {self.out} was lost: no sign of it for {sign.patience:.0f} s. If its cluster still "
                    "runs, it starts again there; else give the same submit command, it goes on where it stopped"
                )
            time.sleep(_LOOK)

    def _request(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self._place / "request.json").read_text(encoding="utf-8"))
        return found

    def _read(self, reader: _Reader) -> Iterator[Event]:
        found = list(reader.events())
        starts = [k for k, event in enumerate(found) if event.state == "started"]
        yield from found[starts[-1] if starts else 0 :]


def submit(plan: Plan, client: Client, *, overwrite: bool = False, accept_changes: bool = False) -> Submission:
    """Hand a plan to a cluster and return at once.

    Parameters
    ----------
    plan : Plan
        Its folder must be visible to all workers under the same path.
    client : distributed.Client
        Of a cluster that outlives this process.
    overwrite, accept_changes : bool
        As in `Plan.run`.

    Returns
    -------
    Submission
        To watch, follow or cancel it. A run that is on its way already is left alone.

    Raises
    ------
    PlanError
        When the plan cannot work.
    ClusterError
        When the workers cannot do it (see `preflight`).
    LockedError
        When another run works in the folder.
    """
    from distributed import fire_and_forget

    from ppdf_dask import preflight
    from ppdf_dask.saved import plan_as_dict

    plan.check()
    preflight.check(client, plan)
    _refuse_if_used(plan.out)
    place = plan.out / "driver"
    place.mkdir(parents=True, exist_ok=True)
    options = {"overwrite": overwrite, "accept_changes": accept_changes}
    request = {"plan": plan_as_dict(plan), "options": options, "dashboard": client.dashboard_link}
    write_json(place / "request.json", request)
    (place / "cancel").unlink(missing_ok=True)
    write_json(place / "state.json", {"state": "submitted", "since": _now()})
    # One key per folder: a driver that waits for a worker is not doubled by submitting again.
    key = f"drive-{digest(str(plan.out))[:8]}"
    fire_and_forget(client.submit(drive, str(plan.out), key=key, pure=False, priority=100))
    return Submission(plan.out)


def drive(out: str) -> str:
    """Drive a submitted run to its end; runs on a worker, returns the last state.

    An overwriting request overwrites once: a driver that is started again resumes.
    """
    from distributed import Client, get_worker, secede

    secede()
    worker = get_worker()
    with (
        _Journal(Path(out)) as journal,
        Client(worker.scheduler.address, security=worker.security, set_as_default=False) as client,
    ):
        return journal.conclude(lambda: _run(Path(out), client, journal))


def _refuse_if_used(out: Path) -> None:
    """Stop when somebody works in the folder; a lock that stands still is nobody's."""
    store = RunStore(str(out / "run.zarr"))
    owner = holder(store)
    if owner is None:
        return
    first, end = store.lock(), time.monotonic() + PATIENCE
    while time.monotonic() < end:
        time.sleep(_LOOK)
        now = store.lock()
        if now is None:
            return
        if now != first:
            raise LockedError(f"{out} is in use by {owner}; `ppdf-dask attach {out}` shows how far it is")


def _run(out: Path, client: Client, journal: _Journal) -> None:
    from ppdf_dask.runner import run
    from ppdf_dask.saved import plan_from_dict

    request = json.loads((out / "driver" / "request.json").read_text(encoding="utf-8"))
    plan, options = plan_from_dict(request["plan"], out), request["options"]
    end = time.monotonic() + LOCKED_OUT
    while True:
        try:
            run(plan, client, on_event=lambda e: _heard(e, out, request, journal), stop=journal.check, **options)
            return
        except LockedError:
            if time.monotonic() > end:
                raise
            journal.say("another driver holds the lock; waiting for it to stop")
            journal.check()
            time.sleep(5.0)


def _heard(event: Event, out: Path, request: dict[str, Any], journal: _Journal) -> None:
    if event.state == "started" and request["options"]["overwrite"]:
        request["options"]["overwrite"] = False
        write_json(out / "driver" / "request.json", request)
    journal(event)


class _Journal:
    """Writes down what a driver does; the only writer of ``RUN/driver`` while it runs."""

    def __init__(self, out: Path) -> None:
        self._place = out / "driver"

    def __enter__(self) -> _Journal:
        self._events = (self._place / "events.jsonl").open("a", encoding="utf-8")
        self._json = JsonLog(self._events)
        self.say(f"driver starts on {platform.node()}, process {os.getpid()}")
        return self

    def __exit__(self, *_: object) -> None:
        self._events.close()

    def __call__(self, event: Event) -> None:
        self._json(event)
        name = f"{event.stage} {event.ident}".strip()
        if event.state == "stage":
            self.say(f"{name}: {event.record['done']} of {event.record['tasks']} were done before")
        elif event.state in ("failed", "retried"):
            self.say(f"{name} {event.state}: {event.record.get('error', '')}")
        elif event.state in ("started", "finished"):
            self.say(f"{name} {event.state}")
        if event.state == "started":
            self.state("running")

    def say(self, text: str) -> None:
        with (self._place / "log.txt").open("a", encoding="utf-8") as log:
            log.write(f"{_now()} {text}\n")

    def state(self, name: str, **more: Any) -> None:
        facts = {"state": name, "since": _now(), "host": platform.node(), "pid": os.getpid(), **more}
        write_json(self._place / "state.json", facts)

    def check(self) -> None:
        if (self._place / "cancel").exists():
            raise StoppedError("cancelled; give the same submit command to go on")

    def conclude(self, work: Callable[[], None]) -> str:
        """Do the work and write down how it ended."""
        name, error, code, detail = "finished", "", 0, ""
        try:
            self.check()
            work()
        except PpdfError as fault:
            kinds = {StoppedError: "cancelled", PartialRunError: "partial", ClusterError: "lost"}
            name, error, code = kinds.get(type(fault), "failed"), str(fault), fault.exit_code
        except Exception as fault:
            name, error, code = "failed", f"{type(fault).__name__}: {fault}", 1
            detail = "\n" + traceback.format_exc()
        self.say(f"{name}{': ' if error else ''}{error}{detail}")
        (self._place / "cancel").unlink(missing_ok=True)
        self.state(name, error=error, exit_code=code)
        return name


class _Reader:
    """Reads the lines that were added to a file of events since the last look."""

    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0

    def events(self) -> Iterator[Event]:
        with suppress(FileNotFoundError), self._path.open("rb") as file:
            file.seek(self._at)
            for line in file:
                if not line.endswith(b"\n"):
                    return
                self._at += len(line)
                # A line torn by a killed driver has the next driver's first line at its end.
                with suppress(ValueError):
                    values = json.loads(line)
                    yield Event(**values)


class _Sign:
    """Tells whether the lock of a run still beats, by this process's clock only."""

    def __init__(self, out: Path, patience: float) -> None:
        self._store, self.patience = RunStore(str(out / "run.zarr")), patience
        self._last: Any = None
        self._since = time.monotonic()

    def alive(self) -> bool:
        lock = self._store.lock()
        if lock != self._last:
            self._last, self._since = lock, time.monotonic()
        return time.monotonic() - self._since < self.patience


def _now() -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S %z")
