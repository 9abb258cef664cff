"""What is done, with which fingerprint: the truth that survives every process.

The ledger lives in the store (`RunStore.put_record`). Each record carries the fingerprint of all that shaped it, so a
record counts only while inputs, parameters and code are the same: that is how a run resumes, and why nothing is mixed.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from ppdf_dask.errors import ResumeError
from ppdf_dask.store import RunStore

Stage = Literal["tile", "classify", "merge", "dtm", "cog"]
STAGES: tuple[Stage, ...] = ("tile", "classify", "merge", "dtm", "cog")


def digest(value: Any) -> str:
    """Return 16 hexadecimal digits of a JSON value, the same on any machine.

    Examples
    --------
    >>> digest({"b": 1, "a": [2]}) == digest({"a": [2], "b": 1})
    True
    >>> hashlib.sha256(b'{"a":[2],"b":1}').hexdigest().startswith(digest({"b": 1, "a": [2]}))
    True
    """
    found = hashlib.sha256()
    for text in _json(value):
        found.update(text.encode())
    return found.hexdigest()[:16]


def _json(value: Any) -> Iterator[str]:
    """Yield JSON in pieces: in one it would be the largest thing in the memory of a driver."""
    pack = json.JSONEncoder(sort_keys=True, separators=(",", ":")).encode
    if not isinstance(value, dict) or not all(isinstance(name, str) for name in value):
        yield pack(value)
        return
    yield "{"
    for k, name in enumerate(sorted(value)):
        yield ("," if k else "") + pack(name) + ":" + pack(value[name])
    yield "}"


@dataclass(frozen=True)
class Ledger:
    """The ledger of one run.

    Parameters
    ----------
    store : RunStore
        Where it is kept.
    """

    store: RunStore

    def begin(self, facts: dict[str, Any], *, overwrite: bool = False, accept_changes: bool = False) -> bool:
        """Open the ledger for a run described by `facts`.

        Parameters
        ----------
        facts : dict
            Inputs, parameters and versions as plain JSON, one level of named values.
        overwrite : bool
            Erase an existing run first.
        accept_changes : bool
            Go on with changed facts; records with another fingerprint are redone.

        Returns
        -------
        bool
            True when an earlier run goes on.

        Raises
        ------
        ResumeError
            When the facts differ from those of the existing run; old and new value stand side by side.
        """
        if overwrite and self.store.exists():
            self.store.erase()
        resumes = self.store.exists()
        if resumes:
            old = self.store.attributes().get("facts", {})
            changed = differences(old, facts)
            if changed and not accept_changes:
                table = "\n".join(f"  {name}: was {was}, now {now}" for name, was, now in changed[:12])
                more = f"\n  and {len(changed) - 12} more" if len(changed) > 12 else ""
                raise ResumeError(
                    f"{self.store.url} belongs to a run with other inputs or settings:\n{table}{more}\n"
                    "Give --accept-changes to recompute what they touch, --overwrite to start anew, or another --out."
                )
        self.store.create({"facts": facts})
        return resumes

    def publish(self, stage: Stage, ident: str, fingerprint: str, record: dict[str, Any]) -> None:
        """Write the record that says this piece of work is done; always the last write of a task."""
        self.store.put_record(stage, ident, {"fingerprint": fingerprint, **record})

    def done(self, stage: Stage, wanted: dict[str, str]) -> dict[str, dict[str, Any]]:
        """Return the records of a stage that count.

        Parameters
        ----------
        stage : str
            The stage.
        wanted : dict
            Id to the fingerprint its record must carry.
        """
        return dict(self.each_done(stage, wanted.items()))

    def each_done(self, stage: Stage, wanted: Iterable[tuple[str, str]]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield id and record of what `done` returns, one by one, for pairs of id and fingerprint."""
        for ident, fingerprint in wanted:
            record = self.store.get_record(stage, ident)
            if record is not None and record.get("fingerprint") == fingerprint:
                yield ident, lean(record)


def lean(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record that shares its names and words with all others: a driver keeps one of each chunk.

    Examples
    --------
    >>> a, b = (lean(json.loads('{"status": "done"}')) for _ in range(2))
    >>> next(iter(a)) is next(iter(b)), a["status"] is b["status"]
    (True, True)
    """
    return {sys.intern(name): sys.intern(v) if isinstance(v, str) else v for name, v in record.items()}


def differences(old: dict[str, Any], new: dict[str, Any], prefix: str = "") -> list[tuple[str, Any, Any]]:
    """List what differs between two nested dicts as ``(dotted name, old, new)``.

    Examples
    --------
    >>> differences({"dtm": {"resolution": 1.0}, "v": 1}, {"dtm": {"resolution": 2.0}, "v": 1})
    [('dtm.resolution', 1.0, 2.0)]
    """
    found: list[tuple[str, Any, Any]] = []
    for name in sorted(old.keys() | new.keys()):
        a, b = old.get(name), new.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            found += differences(a, b, f"{prefix}{name}.")
        elif a != b:
            found.append((prefix + name, a, b))
    return found
