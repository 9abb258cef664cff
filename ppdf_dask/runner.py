"""`Plan.run`: the stages in order, each from what the ledger says is left to do.

A piece of work that fails does not stop the others: a tile that cannot be read makes its place unknown space, a chunk
that fails leaves out the tiles and terrain blocks that need it. What could be done is done, what could not is listed in
``failures.json``. Damage found on the way sends the run back to the piece that wrote the damaged object.
"""

from __future__ import annotations

import dataclasses
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ppdf_dask import __version__, tasks
from ppdf_dask.dropped import cut_again
from ppdf_dask.errors import DamagedError, PartialRunError, PlanError, SurveyError
from ppdf_dask.events import Event, Listener, ignore
from ppdf_dask.execute import Stage, Work, execute, nothing
from ppdf_dask.filters.cloud import Density
from ppdf_dask.grid import MM, ChunkGrid
from ppdf_dask.ledger import Ledger, digest
from ppdf_dask.ledger import Stage as StageName
from ppdf_dask.lock import hold
from ppdf_dask.oddities import in_short, oddities
from ppdf_dask.plan import Plan
from ppdf_dask.quarantine import Failure, write_failures, write_json
from ppdf_dask.raster import create
from ppdf_dask.repair import heal, sweep, take_notes
from ppdf_dask.repeats import shared_problems
from ppdf_dask.saved import save_plan
from ppdf_dask.stages import ChunkFacts, Cutting, Inputs, Kept, Records, Total, Waiting, Works, brief
from ppdf_dask.store import RunStore
from ppdf_dask.tiles import Problem, problem_dict, shown

if TYPE_CHECKING:
    from distributed import Client

    from ppdf_dask.result import Result

PACKAGES = ("dask", "distributed", "numpy", "numba", "scipy", "laspy", "lazrs", "zarr", "xarray", "pyproj")
"""Whose versions are written down with a run."""

ROUNDS = 3
"""How often a run goes back to redo damaged objects before it gives up."""


def run(
    plan: Plan,
    client: Client,
    *,
    on_event: Listener | None = None,
    overwrite: bool = False,
    accept_changes: bool = False,
    force_unlock: bool = False,
    stop: Callable[[], None] = nothing,
) -> Result:
    """Run a plan; see `Plan.run`. `stop` is called about once a second; what it raises ends the run."""
    from ppdf_dask.result import Result

    store = RunStore(str(plan.out / "run.zarr"))
    if not overwrite:
        plan = _as_before(plan, store)
    plan.check()
    with hold(store, force=force_unlock) as mine:

        def check() -> None:
            mine()
            stop()

        driver = _Run(plan, client, on_event or ignore, check)
        driver.begin(overwrite, accept_changes)
        for _ in range(ROUNDS):
            if driver.go():
                break
        driver.finish()
    return Result(plan.out)


def _as_before(plan: Plan, store: RunStore) -> Plan:
    """Take the chunks of the run that is there unless the user chose some: they depend on the machine's memory."""
    if not store.exists():
        return plan
    facts, chosen = store.attributes().get("facts", {}), plan.params.chunks
    if chosen.chunk_size is None and facts.get("params", {}).get("chunks", {}).get("chunk_size", 0) is None:
        plan = dataclasses.replace(plan, grid=ChunkGrid.from_metres(facts["chunk_size_m"]))
    return plan


@dataclass
class _Run:
    """The driver's small memory: records of tiles and counts of chunks, never a point."""

    plan: Plan
    client: Client
    on_event: Listener
    check: Callable[[], None] = nothing
    failures: dict[tuple[str, str], Failure] = field(default_factory=dict)
    waiting: list[Waiting] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)
    totals: dict[str, dict[str, Any]] = field(default_factory=dict)
    chunks: ChunkFacts = field(default_factory=dict)
    merged: Records = field(default_factory=dict)
    blocks: Records = field(default_factory=dict)
    odd: list[Problem] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.store = RunStore(str(self.plan.out / "run.zarr"))
        self.ledger = Ledger(self.store)
        self.inputs = Inputs(self.plan)

    # -- what is run ----------------------------------------------------------------------------------------------

    def begin(self, overwrite: bool, accept_changes: bool) -> None:
        """Open the ledger; refuse what does not belong to the run that is there."""
        _check_targets(self.plan)
        old = {} if overwrite or not self.store.exists() else self.store.attributes().get("facts", {})
        resumed = self.ledger.begin(self.inputs.facts(), overwrite=overwrite, accept_changes=accept_changes)
        save_plan(self.store, self.plan)
        sweep(self.plan.out)
        take_notes(self.plan.out, self.store)
        for name in old.get("inputs", {}).keys() - {t.name for t in self.inputs.sources.values()}:
            (self.plan.out / "laz" / name).unlink(missing_ok=True)
        self.on_event(Event("run", "started", record={"resumed": resumed, "out": str(self.plan.out)}))

    def go(self) -> bool:
        """Go through all stages; tell whether no damage was found."""
        self.waiting, self.damaged = [], []
        try:
            self.tile()
            if cut_again(self.store, self.cutting):
                self.tile()
            if self.tiles or not self.failures:
                self.classify()
                self.merge()
                self.rasterize()
        except DamagedError as error:
            self.damaged.append(error.path)
        for path in self.damaged:
            heal(self.store, path)
        return not self.damaged

    def tile(self) -> None:
        """Cut the source files; afterwards a place without fragments is known to be empty."""
        self.tiles = self._stage("tile", tasks.tile, self.inputs.tile_works(), Records())
        sources, unit = self.inputs.sources, self.plan.survey.unit_xy
        self.odd = []
        self._note("tile", [p for s, record in self.tiles.items() for p in oddities(sources[s], record, unit)])
        self.cutting = Cutting(self.inputs, self.store, self.tiles)
        self.cutting.index.publish(self.store)

    def _note(self, stage: StageName, odd: list[Problem]) -> None:
        self.odd += odd
        for line in in_short(odd):
            self.on_event(Event(stage, "noted", record={"warning": line}))

    def density(self) -> Density:
        """Return points and occupied cells of the survey."""
        return self.cutting.density

    def classify(self) -> None:
        """Classify the chunks, densest first."""
        works = self.cutting.classify_works()
        self.chunks = self._stage(
            "classify",
            tasks.classify,
            works,
            self.cutting.chunk_records(),
            lambda _, record: self.cutting.still_proven(record),
        )
        looked_at = {source: record["eligible"] for source, record in self.tiles.items()}
        found = shared_problems(self.inputs.sources, looked_at, (r["shared"] for r in self.chunks.values()))
        self._note("classify", list(found))

    def merge(self) -> None:
        """Write each source file again, classified."""
        works, waiting = self.cutting.merge_works(self.chunks)
        self.waiting += waiting
        self.merged = self._stage(
            "merge",
            tasks.merge,
            works,
            Records(),
            lambda ident, record: _same_size(Path(self.cutting.target(ident)), record),
        )
        for source in self.inputs.sources.keys() - self.merged.keys():
            self._remove_outdated("merge", source, self.cutting.merge_key(source), Path(self.cutting.target(source)))

    def rasterize(self) -> None:
        """Compute the blocks of the terrain model and export it."""
        p, key = self.plan, self.cutting.raster_key
        layout = self.store.get_record("raster", "layout")
        if layout is None or layout["fingerprint"] != key:
            self.store.drop_record("raster", "layout")
            self.store.drop("ledger/dtm")
            create(self.store, self.cutting.raster, p.params.dtm, p.survey)
            self.store.put_record("raster", "layout", {"fingerprint": key})
        works, waiting = self.cutting.dtm_works(self.chunks)
        self.blocks = self._stage("dtm", tasks.rasterize, works, Records())
        failed = [Waiting("dtm", w.ident, "it failed") for w in works if w.ident not in self.blocks]
        done = [w for w in works if w.ident in self.blocks]
        self.waiting += waiting
        if self.damaged:
            return
        export = self.cutting.cog_work(done, waiting + failed)
        exported = self._stage(
            "cog", tasks.export, [export], Records(), lambda name, record: _same_size(p.out / name, record)
        )
        for name in {"dtm.tif", "dtm.partial.tif"} - exported.keys():
            whole = self.cutting.cog_work(works, []).fingerprint
            self._remove_outdated("cog", name, whole if name == "dtm.tif" else "", p.out / name)

    # -- how it is run --------------------------------------------------------------------------------------------

    def _stage(
        self,
        name: StageName,
        function: Any,
        works: list[Work] | Works,
        records: Kept,
        still_good: Callable[[str, dict[str, Any]], bool] = lambda ident, record: True,
    ) -> Kept:
        """Do what the ledger does not hold yet; put of all records of the stage what is still asked of them."""
        took = Total()
        for ident, record in self.ledger.each_done(name, ((w.ident, w.fingerprint) for w in works)):
            if still_good(ident, record):
                took.add(record)
                records[ident] = brief(name, record)
        total = sum(w.points for w in works)
        resumed = sum(w.points for w in works if w.ident in records)
        self.on_event(
            Event(
                name,
                "stage",
                points=resumed,
                total=total,
                record={"tasks": len(works), "done": len(records), "resumed": sorted(records)},
            )
        )
        # The records grow while it is gone through, but only by pieces that it gave already.
        todo = (w for w in works if w.ident not in records and (name, w.ident) not in self.failures)
        if len(records) < len(works):
            (self.plan.out / "run.json").unlink(missing_ok=True)
        stage = Stage(name, function, self.store.url, digest([self.store.url, os.getpid()])[:8])
        for item, outcome in execute(self.client, stage, todo, self.on_event, self.check):
            if not isinstance(outcome, Failure):
                took.add(outcome)
                records[item.ident] = brief(name, outcome)
            elif outcome.damaged:
                self.damaged.append(outcome.damaged)
            else:
                self.failures[name, item.ident] = outcome
        self.totals[name] = took.as_dict()
        return records

    def _remove_outdated(self, stage: StageName, ident: str, fingerprint: str, path: Path) -> None:
        """Remove a result of other settings or inputs whose successor could not be made: it would look like one."""
        if not self.ledger.done(stage, {ident: fingerprint}):
            path.unlink(missing_ok=True)

    def finish(self) -> None:
        """Write ``run.json``, the last file of a run, or say what is missing."""
        if self.failures or self.waiting or self.damaged:
            self._partial()
        points_in = sum(t.point_count for t in self.inputs.sources.values())
        points_out = sum(r["points"] for r in self.merged.values())
        if points_in != points_out:
            raise PlanError(f"{points_in} points came in but {points_out} went out; report this with run.json")
        report = self._report()
        write_json(self.plan.out / "run.json", report)
        if self._left_out():
            self._partial()
        (self.plan.out / "failures.json").unlink(missing_ok=True)
        self.on_event(Event("run", "finished", record=report["counts"]))
        unproven = report["counts"]["unproven"]
        if unproven:
            raise PartialRunError(
                f"{unproven} points could not be proven within --max-buffer "
                f"{self.plan.params.chunks.max_buffer:g} m; they are classified as far as known, listed per chunk in "
                "the ledger. Give a wider --max-buffer with --accept-changes to settle them."
            )

    def _report(self) -> dict[str, Any]:
        density = self.cutting.density
        return {
            "ppdf_dask": __version__,
            "python": platform.python_version(),
            "platform": platform.platform(),
            "packages": {name: version(name) for name in PACKAGES},
            "inputs": [t.as_dict() for t in self.inputs.sources.values()],
            "warnings": [problem_dict(p) for p in [*self.plan.survey.problems, *self.odd] if not p.fatal],
            "left_out": [problem_dict(p) for p in self.plan.survey.problems if p.fatal],
            "crs": self.plan.survey.crs,
            "plan": self.plan.facts(),
            "filter": self.cutting.filter.as_dict(),
            "density": {"points": density.points, "cells": density.cells},
            "counts": {
                "points": sum(r["points"] for r in self.merged.values()),
                "eligible": sum(r["eligible"] for r in self.tiles.values()),
                "ground": sum(r["ground"] for r in self.chunks.values()),
                "unproven": sum(r["unproven"] for r in self.chunks.values()),
                "repeated": sum(r["repeated"] for r in self.chunks.values()),
                "chunks": len(self.chunks),
                "blocks": len(self.blocks),
            },
            "stages": self.totals,
            "memory": {
                "planned_task_mb": round(self.plan.task_mb),
                "limit_mb": round(self.plan.memory / 1e6),
                "bytes_per_point": self.plan.bytes_per_point,
                "peak_mb": max(s["peak_mb"] for s in self.totals.values()),
            },
        }

    def _partial(self) -> None:
        described = self._left_out() + [self._describe(f) for f in self.failures.values()]
        path = write_failures(self.plan.out, described, self.waiting)
        lines = [f"  {d['stage']} {d['id']} ({d['what']}): {d['error']}" for d in described]
        lines += [f"  {path}: damaged again each time it was made" for path in self.damaged]
        unproven = sum(r["unproven"] for r in self.chunks.values())
        self.on_event(Event("run", "finished", record={"failed": len(described), "waiting": len(self.waiting)}))
        raise PartialRunError(
            f"{len(lines)} pieces of work failed and {len(self.waiting)} wait for them, all others are done:\n"
            + "\n".join(lines[:10])
            + (f"\n  and {len(lines) - 10} more" if len(lines) > 10 else "")
            + (f"\n{unproven} points near what failed are classified but not proven" if unproven else "")
            + f"\nDetails are in {path}. Mend the cause, then `ppdf-dask retry {self.plan.out}` does only what is "
            "missing; `ppdf-dask debug` replays one chunk alone."
            + (
                " Files that were left out come in by `ppdf-dask run` with --accept-changes."
                if self._left_out()
                else ""
            )
        )

    def _left_out(self) -> list[dict[str, Any]]:
        """Return the files that the scan found unusable and was told to leave out, as failures."""
        return [
            {
                "stage": "scan",
                "id": p.code,
                "what": shown(p.path),
                "bounds_m": None if p.place is None else [v / MM for v in p.place],
                "files": [p.path],
                "error": p.message,
                "traceback": "",
                "need_mb": None,
            }
            for p in self.plan.survey.problems
            if p.fatal
        ]

    def _describe(self, failure: Failure) -> dict[str, Any]:
        """Return all that helps to find the cause of a failure."""
        tile, need = self.inputs.sources.get(failure.ident), None
        files: list[str] = [] if tile is None else [tile.path]
        box = None if tile is None else tile.bounds
        what = "" if tile is None else shown(tile.path)
        if failure.stage == "classify":
            box = self.plan.grid.parse(failure.ident).core
            sources = {s for part in self.cutting.index.parts(failure.ident).values() for s in part}
            files = [self.inputs.sources[s].path for s in sorted(sources)]
            need = self.cutting.need_mb(failure.ident)
            what = f"needs about {need:.0f} MB, a worker has {self.plan.memory / 1e6:.0f} MB"
        elif failure.stage == "dtm":
            box = next(b.rect for b in self.cutting.raster.grid.over(self.cutting.extent) if b.id == failure.ident)
        return {
            "stage": failure.stage,
            "id": failure.ident,
            "what": what or failure.stage,
            "bounds_m": None if box is None else [v / MM for v in (box.x0, box.y0, box.x1, box.y1)],
            "files": files,
            "error": failure.error,
            "traceback": failure.detail,
            "need_mb": need,
        }


def _check_targets(plan: Plan) -> None:
    """Refuse to write over an input, or through a link to somewhere else."""
    plan.out.mkdir(parents=True, exist_ok=True)
    root, folders = os.path.realpath(plan.out), {}
    for tile in plan.survey.tiles:
        target = plan.out / "laz" / tile.name
        if target.parent not in folders:
            folders[target.parent] = os.path.realpath(target.parent)
        parent = folders[target.parent]
        if os.path.commonpath([root, parent]) != root:
            raise SurveyError(f"{target.parent} leads out of {plan.out}, to {parent}; choose another --out")
        if os.path.realpath(tile.path) == os.path.join(parent, target.name):
            raise SurveyError(f"{target} is an input; inputs are never written to: choose another --out")


def _same_size(path: Path, record: dict[str, Any]) -> bool:
    return path.is_file() and path.stat().st_size == record["bytes"]
