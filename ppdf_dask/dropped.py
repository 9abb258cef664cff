"""A finished run without its intermediate points: what stays known of them, and when they have to be made again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ppdf_dask.filters.cloud import Density
from ppdf_dask.ledger import Ledger, digest
from ppdf_dask.lock import hold
from ppdf_dask.store import RunStore

POINTS = ("chunks", "labels")
"""Groups of the store that hold what was cut from the tiles."""

if TYPE_CHECKING:
    from ppdf_dask.stages import Cutting


def drop_points(out: Path) -> int:
    """Remove the fragments of a finished run; return the bytes that are free now.

    Masks, ground points, terrain model and ledger stay: the same command finds that nothing is left to do. Where
    something is to be classified again (other parameters, damage), the next run cuts the tiles again first.
    """
    from ppdf_dask.saved import load_plan
    from ppdf_dask.stages import Cutting, Inputs

    store = RunStore(str(out / "run.zarr"))
    inputs = Inputs(load_plan(out))
    with hold(store):
        records = Ledger(store).done("tile", inputs.tile_keys)
        density = Cutting(inputs, store, records).density
        kept = {"tiles": _key(records), "density": [density.points, density.cells]}
        gone = [out / "run.zarr" / group for group in POINTS]
        freed = sum(f.stat().st_size for folder in gone for f in folder.rglob("*") if f.is_file())
        # Known first, gone later: a run that is stopped in between cuts the tiles again when it needs them.
        store.put_record("dropped", "points", kept)
        for group in POINTS:
            store.drop(group)
    return freed


def are_dropped(store: RunStore) -> bool:
    """Tell whether a run's fragments were dropped."""
    return store.get_record("dropped", "points") is not None


def kept_density(store: RunStore, tiles: dict[str, dict[str, Any]]) -> Density | None:
    """Return the density of the fragments that were dropped, None when there are others."""
    kept = store.get_record("dropped", "points")
    return Density(*kept["density"]) if kept is not None and kept["tiles"] == _key(tiles) else None


def cut_again(store: RunStore, cutting: Cutting) -> bool:
    """Forget the tiles if their fragments were dropped but are needed; tell whether that is so."""
    if not are_dropped(store):
        return False
    if kept_density(store, cutting.tiles) is not None:
        works = cutting.classify_works()
        done = Ledger(store).each_done("classify", ((work.ident, work.fingerprint) for work in works))
        if sum(1 for _ in done) == len(works):
            return False
    store.drop("ledger/tile")
    store.drop_record("dropped", "points")
    return True


def _key(tiles: dict[str, dict[str, Any]]) -> str:
    return digest({source: record["fingerprint"] for source, record in tiles.items()})
