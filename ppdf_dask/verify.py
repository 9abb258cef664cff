"""Read all that a run left behind and compare it with the ledger; change nothing.

Every object is decoded (checksums, shapes, identity), every point and class counted again, and everything that nobody
claims is listed. A missing object is found because the ledger promises it: a fill value is never taken for data.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ppdf_dask.dropped import are_dropped
from ppdf_dask.dtm import BLOCK
from ppdf_dask.errors import DamagedError, TileError
from ppdf_dask.ledger import Ledger, digest
from ppdf_dask.lock import holder
from ppdf_dask.merge import class_counts, crc32_of
from ppdf_dask.objects import LEFTOVER
from ppdf_dask.raster import checksum
from ppdf_dask.repair import leftovers, maker, note
from ppdf_dask.saved import load_plan, refuse_other_code
from ppdf_dask.stages import Cutting, Inputs, Records
from ppdf_dask.store import RunStore, record_path

Kind = Literal["missing", "torn", "flipped", "foreign", "orphaned"]


@dataclass(frozen=True)
class Finding:
    """Something that is not as the ledger says.

    Attributes
    ----------
    kind : str
        ``"missing"``; ``"torn"`` (incomplete or unreadable); ``"flipped"`` (bits differ from what was written);
        ``"foreign"`` (whole, but not what belongs there); ``"orphaned"`` (belongs to nothing).
    path : str
        In the store, or of a file in the run's folder.
    what : str
        In words.
    redo : str
        The piece of work that `run` will do again for it, as ``stage id``; empty when it only goes away.
    """

    kind: Kind
    path: str
    what: str
    redo: str


@dataclass
class Report:
    """What `verify` found.

    Attributes
    ----------
    findings : list of Finding
        All damage.
    pending : list of str
        Pieces of work that are not done yet, as ``stage id``.
    counts : dict
        Counted again: ``eligible`` points of the fragments, ``ground`` points of the masks, ``points`` and ``classes``
        of the classified tiles, ``pixels`` of the terrain model.
    running : str or None
        Who works there right now: what is not finished then is no damage.
    """

    findings: list[Finding] = field(default_factory=list)
    pending: list[str] = field(default_factory=list)
    counts: dict[str, Any] = field(
        default_factory=lambda: {"eligible": 0, "ground": 0, "points": 0, "classes": {}, "pixels": 0}
    )
    running: str | None = None

    @property
    def redo(self) -> list[str]:
        """What the next `run` will do, as ``stage id``, sorted."""
        return sorted({f.redo for f in self.findings if f.redo} | set(self.pending))

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {
            "findings": [asdict(f) for f in self.findings],
            "pending": self.pending,
            "redo": self.redo,
            "counts": self.counts,
            "running": self.running,
        }


def verify(out: str | Path, *, leave_note: bool = True) -> Report:
    """Check a run.

    Parameters
    ----------
    out : str or Path
        The run's folder.
    leave_note : bool
        Leave ``damage.json`` in the folder, by which the next `run` knows what to redo (unless a run is going on).

    Returns
    -------
    Report

    Raises
    ------
    StoreError
        When there is no run, not even its plan can be read, or other code made it.
    """
    plan = load_plan(out)
    refuse_other_code(out)
    store = RunStore(str(plan.out / "run.zarr"))
    check = _Check(Inputs(plan), store)
    check.report.running = holder(store)
    check.all()
    if leave_note and check.report.running is None:
        note(plan.out, sorted(set(check.redo)), check.remove)
    return check.report


class _Check:
    """One pass over a run, stage by stage."""

    def __init__(self, inputs: Inputs, store: RunStore) -> None:
        self.inputs, self.store, self.ledger, self.report = inputs, store, Ledger(store), Report()
        self.dropped = are_dropped(store)
        self.redo: list[str] = []
        self.remove: list[str] = []

    def all(self) -> None:
        """Check everything."""
        tiles = self._done("tile", self.inputs.tile_keys)
        self.cutting = Cutting(self.inputs, self.store, tiles)
        self._fragments()
        self._labels()
        try:
            key = self.cutting.classify_key
        except DamagedError:
            return  # The fragments are named already; what follows from them can be checked when they are whole.
        chunks = self._done("classify", dict.fromkeys(self.cutting.index.points, key))
        self._classification(chunks)
        self._tiles(chunks)
        self._terrain(chunks)
        self._strays()

    # -- the pieces -----------------------------------------------------------------------------------------------

    def _fragments(self) -> None:
        published = self.cutting.index.is_published(self.store)
        if not published:
            self.report.pending.append("index key")
        for path, chunks in self.cutting.index.shards() if published else ():
            try:
                shard = self.store.get_node(path)
            except DamagedError:
                shard = None
            if shard is None or digest(shard.get("chunks")) != digest(chunks):
                self._add("torn" if shard is None else "foreign", path, "is not what the tiles say")
        for chunk, parts in self.cutting.index.each():
            if self.dropped:
                self.report.counts["eligible"] += sum(n for n, _ in parts["core"].values())
                continue
            for part, sources in parts.items():
                for source, expected in sources.items():
                    try:
                        n = self.store.read_points(chunk, part, source, expected).shape[1]
                        self.report.counts["eligible"] += n if part == "core" else 0
                    except DamagedError as error:
                        self._damage(error)

    def _labels(self) -> None:
        for source, count in self.cutting.index.labels.items():
            for number in range(0 if self.dropped else count):
                try:
                    self.store.read_labels(source, number, self.inputs.tile_keys[source])
                except DamagedError as error:
                    self._damage(error)

    def _classification(self, chunks: Records) -> None:
        for chunk, record in chunks.items():
            try:
                masks = self.store.read_classification(chunk, record["fingerprint"])
                ground = np.concatenate(list(masks.values()))
                expected = {s: n for s, (n, _) in self.cutting.index.parts(chunk)["core"].items()}
                if {s: len(m) for s, m in masks.items()} != expected or zlib.crc32(ground.tobytes()) != record["crc32"]:
                    self._add("foreign", f"classification/{chunk}", "is not what its record says")
                self.report.counts["ground"] += int(ground.sum())
                if self.store.read_ground(chunk).shape[1] != record["ground"]:
                    self._add("foreign", f"ground/{chunk}", f"does not hold the {record['ground']} ground points")
            except DamagedError as error:
                self._damage(error)

    def _tiles(self, chunks: Records) -> None:
        works, waiting = self.cutting.merge_works(chunks)
        self.report.pending += [f"merge {w.ident}" for w in waiting]
        for source, record in self._done("merge", {w.ident: w.fingerprint for w in works}).items():
            path = Path(self.cutting.target(source))
            if not path.is_file():
                self._file("missing", path, "is missing", f"merge/{source}")
                continue
            try:
                found = class_counts(path)
            except (TileError, OSError) as error:
                self._file("torn", path, f"cannot be read: {error}", f"merge/{source}")
                continue
            same = all(found[k] == record[k] for k in ("points", "classes"))
            if not same or crc32_of(path) != record["crc32"]:
                self._file("flipped", path, "has other bytes than were written", f"merge/{source}")
                continue
            self.report.counts["points"] += found["points"]
            for name, n in found["classes"].items():
                self.report.counts["classes"][name] = self.report.counts["classes"].get(name, 0) + n

    def _terrain(self, chunks: Records) -> None:
        works, waiting = self.cutting.dtm_works(chunks)
        self.report.pending += [f"dtm {w.ident}" for w in waiting]
        blocks = self._done("dtm", {w.ident: w.fingerprint for w in works})
        names = ["height", "distance"] + (["filled"] if self.inputs.plan.params.dtm.fill_edge else [])
        raster = self.cutting.raster
        for work in works:
            if work.ident not in blocks:
                continue
            row, column = work.job.block.row - raster.row, work.job.block.col - raster.col
            try:
                layers = [self.store.read_block(name, row, column, BLOCK) for name in names]
            except DamagedError as error:
                if error.path.count("/") > 1:
                    self._add("flipped", error.path, str(error), record_path("dtm", work.ident))
                    continue
                self._damage(error)
                return
            if any(v.shape != (BLOCK, BLOCK) for v in layers) or checksum(layers) != blocks[work.ident]["crc32"]:
                kind: Kind = "foreign"
                if not all(self.store.get(f"dtm/{n}/c/{row}/{column}") for n in names):
                    kind = "missing"
                self._add(
                    kind, f"dtm/*/c/{row}/{column}", "is not what its record says", record_path("dtm", work.ident)
                )
                continue
            self.report.counts["pixels"] += int((~np.isnan(layers[0])).sum())
        export = self.cutting.cog_work([w for w in works if w.ident in blocks], waiting)
        for name, record in self._done("cog", {export.ident: export.fingerprint}).items():
            path = self.inputs.plan.out / name
            if not path.is_file():
                self._file("missing", path, "is missing", f"cog/{name}")
            elif crc32_of(path) != record["crc32"]:
                self._file("flipped", path, "has other bytes than were written", f"cog/{name}")

    def _strays(self) -> None:
        for path in self.cutting.index.orphans(self.store):
            self._orphan(path, "belongs to no tile or chunk of this run")
        known = {"ledger", "chunks", "labels", "classification", "ground", "dtm", "lock"}
        for name in self.store.children(""):
            if name not in known:
                self._add("foreign", name, "is none of this run's; remove it by hand", None)
        for key in self._leavings():
            self._orphan(key, "was left by a killed writer")
        if self.report.running is None:
            for part in leftovers(self.inputs.plan.out):
                self._add("orphaned", str(part), "was left by a killed writer", None)
        wanted = {Path(self.cutting.target(s)) for s in self.inputs.sources}
        for file in sorted((self.inputs.plan.out / "laz").rglob("*.la[sz]")):
            if file not in wanted:
                self._add("foreign", str(file), "is none of this run's; remove it by hand", None)

    def _leavings(self) -> Iterator[str]:
        if self.report.running is None:
            yield from (key for key in self.store.keys("") if key.endswith(LEFTOVER))

    # -- the report -----------------------------------------------------------------------------------------------

    def _done(self, stage: Any, wanted: dict[str, str]) -> Records:
        found = self.ledger.done(stage, wanted)
        self.report.pending += [f"{stage} {ident}" for ident in wanted if ident not in found]
        return found

    def _add(self, kind: Kind, path: str, what: str, redo: str | None = "") -> None:
        """Add a finding; `redo` is the path to make anew if it is another one, None for nothing."""
        made_by = maker(redo or path) if redo is not None else None
        self.report.findings.append(Finding(kind, path, what, " ".join(made_by) if made_by else ""))
        if made_by:
            self.redo.append(redo or path)

    def _damage(self, error: DamagedError) -> None:
        self._add(error.kind, error.path, str(error))  # type: ignore[arg-type]

    def _file(self, kind: Kind, path: Path, what: str, record: str) -> None:
        self._add(kind, str(path), what, record_path(*record.split("/")))

    def _orphan(self, path: str, what: str) -> None:
        self._add("orphaned", path, what, None)
        self.remove.append(path)
