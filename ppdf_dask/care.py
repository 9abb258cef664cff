"""Look after a run without a scheduler: what is done, and one piece of work again, alone."""

from __future__ import annotations

import tempfile
import zlib
from pathlib import Path
from typing import Any

from ppdf_dask import tasks
from ppdf_dask.errors import DamagedError, ParameterError, StoreError
from ppdf_dask.ledger import STAGES, Ledger
from ppdf_dask.ledger import Stage as StageName
from ppdf_dask.lock import holder
from ppdf_dask.quarantine import read_failures
from ppdf_dask.raster import rasterize
from ppdf_dask.saved import load_plan, other_code, refuse_other_code
from ppdf_dask.solve import solve
from ppdf_dask.stages import Cutting, Inputs
from ppdf_dask.store import RunStore
from ppdf_dask.submit import Submission
from ppdf_dask.tiler import cut


def status(out: str | Path) -> dict[str, Any]:
    """Return what of a run is done, failed and left.

    Parameters
    ----------
    out : str or Path
        The run's folder.

    Returns
    -------
    dict
        ``stages`` (name to ``tasks``, None where not known yet, and ``done``), ``running`` (who works there, or None),
        ``submitted`` (the state of a run that lives in a cluster, see `Submission.state`, or None), ``failures`` and
        ``waiting`` as in ``failures.json``, ``finished``, ``other_code`` (what made the run, unless this code did).

    Raises
    ------
    StoreError
        When there is no run.
    """
    sent = _submitted(out)
    done = dict.fromkeys(STAGES, 0)
    known: dict[StageName, int | None] = dict.fromkeys(STAGES)
    store = RunStore(str(Path(out) / "run.zarr"))
    if sent is not None and not store.exists():
        known["tile"] = sum(t.point_count > 0 for t in sent.plan().survey.tiles)
        return _answer(known, done, sent, None, {"failures": [], "waiting": []}, False, None)
    plan = load_plan(out)
    inputs, ledger = Inputs(plan), Ledger(store)
    tiles = ledger.done("tile", inputs.tile_keys)
    known["tile"], done["tile"] = len(inputs.sources), len(tiles)
    cutting = Cutting(inputs, store, tiles)
    lost = read_failures(plan.out)
    given_up = sum(f["stage"] == "tile" for f in lost["failures"])
    if len(tiles) + given_up >= len(inputs.sources):
        try:
            chunks = ledger.done("classify", dict.fromkeys(cutting.index.points, cutting.classify_key))
        except DamagedError:
            chunks = {}
        else:
            merges, blocks = cutting.merge_works(chunks), cutting.dtm_works(chunks)
            keys = {w.ident: w.fingerprint for w in merges[0]}
            known["classify"], done["classify"] = len(cutting.index.points), len(chunks)
            known["merge"], done["merge"] = len(inputs.sources), len(ledger.done("merge", keys))
            keys = {w.ident: w.fingerprint for w in blocks[0]}
            found = ledger.done("dtm", keys)
            known["dtm"], done["dtm"] = len(blocks[0]) + len(blocks[1]), len(found)
            export = cutting.cog_work(blocks[0], blocks[1])
            known["cog"], done["cog"] = 1, len(ledger.done("cog", {"dtm.tif": export.fingerprint}))
    return _answer(known, done, sent, holder(store), lost, (plan.out / "run.json").is_file(), other_code(out))


def _submitted(out: str | Path) -> Submission | None:
    try:
        return Submission(out)
    except StoreError:
        return None


def _answer(
    known: dict[StageName, int | None],
    done: dict[StageName, int],
    sent: Submission | None,
    running: str | None,
    lost: dict[str, Any],
    finished: bool,
    other: str | None,
) -> dict[str, Any]:
    return {
        "stages": {stage: {"tasks": known[stage], "done": done[stage]} for stage in STAGES},
        "running": running,
        "submitted": None if sent is None else sent.state(),
        "other_code": other,
        **lost,
        "finished": finished,
    }


def replay(out: str | Path, piece: str) -> dict[str, Any]:
    """Do one piece of work again in this process, without writing to the run.

    Parameters
    ----------
    out : str or Path
        The run's folder.
    piece : str
        Chunk (``c_...``), source (``s_...``) or terrain block (``b_...``).

    Returns
    -------
    dict
        What its record would say.

    Raises
    ------
    ParameterError
        When there is no such piece.
    StoreError
        When there is no run, or other code made it.
    """
    plan = load_plan(out)
    refuse_other_code(out)
    store = RunStore(str(plan.out / "run.zarr"))
    inputs = Inputs(plan)
    cutting = Cutting(inputs, store, Ledger(store).done("tile", inputs.tile_keys))
    if piece in inputs.sources:
        with tempfile.TemporaryDirectory(prefix="ppdf-debug-") as folder:
            aside = RunStore(folder)
            aside.create({})
            return {**cut(aside, inputs.tile_job(piece)), "peak_mb": tasks.peak_mb()}
    if piece in cutting.index.points:
        found = solve(store, cutting.classify_job(piece))
        return {
            "points": len(found.ground),
            "ground": int(found.ground.sum()),
            "unproven": int(found.unproven.sum()),
            "buffer_m": found.width / 1000,
            "tries": found.tries,
            "crc32": zlib.crc32(found.ground.tobytes()),
            "peak_mb": tasks.peak_mb(),
        }
    chunks = Ledger(store).done("classify", dict.fromkeys(cutting.index.points, cutting.classify_key))
    works, _ = cutting.dtm_works(chunks)
    for work in works:
        if work.ident == piece:
            with tempfile.TemporaryDirectory(prefix="ppdf-debug-") as folder:
                return {**rasterize(store, work.job, into=RunStore(folder)), "peak_mb": tasks.peak_mb()}
    example = next(iter(cutting.index.points), "c_0012_0034")
    raise ParameterError(f"{piece!r} is no chunk, tile or block of {out}; one of its chunks is {example}")
