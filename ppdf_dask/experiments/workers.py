"""What a worker does for a study: measure a site, run a filter on it, search a grid; small records back.

Each function has the signature that `ppdf_dask.execute` calls: the study's folder, a job, a fingerprint (not used: a
study keeps no ledger).
"""

from __future__ import annotations

import os
import time
import warnings
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ppdf_dask import sites
from ppdf_dask.experiments.labelled import Labelled, found_ground, read
from ppdf_dask.experiments.rasters import read_raster, write_raster
from ppdf_dask.experiments.tuning import Grid
from ppdf_dask.grid import MM, Rect
from ppdf_dask.metrics import Scores
from ppdf_dask.params import Parameters

WARM_UP = 10 * MM
"""Half the edge of the square of points on which a filter is run once before it is timed, mm."""

SITE_RASTERS = {"reference": MM, "slope": sites.SLOPE_CELL, "chm": MM, "cover": sites.CELL}
"""Rasters of a site and their pixels, mm."""


@dataclass(frozen=True)
class SiteFile:
    """A labelled cloud on disk.

    Attributes
    ----------
    name : str
        Unique within the study, usable as a folder's name.
    path : str
        LAS or LAZ file with class 2 as reference ground.
    points : int
        As its header says.
    score : str or None
        Which points count (see `ppdf_dask.evaluate.parse_score`).
    """

    name: str
    path: str
    points: int
    score: str | None = None


@dataclass(frozen=True)
class Case:
    """A filter with one set of parameters.

    Attributes
    ----------
    filter, profile : str
        Its name, and what its parameters are called.
    params : Parameters
        The parameters.
    """

    filter: str
    profile: str
    params: Parameters

    @property
    def name(self) -> str:
        """Both, as in the tables: ``smrf default``."""
        return f"{self.filter} {self.profile}"


@dataclass(frozen=True)
class Row:
    """One case on one site.

    Attributes
    ----------
    site : str
        The site's name.
    case : Case
        With the parameters it ran with, before anything was derived from the density.
    scores : Scores
        Of the points that count.
    rmse : float
        Root mean square difference of the two 1 m terrain models, m, where both know a height.
    missing : float
        Share of the pixels whose height the reference knows, and the filter's terrain model does not.
    points, offered : int
        All points, and those the filter saw.
    seconds, cpu : float
        Wall and processor time of the filter alone, on one thread.
    notes : tuple of str
        Warnings of the filter.
    """

    site: str
    case: Case
    scores: Scores
    rmse: float
    missing: float
    points: int
    offered: int
    seconds: float
    cpu: float
    notes: tuple[str, ...] = ()


def measure_site(out: str, site: SiteFile, fingerprint: str) -> dict[str, Any]:
    """Measure one site on a worker; write its rasters."""
    cloud = read(site.path, site.score).check()
    found = sites.statistics(cloud.mm[cloud.usable], cloud.reference[cloud.usable])
    layers = {"reference": found.dtm, "slope": found.slope, "chm": found.chm, "cover": found.cover}
    for name, pixel in SITE_RASTERS.items():
        write_raster(raster_path(out, site.name, name), layers[name], found.rect, pixel)
    return {"site": site.name, "rect": found.rect.metres(), "scored": int(cloud.scored.sum()), **found.as_dict()}


def measure(out: str, job: tuple[SiteFile, Case], fingerprint: str) -> dict[str, Any]:
    """Run one case on one site on a worker; write its terrain model."""
    site, case = job
    cloud = read(site.path, site.score)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found_ground(_middle(cloud), case.params)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        wall, cpu = time.perf_counter(), _cpu()
        found = found_ground(cloud, case.params)
        wall, cpu = time.perf_counter() - wall, _cpu() - cpu
    reference = read_raster(raster_path(out, site.name, "reference"))
    rect = sites.bounds(cloud.mm[cloud.usable]).snap(sites.CELL)
    dtm = sites.terrain(cloud.mm[found], rect)
    write_raster(raster_path(out, site.name, case.name), dtm, rect, MM)
    known, both = np.isfinite(reference), np.isfinite(dtm) & np.isfinite(reference)
    error = (dtm - reference)[both].astype(np.float64)
    scores = Scores.from_masks(cloud.reference, found, cloud.scored)
    return {
        "site": site.name,
        "counts": {f.name: getattr(scores, f.name) for f in fields(scores)},
        "rmse": float(np.sqrt(np.mean(error * error))) if error.size else float("nan"),
        "missing": 1.0 - both.sum() / known.sum() if known.any() else float("nan"),
        "points": cloud.n,
        "offered": int(cloud.seen(case.params).sum()),
        "seconds": wall,
        "cpu": cpu,
        "notes": sorted({str(w.message) for w in caught}),
    }


def search(out: str, job: tuple[SiteFile, Grid], fingerprint: str) -> dict[str, Any]:
    """Run all candidates of a grid on one site on a worker; return their total errors."""
    site, grid = job
    cloud = read(site.path, site.score)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = (found_ground(cloud, params) for params in grid.candidates())
        return {"totals": [Scores.from_masks(cloud.reference, mask, cloud.scored).total for mask in found]}


def raster_path(out: str | Path, site: str, layer: str) -> Path:
    """Return where a raster of a site lies: a case's terrain model, or one of `SITE_RASTERS`."""
    return Path(out) / "rasters" / site / f"{layer.replace(' ', '-')}.tif"


def _middle(cloud: Labelled) -> Labelled:
    """Return a few points around the cloud's middle: enough to compile and load all that the filter needs."""
    x, y = (int(v) for v in np.median(cloud.mm[:, :2], axis=0))
    near = Rect(x, y, x, y).grow(WARM_UP)
    keep = (
        (cloud.mm[:, 0] >= near.x0)
        & (cloud.mm[:, 0] < near.x1)
        & (cloud.mm[:, 1] >= near.y0)
        & (cloud.mm[:, 1] < near.y1)
    )
    columns = {name: getattr(cloud, name)[keep] for name in ("mm", "reference", "scored", "usable", "last")}
    return replace(cloud, **columns)


def _cpu() -> float:
    """Return the processor time of this thread and of finished child processes, s."""
    spent = os.times()
    return time.thread_time() + spent.children_user + spent.children_system
