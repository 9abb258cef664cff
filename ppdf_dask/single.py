"""One tile in memory: no store, no cluster, the same result as a run on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ppdf_dask import filters
from ppdf_dask.checksums import check_sha256
from ppdf_dask.errors import ParameterError, SurveyError, TileError
from ppdf_dask.filters.cloud import cloud_from_grid, density
from ppdf_dask.grid import ChunkGrid
from ppdf_dask.merge import rewrite
from ppdf_dask.params import RunParams
from ppdf_dask.reader import BATCH, Labels, at_once, header_of
from ppdf_dask.relabel import can_relabel, whole_chunks
from ppdf_dask.survey import Survey
from ppdf_dask.tiler import TileJob
from ppdf_dask.tiles import shown

Bools = npt.NDArray[np.bool_]


def classify_tile(survey: Survey, target: str | Path, params: RunParams | None = None) -> dict[str, Any]:
    """Classify one tile.

    Parameters
    ----------
    survey : Survey
        From `scan` of a single file.
    target : str or Path
        The classified file; written under a temporary name, verified, then renamed.
    params : RunParams, optional
        Default: the robust profile of PPDF.

    Returns
    -------
    dict
        ``points``, ``ground``, ``changed``, ``bytes`` and ``classes`` of the written file.

    Raises
    ------
    SurveyError
        When the survey is not one tile, or the target is the source.
    TileError
        When the tile is damaged.
    """
    if len(survey.tiles) != 1:
        raise SurveyError(f"classify takes one tile, not {len(survey.tiles)}; use `ppdf-dask run` for a survey")
    tile, target = survey.tiles[0], Path(target)
    if target.exists() and target.samefile(tile.path):
        raise SurveyError(f"{target} is the input itself; give another name for the output")
    params = params or RunParams()
    job = TileJob("s_000000", tile, survey.unit_xy, survey.unit_z, params, ChunkGrid.from_metres(1000.0), 0)
    check_sha256(tile)
    header = header_of(tile)
    # A layered file's new classes need no more than its labels: it is decoded once.
    once = target.suffix != ".las" and can_relabel(header, at_once(header))
    ground, labels = _ground(job, whole_chunks(header) if once else BATCH)
    cursor = _Cursor(ground)
    kept = ((part, cursor.take(part)) for part in labels) if once else None
    record = rewrite(job, target, lambda batch: cursor.take(batch.labels), kept)
    return record | {"ground": int(ground.sum())}


def _ground(job: TileJob, size: int) -> tuple[Bools, list[Labels]]:
    """Decode a tile, `size` points at a time; return the mask of its eligible points, and the labels of all."""
    parts, labels = [], []
    for batch in job.batches(size):
        seen = batch.eligible
        parts.append(np.stack([batch.x[seen], batch.y[seen], batch.z[seen], batch.fixed[seen].astype(np.int64)]))
        labels.append(batch.labels)
    points = np.concatenate(parts, axis=1) if parts else np.empty((4, 0), np.int64)
    fixed = points[3].astype(np.bool_) if job.params.classes.mode == "refine" else None
    try:
        cloud = cloud_from_grid(points[0], points[1], points[2], fixed)
    except ParameterError as error:
        raise TileError(f"{shown(job.tile.path)}: {error}") from error
    chosen = filters.of(job.params.filter)
    found = chosen.classify(cloud, chosen.resolve(job.params.filter, density(cloud))).ground
    return (found if cloud.fixed is None else found | cloud.fixed), labels


class _Cursor:
    """Hands out a mask of eligible points batch by batch."""

    def __init__(self, ground: Bools) -> None:
        self._ground, self._used = ground, 0

    def take(self, labels: Labels) -> Bools:
        found = np.zeros(labels.n, np.bool_)
        count = int(labels.eligible.sum())
        found[labels.eligible] = self._ground[self._used : self._used + count]
        self._used += count
        return found
