"""Site statistics: slope, canopy height and canopy cover of a labelled cloud, as the PPDF paper describes its sites.

Pure functions over integer millimetres on the job grid. The paper (section 3.1, Figures 3 and 4) names the quantities;
what it leaves open is fixed here: 10 neighbours, a 1 m canopy height model, 10 m cells, a canopy above 2 m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ppdf_dask.dtm import BLOCK, DtmGrid, Part, Raster, rasterize_block
from ppdf_dask.errors import ParameterError
from ppdf_dask.grid import MM, Rect
from ppdf_dask.params import DtmParams

Longs = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]

NEIGHBOURS = 10
"""Ground points, itself included, whose plane gives a point's slope."""

CELL = 10 * MM
"""Edge of a cell of canopy cover, mm; site rasters end at its absolute multiples."""

CANOPY = 2.0
"""A pixel of the canopy height model higher than this is canopy, m."""

SLOPE_CELL = 2 * MM
"""Edge of a cell of the slope map, mm."""

_BATCH = 200_000


@dataclass(frozen=True)
class SiteStatistics:
    """What a site is like; rasters are north up and end at the edges of `rect`.

    Attributes
    ----------
    rect : Rect
        The area of the rasters: the points' bounds widened to multiples of 10 m, mm.
    points : int
        Number of points.
    density : float
        Points per m2 of the 5 m cells that hold any.
    slopes : ndarray of float64, shape (g,)
        Slope at each ground point, degrees; NaN where its neighbours lie on one line.
    slope : ndarray of float32
        Mean of `slopes` per 2 m cell, NaN without ground points.
    dtm, chm : ndarray of float32
        Terrain and canopy height model of 1 m, m; NaN where there is no terrain, for the latter also where no point
        lies in the pixel.
    cover : ndarray of float32
        Canopy cover per 10 m cell, share of 1; NaN without valid pixels.
    """

    rect: Rect
    points: int
    density: float
    slopes: Floats
    slope: Singles
    dtm: Singles
    chm: Singles
    cover: Singles

    @property
    def slope_mean(self) -> float:
        """Mean slope of the ground points, degrees."""
        return _mean(self.slopes)

    @property
    def cover_mean(self) -> float:
        """Mean canopy cover of the cells, share of 1."""
        return _mean(self.cover)

    @property
    def canopy_height(self) -> float:
        """Mean height of the canopy's pixels, m; NaN without canopy."""
        return _mean(self.chm[self.chm > CANOPY])

    def as_dict(self) -> dict[str, float]:
        """Return the numbers of the table: points, points/m2, ground points, degrees, share and metres."""
        return {
            "points": self.points,
            "density": self.density,
            "ground": len(self.slopes),
            "slope_deg": self.slope_mean,
            "cover": self.cover_mean,
            "canopy_height_m": self.canopy_height,
        }


def statistics(points: Longs, ground: npt.NDArray[np.bool_]) -> SiteStatistics:
    """Measure a site.

    Parameters
    ----------
    points : ndarray of int64, shape (n, 3)
        Absolute x, y, z in mm, without noise.
    ground : ndarray of bool, shape (n,)
        The reference's ground points.

    Returns
    -------
    SiteStatistics

    Raises
    ------
    ParameterError
        Without points, or when the arrays do not fit each other.

    Examples
    --------
    A slope of 1 in 10, and a canopy of 8 m over one quarter of it:

    >>> x, y = (v.ravel() * 500 + 250 for v in np.mgrid[0:40, 0:40])
    >>> terrain = np.column_stack([x, y, x // 10])
    >>> crowns = terrain[(x > 10_000) & (y > 10_000)] + [0, 0, 8000]
    >>> found = statistics(np.vstack([terrain, crowns]), np.arange(2000) < 1600)
    >>> round(found.slope_mean, 2), round(found.cover_mean, 2), round(found.canopy_height, 1)
    (5.71, 0.25, 8.0)
    """
    from ppdf_dask.filters.cloud import cloud_from_grid, density

    if points.ndim != 2 or points.shape[1] != 3 or ground.shape != (len(points),) or len(points) == 0:
        raise ParameterError(
            f"a site needs points of shape (n, 3) and a ground mask of shape (n,), not {points.shape} and "
            f"{ground.shape}"
        )
    rect = bounds(points).snap(CELL)
    known = points[ground]
    dtm = terrain(known, rect)
    chm = canopy_model(points, dtm, rect)
    steep = slopes(known)
    x, y, z = (np.ascontiguousarray(column) for column in points.T)
    return SiteStatistics(
        rect,
        len(points),
        density(cloud_from_grid(x, y, z)).per_m2,
        steep,
        cell_mean(known, steep, rect, SLOPE_CELL),
        dtm,
        chm,
        cover(chm, CELL // MM),
    )


def bounds(points: Longs) -> Rect:
    """Return the smallest half-open rectangle that holds the points, mm."""
    (x0, y0), (x1, y1) = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    return Rect(int(x0), int(y0), int(x1) + 1, int(y1) + 1)


def slopes(ground: Longs, neighbours: int = NEIGHBOURS) -> Floats:
    """Return the slope at each ground point from the least-squares plane of its nearest ground points.

    Parameters
    ----------
    ground : ndarray of int64, shape (n, 3)
        Ground points, mm.
    neighbours : int
        How many of the nearest in the plane, itself included; all of them when there are fewer.

    Returns
    -------
    ndarray of float64, shape (n,)
        Degrees, ``atan(sqrt(a^2 + b^2))`` of the plane ``z = a x + b y + c``; NaN where the neighbours lie on one line.

    Examples
    --------
    >>> x, y = (v.ravel() * 1000 for v in np.mgrid[0:6, 0:6])
    >>> np.unique(slopes(np.column_stack([x, y, x])).round(9))
    array([45.])
    """
    from scipy.spatial import cKDTree

    out = np.full(len(ground), np.nan)
    k = min(neighbours, len(ground))
    if k < 3:
        return out
    points = (ground - ground.min(axis=0)) / MM
    tree = cKDTree(points[:, :2])
    for start in range(0, len(points), _BATCH):
        near = points[tree.query(points[start : start + _BATCH, :2], k)[1]]
        x, y, z = np.moveaxis(near - near.mean(axis=1, keepdims=True), 2, 0)
        xx, yy, xy, xz, yz = ((a * b).sum(axis=1) for a, b in ((x, x), (y, y), (x, y), (x, z), (y, z)))
        det = xx * yy - xy * xy
        flat = det > 1e-9 * (xx + yy) ** 2
        det[~flat] = np.nan
        rise = np.hypot((yy * xz - xy * yz) / det, (xx * yz - xy * xz) / det)
        out[start : start + _BATCH] = np.degrees(np.arctan(rise))
    return out


def terrain(ground: Longs, rect: Rect, params: DtmParams | None = None) -> Singles:
    """Return the terrain model of one cloud, with the rules of a run's.

    Parameters
    ----------
    ground : ndarray of int64, shape (n, 3)
        Ground points, mm.
    rect : Rect
        Area of the raster, mm; its edges lie at multiples of the resolution.
    params : DtmParams, optional
        Resolution and limits; 1 m by default.

    Returns
    -------
    ndarray of float32, shape (rows, columns)
        Heights in metres at the pixels' centres, north up; NaN where no triangle that counts holds the centre.

    Raises
    ------
    ParameterError
        When an edge of `rect` is no multiple of the resolution.
    """
    params = params or DtmParams()
    grid = DtmGrid.from_params(params)
    step = grid.resolution
    if rect.snap(step) != rect:
        raise ParameterError(f"the raster's edges, {rect.metres()} m, are no multiples of its pixel, {step / MM} m")
    rows, columns = rect.height // step, rect.width // step
    if len(ground) == 0:
        return np.full((rows, columns), np.nan, np.float32)
    raster = Raster.over(grid, rect)
    whole = np.full(raster.shape, np.nan, np.float32)
    known, parts = bounds(ground), [Part.of(ground)]
    for block in grid.over(rect):
        if block.rect.intersects(known):
            r, c = raster.offset(block)
            found = rasterize_block(block, lambda _: parts, params, extent=known)
            whole[r : r + BLOCK, c : c + BLOCK] = found.height
    r, c = (raster.rect.y1 - rect.y1) // step, (rect.x0 - raster.rect.x0) // step
    return whole[r : r + rows, c : c + columns].copy()


def canopy_model(points: Longs, dtm: Singles, rect: Rect) -> Singles:
    """Return ``max(0, highest point of the pixel - terrain)``, m; NaN in pixels without points or terrain.

    Parameters
    ----------
    points : ndarray of int64, shape (n, 3)
        All points without noise, inside `rect`, mm.
    dtm : ndarray of float32
        The terrain over `rect`, m; its shape tells the size of a pixel.
    rect : Rect
        The area, mm.
    """
    step = rect.height // dtm.shape[0]
    dsm = np.full(dtm.shape, -np.inf)
    np.maximum.at(dsm, _pixels(points, rect, step), points[:, 2] / MM)
    dsm[np.isneginf(dsm)] = np.nan
    return np.maximum(0.0, dsm - dtm).astype(np.float32)


def cover(chm: Singles, pixels: int) -> Singles:
    """Return the canopy cover: per cell of `pixels` x `pixels` the share of its valid pixels higher than 2 m.

    Examples
    --------
    >>> cover(np.array([[3.0, 0.0], [np.nan, 1.0]], np.float32), 2)
    array([[0.33333334]], dtype=float32)
    """
    rows, columns = (n // pixels for n in chm.shape)
    cells = chm.reshape(rows, pixels, columns, pixels)
    valid = np.isfinite(cells).sum(axis=(1, 3))
    tall = (cells > CANOPY).sum(axis=(1, 3))
    return np.where(valid > 0, tall / np.maximum(valid, 1), np.nan).astype(np.float32)


def cell_mean(points: Longs, values: Floats, rect: Rect, step: int) -> Singles:
    """Return the mean of the finite values of the points of each cell of `step` mm; NaN where there are none."""
    shape = (rect.height // step, rect.width // step)
    use = np.isfinite(values)
    at = np.ravel_multi_index(_pixels(points[use], rect, step), shape)
    count = np.bincount(at, minlength=shape[0] * shape[1])
    total = np.bincount(at, values[use], minlength=shape[0] * shape[1])
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape).astype(np.float32)


def _pixels(points: Longs, rect: Rect, step: int) -> tuple[Longs, Longs]:
    # Rows count from the north, but a point on an edge belongs to the pixel above it, as everywhere on the job grid.
    return rect.height // step - 1 - (points[:, 1] - rect.y0) // step, (points[:, 0] - rect.x0) // step


def _mean(values: npt.NDArray[np.floating]) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean(dtype=np.float64)) if known.size else math.nan
