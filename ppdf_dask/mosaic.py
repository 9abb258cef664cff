"""The terrain model as one picture: an xarray view of the store, a Cloud-Optimized GeoTIFF.

Heights stand in the survey's own vertical unit and coordinates in those of its CRS, although the raster itself is cut
in metres: pixels of a survey in feet are `resolution` metres wide, 3.28 feet for 1 m.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.dtm import BLOCK, Raster
from ppdf_dask.errors import StoreError
from ppdf_dask.grid import MM
from ppdf_dask.params import DtmParams

if TYPE_CHECKING:
    import xarray as xr
    from rasterio.transform import Affine

    from ppdf_dask.store import RunStore

_UNITS = {1.0: "m", 0.3048: "ft", 1200 / 3937: "US_survey_foot"}
"""UDUNITS spellings."""

# Deflate is read everywhere; predictor 3 (floating point) halves what is left; one thread, so the bytes are the same on
# every machine with the same GDAL. Averages are what a height at a coarser pixel means, and they skip nodata.
_COG_OPTIONS = {
    "COMPRESS": "DEFLATE",
    "LEVEL": "6",
    "PREDICTOR": "FLOATING_POINT",
    "BLOCKSIZE": str(BLOCK),
    "OVERVIEWS": "IGNORE_EXISTING",
    "OVERVIEW_RESAMPLING": "AVERAGE",
    "BIGTIFF": "IF_SAFER",
    "NUM_THREADS": "1",
}


_GDAL_CACHE_MB = 16
"""GDAL would take 5 % of the machine's memory; a block is written once and read twice, so there is little to keep."""


def raster_attributes(params: DtmParams, unit_z: float = 1.0) -> dict[str, dict[str, Any]]:
    """Return the variables of the stored terrain model with their attributes.

    Parameters
    ----------
    params : DtmParams
        Says whether there is a filled variant.
    unit_z : float
        Metres per unit of height.

    Returns
    -------
    dict of str to dict
        ``height``, ``distance`` and, if asked for, ``filled``; named as in `ppdf_dask.dtm.BlockResult`.

    Examples
    --------
    >>> sorted(raster_attributes(DtmParams(fill_edge=200.0)))
    ['distance', 'filled', 'height']
    >>> raster_attributes(DtmParams(), 0.3048)["height"]["units"]
    'ft'
    """
    units = next((name for value, name in _UNITS.items() if abs(value - unit_z) < 1e-9), f"{unit_z} m")
    farthest = params.max_edge if params.fill_edge is None else params.fill_edge
    variables = {
        "height": {
            "units": units,
            "standard_name": "surface_altitude",
            "long_name": f"height of the ground; none in triangles with edges or circles beyond {params.max_edge} m",
        },
        "distance": {
            "units": "m",
            "long_name": f"distance to the nearest ground point, inf beyond {farthest} m",
        },
    }
    if params.fill_edge is not None:
        variables["filled"] = variables["height"] | {
            "long_name": f"height of the ground, holes filled up to {params.fill_edge} m"
        }
    return variables


def spatial_ref(raster: Raster, wkt: str | None, unit_xy: float = 1.0) -> dict[str, Any]:
    """Return the attributes of the grid-mapping variable: WKT2, the CF terms and the affine transform.

    Parameters
    ----------
    raster : Raster
        The stored raster.
    wkt : str or None
        The survey's CRS, compound with its vertical part where that is known; None: unknown.
    unit_xy : float
        Metres per unit of the CRS.

    Returns
    -------
    dict
        JSON types only.

    Examples
    --------
    >>> from ppdf_dask.dtm import DtmGrid
    >>> spatial_ref(Raster(DtmGrid(500), -1, 2, 1, 1), None)
    {'GeoTransform': '512.0 0.5 0.0 256.0 0.0 -0.5'}
    """
    step = raster.grid.resolution / MM / unit_xy
    x0, y1 = raster.rect.x0 / MM / unit_xy, raster.rect.y1 / MM / unit_xy
    attributes: dict[str, Any] = {"GeoTransform": f"{x0!r} {step!r} 0.0 {y1!r} 0.0 {-step!r}"}
    if wkt is not None:
        import pyproj

        cf = pyproj.CRS.from_wkt(wkt).to_cf()
        attributes |= {k: v for k, v in cf.items() if isinstance(v, str | int | float | list)}
        attributes |= {"crs_wkt": wkt, "spatial_ref": wkt}
    return attributes


def open_dtm(store: str | os.PathLike[str], variable: str = "height", *, dask: bool = True) -> xr.DataArray:
    """Open the terrain model of a run as a lazy array.

    Parameters
    ----------
    store : path
        The ``run.zarr`` of a run.
    variable : {"height", "distance", "filled"}
        What to open; ``"filled"`` only where `fill_edge` was given.
    dask : bool
        True: a Dask array whose chunks are the blocks; False: lazy without Dask, for reading window by window.

    Returns
    -------
    xarray.DataArray
        (y, x) float32, north up, with pixel-centre coordinates in the CRS's unit and the CRS as ``.rio.crs``.

    Raises
    ------
    StoreError
        If there is no such terrain model.
    """
    import xarray as xr

    _import_rio()
    group = Path(store) / "dtm"
    if not (group / "zarr.json").is_file():
        raise StoreError(f"{group} does not exist; the run has no terrain model yet: give the same `run` command again")
    chunks = {"y": BLOCK, "x": BLOCK} if dask else None
    dataset = xr.open_zarr(group, consolidated=False, chunks=chunks, decode_coords="all")
    if variable not in dataset:
        raise StoreError(f"{group} has no {variable!r}; it has {', '.join(map(str, dataset.data_vars))}")
    array: xr.DataArray = dataset[variable]
    return array


def _import_rio() -> None:
    """Register the ``.rio`` accessor."""
    import rioxarray  # noqa: F401


@dataclass(frozen=True)
class _Picture:
    """What a GeoTIFF is made of; `read` gives the pixels of the window at a row and a column."""

    shape: tuple[int, int]
    crs: Any
    transform: Affine
    units: str
    name: str
    read: Callable[[int, int], npt.NDArray[np.float32]]


def write_cog(dtm: xr.DataArray, path: str | os.PathLike[str]) -> Path:
    """Write a Cloud-Optimized GeoTIFF with overviews, in bounded memory.

    The raster is first written window by window to a plain tiled GeoTIFF, which GDAL's COG driver then copies: given a
    Dask array, that driver writes empty overviews (rioxarray issue 410) or runs out of memory. The file appears under
    its name when it is whole. It carries no clock: the same raster gives the same bytes with the same GDAL.

    Parameters
    ----------
    dtm : xarray.DataArray
        (y, x) float32, north up, evenly spaced coordinates; from `open_dtm` (best with ``dask=False``) or any other
        source, also a slice of one.
    path : path
        The file to write; an old one is replaced.

    Returns
    -------
    Path
        `path`.
    """
    _import_rio()

    def read(r: int, c: int) -> npt.NDArray[np.float32]:
        part = dtm[r : r + BLOCK, c : c + BLOCK].compute(scheduler="synchronous")
        return np.asarray(part.values, dtype=np.float32)

    rows, columns = dtm.shape
    name = "height" if dtm.name is None else str(dtm.name)
    units = str(dtm.attrs.get("units", ""))
    return _write(_Picture((rows, columns), dtm.rio.crs, _transform(dtm), units, name, read), Path(path))


def export_cog(store: RunStore, path: str | os.PathLike[str]) -> Path:
    """Write the heights of a run as `write_cog` does, byte for byte, without xarray.

    A worker that imports it, and Dask's arrays and pandas with it, is 80 MB larger from then on.

    Parameters
    ----------
    store : RunStore
        The ``run.zarr`` of a run.
    path : path
        The file to write; an old one is replaced.

    Returns
    -------
    Path
        `path`.

    Raises
    ------
    DamagedError
        When an object of the raster is damaged.
    """
    from rasterio.crs import CRS

    shape, attributes = store.raster("height")
    place = store.raster("spatial_ref")[1]
    wkt = place.get("crs_wkt")

    def read(r: int, c: int) -> npt.NDArray[np.float32]:
        return store.read_block("height", r // BLOCK, c // BLOCK, BLOCK)

    crs = None if wkt is None else CRS.from_user_input(wkt)
    transform = _stored_transform(str(place["GeoTransform"]))
    return _write(_Picture(shape, crs, transform, str(attributes.get("units", "")), "height", read), Path(path))


def _write(picture: _Picture, path: Path) -> Path:
    import rasterio
    import rasterio.shutil
    from rasterio.windows import Window

    plain, whole = (path.with_name(f".{path.stem}.{os.getpid()}.{part}.tif") for part in ("plain", "cog"))
    rows, columns = picture.shape
    profile = {
        "driver": "GTiff",
        "dtype": "float32",
        "count": 1,
        "height": rows,
        "width": columns,
        "crs": picture.crs,
        "transform": picture.transform,
        "nodata": float("nan"),
        "tiled": True,
        "blockxsize": BLOCK,
        "blockysize": BLOCK,
        "compress": "deflate",
        "zlevel": 1,
        "bigtiff": "if_safer",
        "sparse_ok": True,
    }
    try:
        with rasterio.Env(GDAL_CACHEMAX=_GDAL_CACHE_MB):
            with rasterio.open(plain, "w", **profile) as target:
                target.units = (picture.units,)
                target.set_band_description(1, picture.name)
                for r, c in _windows(rows, columns):
                    values = picture.read(r, c)
                    if not np.isnan(values).all():
                        target.write(values, 1, window=Window(c, r, values.shape[1], values.shape[0]))
            rasterio.shutil.copy(plain, whole, driver="COG", **_COG_OPTIONS)
        os.replace(whole, path)
    finally:
        for leftover in (plain, whole):
            leftover.unlink(missing_ok=True)
    return path


def _windows(rows: int, columns: int) -> Iterator[tuple[int, int]]:
    return ((r, c) for r in range(0, rows, BLOCK) for c in range(0, columns, BLOCK))


def _transform(dtm: xr.DataArray) -> Affine:
    """Return the affine transform of an array that may be a slice: pixel size as stored, origin by its coordinates."""
    from rasterio.transform import Affine

    x, y = dtm["x"].values, dtm["y"].values
    stored = dtm.coords["spatial_ref"].attrs.get("GeoTransform") if "spatial_ref" in dtm.coords else None
    if stored is None:
        dx, dy = (x[-1] - x[0]) / (len(x) - 1), (y[-1] - y[0]) / (len(y) - 1)
        return Affine(dx, 0.0, x[0] - dx / 2, 0.0, dy, y[0] - dy / 2)
    whole = _stored_transform(stored)
    x0, dx, y0, dy = whole.c, whole.a, whole.f, whole.e
    skip_x, skip_y = round((x[0] - x0) / dx - 0.5), round((y[0] - y0) / dy - 0.5)
    return Affine(dx, 0.0, x0 + skip_x * dx, 0.0, dy, y0 + skip_y * dy)


def _stored_transform(text: str) -> Affine:
    from rasterio.transform import Affine

    return Affine.from_gdal(*(float(v) for v in text.split()))
