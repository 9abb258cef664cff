"""From a damaged object back to the piece of work that writes it; and leavings of killed writers."""

from __future__ import annotations

import json
import re
from pathlib import Path

from ppdf_dask.errors import StoreError
from ppdf_dask.quarantine import write_json
from ppdf_dask.store import RunStore

NOTES = "damage.json"
"""What `verify` found; the next run redoes it."""

_PART = re.compile(r"\..*\.\d+\.(part|plain\.tif|cog\.tif)\Z")


def maker(path: str) -> tuple[str, str] | None:
    """Return stage and id of the work that writes an object, None for what only a new run can mend.

    Examples
    --------
    >>> maker("chunks/c_0001_0002/core/s_000003"), maker("ground/c_0001_0002"), maker("dtm/height/c/0/1")
    (('tile', 's_000003'), ('classify', 'c_0001_0002'), ('raster', 'layout'))
    >>> maker("ledger/index/c_0001_00"), maker("zarr.json")
    (('index', 'key'), None)
    """
    parts = path.removesuffix("/zarr.json").split("/")
    if parts[0] == "chunks" and len(parts) >= 4:
        return "tile", parts[3]
    if parts[0] == "labels" and len(parts) >= 2:
        return "tile", parts[1]
    if parts[0] in ("classification", "ground") and len(parts) >= 2 and parts[1] != "zarr.json":
        return "classify", parts[1]
    if parts[0] == "dtm":
        return "raster", "layout"
    if parts[:2] == ["ledger", "index"]:
        return "index", "key"
    if parts[0] == "ledger" and len(parts) >= 4:
        return parts[1], parts[3]
    return None


def heal(store: RunStore, path: str) -> None:
    """Let a damaged object be made anew: forget that its work was done, and remove it.

    Raises
    ------
    StoreError
        When no piece of work makes it.
    """
    work = maker(path)
    if work is None:
        raise StoreError(f"{path} in {store.url} is damaged and cannot be made anew alone; run again with --overwrite")
    store.drop_record(*work)
    if work[0] in ("tile", "classify"):
        store.drop(path)


def note(out: Path, redo: list[str], remove: list[str]) -> None:
    """Leave a note for the next run of what is to be made anew, and of what is to be removed.

    Parameters
    ----------
    out : Path
        The run's folder.
    redo, remove : list of str
        Paths in the store; without any, an older note goes.
    """
    if redo or remove:
        write_json(out / NOTES, {"redo": sorted(redo), "remove": sorted(remove)})
    else:
        (out / NOTES).unlink(missing_ok=True)


def take_notes(out: Path, store: RunStore) -> None:
    """Do what a note asks for, then remove it; to be called under the lock."""
    path = out / NOTES
    if not path.is_file():
        return
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        redo, remove = [str(p) for p in found["redo"]], [str(p) for p in found["remove"]]
    except (ValueError, KeyError, TypeError, RecursionError):
        redo, remove = [], []
    for damaged in redo:
        heal(store, damaged)
    for orphan in remove:
        if ".." not in orphan.split("/") and not orphan.startswith("/"):
            store.delete(orphan)
            store.drop(orphan)
    path.unlink()


def sweep(out: Path) -> None:
    """Remove what killed writers left under temporary names in the run's folder; to be called under the lock.

    Leavings in the store itself are harmless and many objects have to be listed to find them: `verify` does.
    """
    for path in leftovers(out):
        path.unlink(missing_ok=True)


def leftovers(out: Path) -> list[Path]:
    """Return the temporary files of writers in the run's folder."""
    return [p for p in [*out.glob(".*"), *(out / "laz").rglob(".*")] if p.is_file() and _PART.match(p.name)]
