import subprocess
import sys

import numpy as np
import pytest
import rasterio
import xarray as xr
from rio_cogeo.cogeo import cog_validate

from ppdf_dask.dtm import BLOCK, DtmGrid, Raster
from ppdf_dask.errors import PlanError, StoreError
from ppdf_dask.grid import Rect
from ppdf_dask.mosaic import export_cog, open_dtm, raster_attributes, spatial_ref, write_cog
from ppdf_dask.params import DtmParams
from ppdf_dask.store import RunStore

US_FOOT = 1200 / 3937
COMPOUND = "EPSG:25832+7837"


def wkt(crs):
    import pyproj

    return pyproj.CRS.from_user_input(crs).to_wkt("WKT2_2019")


def stored(folder, crs=COMPOUND, unit=1.0, rows=2, cols=3):
    """A store with one raster: a tilted plane with a hole, and the block (0, 1) missing."""
    raster = Raster(DtmGrid(500), -20000, 1600, rows, cols)
    x, y = raster.centres(unit)
    store = RunStore(str(folder / "run.zarr"))
    store.create({})
    text = None if crs is None else wkt(crs)
    store.create_raster(y, x, BLOCK, spatial_ref(raster, text, unit), raster_attributes(DtmParams(), unit))
    truth = plane(raster)
    for r in range(rows):
        for c in range(cols):
            if (r, c) != (0, 1):
                store.write_block("height", r, c, truth[r * BLOCK : (r + 1) * BLOCK, c * BLOCK : (c + 1) * BLOCK])
    truth[:BLOCK, BLOCK : 2 * BLOCK] = np.nan
    return folder / "run.zarr", raster, truth


def plane(raster):
    x, y = raster.centres()
    z = (100 + 0.01 * (x - x[0]) + 0.02 * (y[:, None] - y[0])).astype(np.float32)
    z[600:650, 100:180] = np.nan
    return z


@pytest.mark.parametrize("dask", [True, False])
def test_the_store_opens_with_crs_coordinates_and_blocks_as_chunks(tmp_path, dask):
    path, raster, truth = stored(tmp_path)
    dtm = open_dtm(path, dask=dask)
    np.testing.assert_array_equal(dtm.values, truth)
    assert dtm.dims == ("y", "x")
    assert dtm.attrs["units"] == "m"
    assert rasterio.crs.CRS.from_user_input(dtm.rio.crs) == rasterio.crs.CRS.from_user_input(COMPOUND)
    r = raster.rect
    assert dtm.rio.bounds() == r.metres()
    assert float(dtm.x[0]) == r.x0 / 1000 + 0.25
    assert float(dtm.y[0]) == r.y1 / 1000 - 0.25
    assert dtm.chunks == (((BLOCK,) * 2, (BLOCK,) * 3) if dask else None)


def test_a_place_is_where_it_says_in_feet(tmp_path):
    path, raster, _ = stored(tmp_path, crs="EPSG:2263", unit=US_FOOT, rows=1, cols=1)
    dtm = open_dtm(path)
    assert dtm.attrs["units"] == "US_survey_foot"
    written = write_cog(dtm, tmp_path / "dtm.tif")
    with rasterio.open(written) as tif:
        assert tif.res[0] * US_FOOT == pytest.approx(0.5, rel=1e-15)
        edges = (raster.rect.x0, raster.rect.y0, raster.rect.x1, raster.rect.y1)
        # The coordinates are doubles of some 1e7 feet: 2e-9 each.
        assert [b * US_FOOT for b in tif.bounds] == pytest.approx([e / 1000 for e in edges], abs=1e-8)


def test_the_cog_is_valid_whole_and_has_real_overviews(tmp_path):
    path, raster, truth = stored(tmp_path)
    target = write_cog(open_dtm(path, dask=False), tmp_path / "dtm.tif")
    ok, errors, warnings = cog_validate(str(target), strict=True)
    assert ok, (errors, warnings)
    with rasterio.open(target) as tif:
        np.testing.assert_array_equal(tif.read(1), truth)
        assert tif.bounds == raster.rect.metres()
        assert np.isnan(tif.nodata)
        assert tif.crs == rasterio.crs.CRS.from_user_input(COMPOUND)
        assert tif.units == ("m",)
        assert tif.overviews(1) == [2, 4]
    with rasterio.open(target, overview_level=1) as small:
        z = small.read(1)
        # A plane's average over 4 x 4 pixels is its value in their middle; float32 at 100 m resolves 8e-6 m.
        x, y = raster.centres()
        wanted = 100 + 0.01 * (x[1::4] + 0.25 - x[0]) + 0.02 * (y[1::4, None] - 0.25 - y[0])
        clear = ~np.isnan(truth[:1024, :1536].reshape(256, 4, 384, 4)).any(axis=(1, 3))
        np.testing.assert_allclose(z[clear], wanted[clear], atol=3e-5)
        assert np.isnan(z[10, 200])
    assert [p.name for p in tmp_path.glob("*.tif")] == ["dtm.tif"]
    assert not list(tmp_path.glob(".dtm*"))


def test_the_same_raster_gives_the_same_bytes(tmp_path):
    path, _, _ = stored(tmp_path)
    a = write_cog(open_dtm(path), tmp_path / "a.tif").read_bytes()
    assert write_cog(open_dtm(path, dask=False), tmp_path / "b.tif").read_bytes() == a


@pytest.mark.parametrize(("crs", "unit"), [(COMPOUND, 1.0), ("EPSG:2263", US_FOOT), (None, 1.0)])
def test_the_export_of_a_run_is_the_same_file(tmp_path, crs, unit):
    path, _, _ = stored(tmp_path, crs=crs, unit=unit)
    a = write_cog(open_dtm(path), tmp_path / "a.tif").read_bytes()
    assert export_cog(RunStore(str(path)), tmp_path / "b.tif").read_bytes() == a


def test_the_export_of_a_run_does_not_load_xarray(tmp_path):
    path, _, _ = stored(tmp_path)
    code = (
        "import sys; from ppdf_dask import tasks\n"
        f"tasks.export({str(path)!r}, {str(tmp_path / 'dtm.tif')!r}, '')\n"
        "print(sorted({'xarray', 'pandas', 'dask.array', 'rioxarray'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_slice_keeps_its_place(tmp_path):
    path, raster, truth = stored(tmp_path)
    part = open_dtm(path)[100:900, 30:1300]
    with rasterio.open(write_cog(part, tmp_path / "part.tif")) as tif:
        np.testing.assert_array_equal(tif.read(1), truth[100:900, 30:1300])
        assert tif.transform.c == raster.rect.x0 / 1000 + 15
        assert tif.transform.f == raster.rect.y1 / 1000 - 50


def test_no_crs_and_no_store_are_possible(tmp_path):
    path, _, truth = stored(tmp_path, crs=None)
    with rasterio.open(write_cog(open_dtm(path), tmp_path / "dtm.tif")) as tif:
        assert tif.crs is None
        np.testing.assert_array_equal(tif.read(1), truth)
    plain = xr.DataArray(truth[:40, :30], {"y": 10.0 - np.arange(40), "x": np.arange(30) + 0.5}, ("y", "x"))
    with rasterio.open(write_cog(plain, tmp_path / "plain.tif")) as tif:
        assert tuple(tif.transform)[:6] == (1, 0, 0, 0, -1, 10.5)
        np.testing.assert_array_equal(tif.read(1), truth[:40, :30])


def test_a_failure_leaves_the_old_file(tmp_path):
    path, _, _ = stored(tmp_path)
    target = tmp_path / "dtm.tif"
    target.write_bytes(b"old")
    shard = path / "dtm" / "height" / "c" / "1" / "2"
    shard.write_bytes(shard.read_bytes()[:-4] + b"torn")
    with pytest.raises(ValueError, match="checksum"):
        write_cog(open_dtm(path), target)
    assert target.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir() if p.name != "run.zarr"] == ["dtm.tif"]


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(StoreError, match="no terrain model yet"):
        open_dtm(tmp_path)
    path, _, _ = stored(tmp_path, rows=1, cols=1)
    with pytest.raises(StoreError, match="has no 'filled'"):
        open_dtm(path, "filled")


def test_a_stray_point_is_refused():
    Raster.over(DtmGrid(1000), Rect(0, 0, 199_000_000, 199_000_000))
    with pytest.raises(PlanError, match="x 0 to 500000 m, y -400000 to 1 m"):
        Raster.over(DtmGrid(1000), Rect(0, -400_000_000, 500_000_000, 1000))
