"""The studies' rasters as plain GeoTIFF files in metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from ppdf_dask.grid import MM, Rect


def write_raster(path: Path, values: npt.NDArray[np.float32], rect: Rect, pixel: int) -> None:
    """Write a raster, north up, NaN where unknown.

    Parameters
    ----------
    path : Path
        Its folder is made; written under a temporary name and moved into place.
    values : ndarray of float32, shape (rows, columns)
        The raster.
    rect : Rect
        Its outer edges, mm.
    pixel : int
        Edge of a pixel, mm.
    """
    import rasterio

    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    with rasterio.open(
        part,
        "w",
        driver="GTiff",
        height=values.shape[0],
        width=values.shape[1],
        count=1,
        dtype="float32",
        nodata=float("nan"),
        compress="deflate",
        transform=rasterio.Affine(pixel / MM, 0.0, rect.x0 / MM, 0.0, -pixel / MM, rect.y1 / MM),
    ) as target:
        target.write(values, 1)
    part.replace(path)


def read_raster(path: Path) -> npt.NDArray[np.float32]:
    """Read what `write_raster` wrote."""
    import rasterio

    with rasterio.open(path) as source:
        values: npt.NDArray[np.float32] = source.read(1)
    return values
