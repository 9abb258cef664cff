"""Every filter through tiler, chunks, engine and merge: the mask of the whole survey, and seams that are measured."""

from __future__ import annotations

import laspy
import numpy as np
import pytest

from ppdf_dask import filters
from ppdf_dask.filters import classify_ground
from ppdf_dask.filters.cloud import cloud_from_xyz, density
from ppdf_dask.params import ChunkParams, ClassRules, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.seams import measure
from ppdf_dask.store import RunStore
from ppdf_dask.survey import scan
from ppdf_dask.synthetic import terrestrial_plot

# Windows so small that the chunks at the corners, with their buffers, do not hold the whole survey: 120 m of airborne
# forest in chunks of 40 m, 20 m of a terrestrial plot in chunks of 5 m.
SMALL = {
    "msf": {"variant": "strict", "window": 10.0},
    "msf seeded": {"window": 4.0},
    "pmf": {"window": 5.0},
    "smrf": {"window": 6.0},
    "ptdf": {"window": 5.0},
    "csf": {"resolution": 0.5},
    "voxel": {"resolution": 0.2, "points_per_column": 0.0},
    "pcom": {"resolution": 0.2, "points_per_column": 0.0},
}


def tile(path, xyz):
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.scales = [0.001] * 3
    las.x, las.y, las.z = xyz.T
    las.write(path)
    return path


@pytest.fixture(scope="module")
def plot(tmp_path_factory):
    """A terrestrial plot as one tile."""
    xyz, _ = terrestrial_plot("slope", seed=3, edge=20.0, density=150.0)
    return [tile(tmp_path_factory.mktemp("plot") / "plot.laz", xyz)]


@pytest.mark.filterwarnings("ignore:resolution = 0.1 m is too fine")
def test_the_buffer_follows_the_density_that_was_found(client, tmp_path):
    # Moved by half a cell the plot lies in 25 cells of 5 m instead of the 16 that its bounds suggest.
    xyz, _ = terrestrial_plot("flat", seed=3, edge=20.0, density=40.0)
    params = filters.parameters("pcom").replace(resolution=0.1)
    made = plan(scan([tile(tmp_path / "moved.laz", xyz + 2.5)]), RunParams(filter=params), out=tmp_path / "run")
    made.run(client)
    chosen = filters.of(params)
    found = measure(tmp_path / "run")
    resolved = chosen.resolve(params, density(cloud_from_xyz(xyz + 2.5)))
    assert chosen.required_buffer(resolved) > made.buffer / 1000
    assert found.buffer_m == pytest.approx(chosen.required_buffer(resolved), abs=0.001)
    records = [r for _, r in RunStore(str(tmp_path / "run" / "run.zarr")).records("classify")]
    assert {r["buffer_m"] for r in records} == {found.buffer_m}


@pytest.mark.parametrize("name", SMALL)
def test_chunks_give_the_mask_of_the_whole_survey(name, small_survey, plot, client, tmp_path):
    if name == "csf":
        pytest.importorskip("CSF", reason="the extra csf is not installed")
    params = filters.parameters(name.split()[0]).replace(**SMALL[name])
    chosen = filters.of(params)
    tiles, size = sorted((small_survey / "tiles").glob("*.laz")), 40.0
    if name in ("voxel", "pcom"):
        tiles, size = plot, 5.0
    asked = RunParams(filter=params, chunks=ChunkParams(chunk_size=size), classes=ClassRules(mode="reset"))
    made = plan(scan(tiles), asked, out=tmp_path / "run")
    assert made.buffer == pytest.approx(1000 * chosen.required_buffer(params), abs=1)
    before = [laspy.read(path) for path in tiles]
    xyz, classes = (np.concatenate([np.asarray(getattr(t, v)) for t in before]) for v in ("xyz", "classification"))
    assert size + made.buffer / 1000 < np.ptp(xyz[:, 0])
    made.run(client)
    after = np.concatenate([laspy.read(tmp_path / "run" / "laz" / p.name).classification for p in tiles])
    seen = ~np.isin(classes, [7, 9, 18])
    if params.RETURNS == "last":
        seen &= np.concatenate([np.asarray(t.return_number) >= np.asarray(t.number_of_returns) for t in before])
    expected = classify_ground(xyz[seen], params)
    assert 0.1 < expected.mean() < 0.9
    differ = int(((after[seen] == 2) != expected).sum())
    found = measure(tmp_path / "run")
    assert (found.filter, found.exact, found.unproven) == (chosen.name, chosen.exact, 0)
    assert len(found.seams) >= 12
    assert found.points > 3000
    # Where the reach has a bound no cut shows. A cloth has none, and hangs at the corner of what is loaded.
    most = 0.02 if name == "csf" else 0.0
    assert differ <= most * seen.sum()
    assert found.differ <= most * found.points
    assert name != "csf" or found.differ > 0
