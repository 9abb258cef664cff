"""Before a run: every worker is asked whether it can do its part; a table of what is wrong, then stop.

The questions are those that otherwise end a run hours later, or silently: other versions, a path that is not there or
cannot be written, a folder of the same name on another disk, too little memory for the largest chunk, a full disk,
nowhere to keep compiled kernels.
"""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ppdf_dask import __version__
from ppdf_dask.errors import ClusterError, PpdfError
from ppdf_dask.tiles import Tile

if TYPE_CHECKING:
    from distributed import Client

    from ppdf_dask.plan import Plan

PACKAGES = ("dask", "distributed", "numpy", "numba", "scipy", "laspy", "lazrs", "zarr", "xarray", "pyproj", "rasterio")
"""Packages whose versions must be equal everywhere."""

WAIT = 120.0
"""Seconds to wait for the first worker: a queue may still hold it."""

_TILES = 20
_ROWS = 20


@dataclass(frozen=True)
class Needs:
    """What a worker is asked to have.

    Attributes
    ----------
    out : str
        Absolute path of the run's folder.
    token : str
        Name of the folder in it that the check uses.
    tiles : tuple of Tile
        Some of the source files, as the client sees them.
    task_mb : float
        Planned peak of the largest task, MB.
    """

    out: str
    token: str
    tiles: tuple[Tile, ...]
    task_mb: float


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong on one worker.

    Attributes
    ----------
    worker : str
        Its address.
    check, found, remedy : str
        What was looked at, what was seen, what to do.
    """

    worker: str
    check: str
    found: str
    remedy: str


@cache
def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


def versions() -> dict[str, str]:
    """Return the versions that must be equal on client, scheduler and workers.

    Examples
    --------
    >>> sorted(versions())[:3]
    ['dask', 'distributed', 'laspy']
    """
    found = {"python": ".".join(platform.python_version_tuple()[:2]), "ppdf-dask": __version__}
    return found | {name: _version(name) for name in PACKAGES}


def check(client: Client, plan: Plan, *, wait: float = WAIT) -> None:
    """Ask all workers, and stop when anything is wrong.

    Parameters
    ----------
    client : distributed.Client
        Connected.
    plan : Plan
        What is to be run.
    wait : float
        Seconds to wait for the first worker.

    Raises
    ------
    ClusterError
        With a table: worker, check, what was found, what to do.
    """
    _await_workers(client, wait)
    with _meeting_place(plan) as needs:
        faults = find_faults(client.run(probe, needs, on_error="return"), needs)
    if faults:
        raise ClusterError(f"{len(faults)} checks failed before the run:\n{table(faults)}")


def find_faults(answers: dict[str, Any], needs: Needs) -> list[Fault]:
    """Judge the workers' answers.

    Parameters
    ----------
    answers : dict
        Worker's address to what `probe` returned there, or the exception it raised.
    needs : Needs
        What they were asked.

    Returns
    -------
    list of Fault
        By worker.
    """
    here, faults = versions(), []
    for worker, answer in sorted(answers.items()):
        if isinstance(answer, BaseException):
            faults.append(Fault(worker, "answer", f"{type(answer).__name__}: {answer}", "install this ppdf-dask there"))
            continue
        for name, wanted in here.items():
            found = answer["versions"].get(name, "missing")
            if found != wanted:
                remedy = f"install {name} {wanted} there, or run from the workers' environment"
                faults.append(Fault(worker, "version", f"{name} {found}, here {wanted}", remedy))
        faults += [Fault(worker, *row) for row in answer["faults"]]
        seen = Path(needs.out) / needs.token / answer["note"]
        if answer["wrote"] and not seen.is_file():
            found = f"what it wrote to {needs.out} is not seen here"
            faults.append(Fault(worker, "shared folder", found, "mount the same file system under that path"))
        limit = answer["memory_limit"] / max(answer["threads"], 1)
        if limit and limit < needs.task_mb * 1e6:
            found = f"{limit / 1e6:.0f} MB per thread, the largest task needs about {needs.task_mb:.0f} MB"
            remedy = "more memory or fewer threads per worker, or a smaller --chunk-size"
            faults.append(Fault(worker, "memory", found, remedy))
    return faults


def probe(needs: Needs, dask_worker: Any = None) -> dict[str, Any]:
    """Answer for one worker; runs there."""
    faults: list[tuple[str, str, str]] = []
    note = uuid.uuid4().hex
    wrote = _try_folder(Path(needs.out), needs.token, note, faults)
    for tile in needs.tiles:
        try:
            tile.check_unchanged()
        except PpdfError as error:
            faults.append(("source file", str(error), "make the same files visible under the same paths"))
            break
    limit, threads, place = 0, 1, tempfile.gettempdir()
    if dask_worker is not None:
        limit = dask_worker.memory_manager.memory_limit or 0
        threads, place = dask_worker.state.nthreads, dask_worker.local_directory
    free = shutil.disk_usage(place).free
    if free < needs.task_mb * 1e6:
        found = f"{place} has {free / 1e6:.0f} MB free"
        faults.append(("free disk", found, "free some space or give the worker another --local-directory"))
    _try_kernels(faults)
    return {
        "versions": versions(),
        "faults": faults,
        "note": note,
        "wrote": wrote,
        "memory_limit": limit,
        "threads": threads,
        "host": platform.node(),
    }


def table(faults: list[Fault]) -> str:
    """Return faults as aligned text, workers with the same fault in one row.

    Examples
    --------
    >>> print(table([Fault("tcp://a:1", "memory", "1 MB", "more"), Fault("tcp://b:1", "memory", "1 MB", "more")]))
    worker         check   found  remedy
    2 workers (a)  memory  1 MB   more
    """
    grouped: dict[tuple[str, str, str], list[str]] = {}
    for f in faults:
        grouped.setdefault((f.check, f.found, f.remedy), []).append(f.worker)
    rows = [("worker", "check", "found", "remedy")]
    for (what, found, remedy), workers in list(grouped.items())[:_ROWS]:
        host = workers[0].split("://")[-1].rsplit(":", 1)[0]
        rows.append((workers[0] if len(workers) == 1 else f"{len(workers)} workers ({host})", what, found, remedy))
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    lines = ["  ".join([*(c.ljust(w) for c, w in zip(row[:3], widths, strict=True)), row[3]]) for row in rows]
    return "\n".join(lines + ([f"... and {len(grouped) - _ROWS} more"] if len(grouped) > _ROWS else []))


def worker_memory(client: Client, *, wait: float = WAIT) -> float:
    """Return the bytes a task may use on the smallest worker there is; 4 GB where no worker has a limit.

    Parameters
    ----------
    client : distributed.Client
        Connected.
    wait : float
        Seconds to wait for the first worker.

    Raises
    ------
    ClusterError
        When there is no worker to ask.
    """
    _await_workers(client, wait)
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    limits = [w["memory_limit"] / max(w["nthreads"], 1) for w in workers if w["memory_limit"]]
    return float(min(limits, default=4e9))


def _await_workers(client: Client, wait: float) -> None:
    try:
        client.wait_for_workers(1, timeout=wait)
    except TimeoutError:
        raise ClusterError(
            f"the scheduler has no worker, also after {wait:.0f} s; start some, or look at the queue they wait in"
        ) from None


@contextmanager
def _meeting_place(plan: Plan) -> Iterator[Needs]:
    """Make a folder in the run's own that workers write to and this side looks into; leave nothing behind."""
    out = plan.out.absolute()
    fresh = not out.exists()
    token = f".preflight-{uuid.uuid4().hex[:8]}"
    step = max(1, len(plan.survey.tiles) // _TILES)
    try:
        (out / token).mkdir(parents=True)
    except OSError as error:
        raise ClusterError(f"{out} cannot be written here ({error.strerror}); choose another --out") from error
    try:
        (out / token / "client").write_text(token, encoding="utf-8")
        # A tile that changed here as well is no worker's fault: the run sets it aside by name.
        seen = tuple(tile for tile in plan.survey.tiles[::step] if _is_unchanged(tile))
        yield Needs(str(out), token, seen, plan.task_mb)
    finally:
        shutil.rmtree(out / token, ignore_errors=True)
        if fresh:
            with suppress(OSError):
                out.rmdir()


def _is_unchanged(tile: Tile) -> bool:
    try:
        tile.check_unchanged()
    except PpdfError:
        return False
    return True


def _try_folder(out: Path, token: str, note: str, faults: list[tuple[str, str, str]]) -> bool:
    """Read what the client wrote, write, rename and read back."""
    place = out / token
    try:
        if (place / "client").read_text(encoding="utf-8") != token:
            raise OSError(0, "it holds something else")
    except OSError as error:
        found = f"{out} is not the folder it is here ({error.strerror})"
        faults.append(("shared folder", found, "mount the same file system under that path"))
        return False
    try:
        (place / f"{note}.part").write_text(note, encoding="utf-8")
        os.replace(place / f"{note}.part", place / note)
        if (place / note).read_text(encoding="utf-8") != note:
            raise OSError(0, "what was written reads back differently")
    except OSError as error:
        found = f"{out} cannot be written ({error.strerror})"
        faults.append(("write", found, "let the workers' user write there, or choose another --out"))
        return False
    return True


def _try_kernels(faults: list[tuple[str, str, str]]) -> None:
    """Import a cached kernel: that is where a missing place for compiled code shows."""
    try:
        import ppdf_dask.filters.ppdf.hashing  # noqa: F401
    except Exception as error:
        found = f"{type(error).__name__}: {error}"
        faults.append(("numba cache", found, "set NUMBA_CACHE_DIR to a folder that the worker can write"))
