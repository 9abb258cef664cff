"""`Plan.run`: the stages in order, each from what the ledger says is left to do."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ppdf_dask import __version__, filters, tasks
from ppdf_dask.dtm import DtmGrid, Raster
from ppdf_dask.errors import PartialRunError, PlanError
from ppdf_dask.events import Event, Listener, ignore
from ppdf_dask.execute import Failure, Stage, Work, execute
from ppdf_dask.filters.cloud import Density
from ppdf_dask.grid import MM, Rect
from ppdf_dask.ledger import Ledger, digest
from ppdf_dask.ledger import Stage as StageName
from ppdf_dask.merge import MergeJob
from ppdf_dask.neighbourhood import Cut
from ppdf_dask.params import Parameters
from ppdf_dask.plan import Plan
from ppdf_dask.raster import RasterJob, create, jobs
from ppdf_dask.store import RunStore
from ppdf_dask.tiler import TileJob, unpack_cells

if TYPE_CHECKING:
    from distributed import Client

    from ppdf_dask.result import Result

PACKAGES = ("dask", "distributed", "numpy", "numba", "scipy", "laspy", "lazrs", "zarr", "xarray", "pyproj")
"""Whose versions are written down with a run."""


def run(
    plan: Plan,
    client: Client,
    *,
    on_event: Listener | None = None,
    overwrite: bool = False,
    accept_changes: bool = False,
) -> Result:
    """Run a plan; see `Plan.run`."""
    from ppdf_dask.result import Result

    plan.check()
    driver = _Run(plan, client, on_event or ignore)
    driver.begin(overwrite, accept_changes)
    driver.tile()
    driver.classify()
    driver.merge()
    driver.rasterize()
    driver.finish()
    return Result(plan.out)


@dataclass
class _Run:
    """The driver's small memory: records of tiles and counts of chunks, never a point."""

    plan: Plan
    client: Client
    on_event: Listener
    failures: list[Failure] = field(default_factory=list)
    totals: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.store = RunStore(str(self.plan.out / "run.zarr"))
        self.ledger = Ledger(self.store)
        self.sources = {f"s_{k:06d}": tile for k, tile in enumerate(self.plan.survey.tiles)}

    # -- what is run ----------------------------------------------------------------------------------------------

    def begin(self, overwrite: bool, accept_changes: bool) -> None:
        """Open the ledger; refuse what does not belong to the run that is there."""
        self.plan.out.mkdir(parents=True, exist_ok=True)
        facts = {
            "version": __version__,
            "inputs": {t.name: [t.size, t.mtime_ns] for t in self.sources.values()},
            "params": self.plan.params.as_dict(),
            "chunk_size_m": self.plan.grid.size / MM,
            "buffer_m": self.plan.buffer / MM,
        }
        self.facts = facts
        resumed = self.ledger.begin(facts, overwrite=overwrite, accept_changes=accept_changes)
        units = [self.plan.survey.unit_xy, self.plan.survey.unit_z]
        classes = self.plan.params.classes.as_dict() | {"returns": self.plan.params.returns}
        self.tile_key = digest(
            [__version__, facts["inputs"], classes, self.plan.grid.size, self.plan.stored_buffer, units]
        )
        self.on_event(Event("run", "started", record={"resumed": resumed, "out": str(self.plan.out)}))

    def _tile_job(self, source: str) -> TileJob:
        p = self.plan
        return TileJob(
            source, self.sources[source], p.survey.unit_xy, p.survey.unit_z, p.params, p.grid, p.stored_buffer
        )

    def tile(self) -> None:
        """Cut the source files; afterwards a place without fragments is known to be empty."""
        work = [
            Work(
                source,
                tile.point_count,
                self._tile_job(source),
            )
            for source, tile in self.sources.items()
        ]
        work.sort(key=lambda w: (-w.points, w.ident))
        self.tiles = self._stage("tile", tasks.tile, self.tile_key, work)
        self._stop_on_failures("tile")
        self.chunk_points: dict[str, int] = {}
        for record in self.tiles.values():
            for chunk, (core, _, _) in record["chunks"].items():
                if core:
                    self.chunk_points[chunk] = self.chunk_points.get(chunk, 0) + core
        bounds = [Rect(*r["bounds"]) for r in self.tiles.values() if r["bounds"] and r["eligible"]]
        self.extent = bounds[0] if bounds else Rect(0, 0, 0, 0)
        for b in bounds[1:]:
            self.extent = self.extent.union(b)

    def density(self) -> Density:
        """Count points and occupied cells of the survey; cells that several files share are united."""
        holders: dict[str, list[str]] = {}
        for source, record in self.tiles.items():
            for chunk, (core, _, _) in record["chunks"].items():
                if core:
                    holders.setdefault(chunk, []).append(source)
        cells = 0
        for chunk, sources in holders.items():
            if len(sources) == 1:
                cells += self.tiles[sources[0]]["chunks"][chunk][1]
            else:
                bits = [
                    unpack_cells(self.store.fragment_attributes(chunk, "core", s)["density_cells"]) for s in sources
                ]
                united = bits[0].copy()
                for other in bits[1:]:
                    united |= other
                cells += int.from_bytes(united.tobytes(), "big").bit_count()
        return Density(sum(self.chunk_points.values()), cells)

    def classify(self) -> None:
        """Classify the chunks, densest first."""
        p = self.plan
        chosen = filters.of(p.params.filter)
        self.found_density = self.density()
        self.filter: Parameters = chosen.resolve(p.params.filter, self.found_density)
        self.cut = Cut(p.grid, p.stored_buffer, self.extent)
        limit = max(p.buffer, round(p.params.chunks.max_buffer * MM)) if chosen.exact else p.buffer
        self.classify_key = digest([self.tile_key, self.filter.as_dict()])
        work = [
            Work(chunk, n, tasks.ClassifyJob(p.grid.parse(chunk), self.cut, self.filter, p.buffer, limit))
            for chunk, n in sorted(self.chunk_points.items(), key=lambda item: (-item[1], item[0]))
        ]
        self.chunks = self._stage("classify", tasks.classify, self.classify_key, work)
        self._stop_on_failures("classify")

    def merge(self) -> None:
        """Write each source file again, classified."""
        p = self.plan
        work = [
            Work(
                source,
                tile.point_count,
                MergeJob(
                    self._tile_job(source),
                    str(p.out / "laz" / tile.name),
                ),
            )
            for source, tile in self.sources.items()
        ]
        work.sort(key=lambda w: (-w.points, w.ident))
        key = digest([self.classify_key, p.params.classes.as_dict()])
        self.merged = self._stage("merge", tasks.merge, key, work, self._merged_still_there)
        self._stop_on_failures("merge")

    def _merged_still_there(self, ident: str, record: dict[str, Any]) -> bool:
        path = self.plan.out / "laz" / self.sources[ident].name
        return path.is_file() and path.stat().st_size == record["bytes"]

    def rasterize(self) -> None:
        """Compute the blocks of the terrain model and export it."""
        p = self.plan
        key = digest([self.classify_key, p.params.dtm.as_dict(), p.survey.unit_z, p.survey.crs])
        raster = Raster.over(DtmGrid.from_params(p.params.dtm), self.extent)
        layout = self.store.get_record("raster", "layout")
        if layout is None or layout["fingerprint"] != key:
            create(self.store, raster, p.params.dtm, p.survey)
            self.store.put_record("raster", "layout", {"fingerprint": key})
        ground = {p.grid.parse(c).core: r["ground"] for c, r in self.chunks.items() if r["ground"]}
        work = [
            Work(block.id, points, RasterJob(block, raster, self.cut, p.params.dtm, p.survey.unit_z))
            for block, points in jobs(raster, ground, p.params.dtm)
        ]
        self.blocks = self._stage("dtm", tasks.rasterize, key, work)
        self._stop_on_failures("dtm")
        target = p.out / "dtm.tif"
        export = [Work("dtm", sum(w.points for w in work), str(target))]
        self._stage("cog", tasks.export, key, export, lambda _, record: _same_size(target, record))
        self._stop_on_failures("cog")

    # -- how it is run --------------------------------------------------------------------------------------------

    def _stage(
        self,
        name: StageName,
        function: Any,
        key: str,
        work: Iterable[Work],
        still_good: Any = None,
    ) -> dict[str, dict[str, Any]]:
        """Do what the ledger does not hold yet; return all records of the stage."""
        work = list(work)
        wanted = {w.ident for w in work}
        records = {
            ident: record
            for ident, record in self.ledger.done(name, key).items()
            if ident in wanted and (still_good is None or still_good(ident, record))
        }
        todo = [w for w in work if w.ident not in records]
        total = sum(w.points for w in work)
        resumed = sum(w.points for w in work if w.ident in records)
        self.on_event(
            Event(name, "stage", points=resumed, total=total, record={"tasks": len(work), "done": len(records)})
        )
        stage = Stage(name, function, self.store.url, key, digest([self.store.url, key])[:8])
        for item, outcome in execute(self.client, stage, todo, self.on_event):
            if isinstance(outcome, Failure):
                self.failures.append(outcome)
            else:
                records[item.ident] = outcome
        self.totals[name] = _summary(records)
        return records

    def _stop_on_failures(self, stage: str) -> None:
        if not self.failures:
            return
        write_json(self.plan.out / "failures.json", [asdict(f) for f in self.failures])
        lines = "\n".join(f"  {f.stage} {self._name(f)}: {f.error}" for f in self.failures[:10])
        raise PartialRunError(
            f"{len(self.failures)} pieces of stage {stage} failed, the others are done:\n{lines}\n"
            f"Details are in {self.plan.out / 'failures.json'}; mend the cause and give the same command again."
        )

    def _name(self, failure: Failure) -> str:
        tile = self.sources.get(failure.ident)
        return f"{failure.ident} ({tile.path})" if tile else failure.ident

    def finish(self) -> None:
        """Write ``run.json``; the last file of a run."""
        points_in = sum(t.point_count for t in self.sources.values())
        points_out = sum(r["points"] for r in self.merged.values())
        if points_in != points_out:
            raise PlanError(f"{points_in} points came in but {points_out} went out; report this with run.json")
        unproven = sum(r["unproven"] for r in self.chunks.values())
        report: dict[str, Any] = {
            "ppdf_dask": __version__,
            "python": platform.python_version(),
            "packages": {name: version(name) for name in PACKAGES},
            "inputs": [t.as_dict() for t in self.sources.values()],
            "crs": self.plan.survey.crs,
            "plan": self.plan.facts(),
            "filter": self.filter.as_dict(),
            "density": {"points": self.found_density.points, "cells": self.found_density.cells},
            "counts": {
                "points": points_out,
                "eligible": sum(r["eligible"] for r in self.tiles.values()),
                "ground": sum(r["ground"] for r in self.chunks.values()),
                "unproven": unproven,
                "chunks": len(self.chunks),
                "blocks": len(self.blocks),
            },
            "stages": self.totals,
        }
        write_json(self.plan.out / "run.json", report)
        (self.plan.out / "failures.json").unlink(missing_ok=True)
        self.on_event(Event("run", "finished", record=report["counts"]))
        if unproven:
            raise PartialRunError(
                f"{unproven} points could not be proven within --max-buffer "
                f"{self.plan.params.chunks.max_buffer:g} m; they are classified as far as known, listed per chunk in "
                "the ledger. Give a wider --max-buffer to settle them."
            )


def _summary(records: dict[str, dict[str, Any]]) -> dict[str, Any]:
    values = records.values()
    return {
        "tasks": len(records),
        "seconds": round(sum(r["seconds"] for r in values), 3),
        "cpu_seconds": round(sum(r["cpu_seconds"] for r in values), 3),
        "peak_mb": max((r["peak_mb"] for r in values), default=0.0),
    }


def _same_size(path: Path, record: dict[str, Any]) -> bool:
    return path.is_file() and path.stat().st_size == record["bytes"]


def write_json(path: Path, value: Any) -> None:
    """Write JSON under a temporary name and move it into place."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(value, indent=1, sort_keys=True, default=str) + "\n", encoding="utf-8")
    os.replace(part, path)
