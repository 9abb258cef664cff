"""A plan kept in the run's store, so that `retry`, `verify`, `status` and `debug` need nothing but the run's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ppdf_dask import __version__, codeprint, filters
from ppdf_dask.errors import PpdfError, StoreError
from ppdf_dask.grid import ChunkGrid
from ppdf_dask.params import ChunkParams, ClassRules, DtmParams, RunParams
from ppdf_dask.plan import Plan
from ppdf_dask.store import RunStore
from ppdf_dask.survey import Survey


def save_plan(store: RunStore, plan: Plan) -> None:
    """Put a plan into the ledger."""
    store.put_record("plan", "plan", plan_as_dict(plan))


def load_plan(out: str | Path) -> Plan:
    """Return the plan of a run's folder.

    Raises
    ------
    StoreError
        When there is no run, or its plan is lost; the message says what helps.
    """
    store = RunStore(str(Path(out) / "run.zarr"))
    store.attributes()
    values = store.get_record("plan", "plan")
    try:
        if values is not None:
            return plan_from_dict(values, Path(out))
    except (LookupError, TypeError, ValueError, AttributeError, StopIteration, PpdfError):
        pass  # It was written by nobody that we know.
    raise StoreError(
        f"the plan of {out} is missing or damaged; give the `ppdf-dask run TILES --out {out}` command again, which "
        "restores it"
    )


def other_code(out: str | Path) -> str | None:
    """Say by what a run was made when that is not the code at hand; None when it is.

    Fingerprints hold the code, so that no record of such a run counts for this one.
    """
    facts = RunStore(str(Path(out) / "run.zarr")).attributes().get("facts", {})
    then, now = (facts.get("version"), facts.get("code")), (__version__, codeprint.code())
    if not facts or then == now:
        return None
    return f"ppdf_dask {then[0]} (code {then[1]}), here is {now[0]} (code {now[1]})"


def refuse_other_code(out: str | Path) -> None:
    """Refuse to judge a run that other code made.

    Raises
    ------
    StoreError
        Naming both.
    """
    made = other_code(out)
    if made is not None:
        raise StoreError(
            f"{out} was made by {made}: look at it with the version that made it, or make it anew with "
            "`ppdf-dask run ... --accept-changes`"
        )


def plan_as_dict(plan: Plan) -> dict[str, Any]:
    """Return a plan as plain JSON; the tiles' CRS records, which are long and mostly equal, stand in a list."""
    survey = plan.survey.as_dict()
    known: dict[str | None, int] = {}
    for tile in survey["tiles"]:
        tile["crs"] = known.setdefault(tile["crs"], len(known))
    return {
        "survey": survey,
        "crs": list(known),
        "filter": filters.of(plan.params.filter).name,
        "params": plan.params.as_dict(),
        "chunk_size": plan.grid.size,
        "buffer": plan.buffer,
        "memory": plan.memory,
    }


def plan_from_dict(values: dict[str, Any], out: Path) -> Plan:
    """Return the plan that `plan_as_dict` made JSON of."""
    survey = dict(values["survey"])
    survey["tiles"] = [tile | {"crs": values["crs"][tile["crs"]]} for tile in survey["tiles"]]
    params = values["params"]
    profiles = filters.get(values["filter"]).profiles.values()
    kind = next(type(p) for p in profiles if type(p).__name__ == params["filter"]["kind"])
    return Plan(
        Survey.from_dict(survey),
        RunParams(
            filter=kind.from_dict(params["filter"]),
            classes=ClassRules.from_dict(params["classes"]),
            chunks=ChunkParams.from_dict(params["chunks"]),
            dtm=DtmParams.from_dict(params["dtm"]),
        ),
        out,
        ChunkGrid(values["chunk_size"]),
        values["buffer"],
        values["memory"],
    )
