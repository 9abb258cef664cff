"""What could not be done: named, located, explained, for people and for programs."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ppdf_dask.errors import StoreError

FILE = "failures.json"


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
    damaged : str
        Path of the store's object that was found damaged, if that was the reason: it is made anew, not given up.
    """

    stage: str
    ident: str
    error: str
    detail: str
    damaged: str = ""


def write_json(path: Path, value: Any) -> None:
    """Write JSON under a temporary name and move it into place."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_text(json.dumps(value, indent=1, sort_keys=True, default=str) + "\n", encoding="utf-8")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_failures(out: Path, failures: list[dict[str, Any]], waiting: list[Any]) -> Path:
    """Write ``failures.json``: what failed, and what waits for it."""
    write_json(out / FILE, {"failures": failures, "waiting": [asdict(w) for w in waiting]})
    return out / FILE


def read_failures(out: Path) -> dict[str, Any]:
    """Return what ``failures.json`` holds; empty lists when there is none.

    Raises
    ------
    StoreError
        When it is damaged: it may be removed, the next run writes it again.
    """
    path = out / FILE
    if not path.is_file():
        return {"failures": [], "waiting": []}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return {name: [dict(entry) for entry in found[name]] for name in ("failures", "waiting")}
    except (ValueError, KeyError, TypeError, RecursionError):
        raise StoreError(f"{path} is damaged; remove it: the next `ppdf-dask retry {out}` writes it again") from None
