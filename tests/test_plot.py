"""Pictures: what is drawn is what is there, and it goes into the axes given."""

from __future__ import annotations

import laspy
import matplotlib
import numpy as np
import pytest

from ppdf_dask import plot, plotdata
from ppdf_dask.errors import ParameterError
from ppdf_dask.maps import PALETTE
from ppdf_dask.params import ChunkParams, DtmParams, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.survey import scan

matplotlib.use("Agg")
import matplotlib.pyplot as plt


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def survey(small_survey):
    return scan([small_survey / "tiles"])


@pytest.fixture(scope="module")
def finished(survey, client, tmp_path_factory):
    params = RunParams(chunks=ChunkParams(chunk_size=60.0), dtm=DtmParams(resolution=2.0))
    return plan(survey, params, out=tmp_path_factory.mktemp("plot") / "run").run(client)


def test_maps_draw_every_tile_and_chunk(survey):
    assert len(survey.plot().collections[0].get_paths()) == len(survey.tiles) == 9
    made = plan(survey, RunParams(chunks=ChunkParams(chunk_size=40.0)))
    ax = made.plot()
    assert len(ax.collections[0].get_paths()) == len(made.chunks)
    x0, y0, x1, y1 = survey.bounds.metres()
    assert ax.get_xlim()[0] <= x0 < x1 <= ax.get_xlim()[1]
    assert ax.get_ylim()[0] <= y0 < y1 <= ax.get_ylim()[1]


def test_given_axes_are_used_and_returned(survey, finished):
    _, axes = plt.subplots(1, 3)
    assert survey.plot(axes[0]) is axes[0]
    assert finished.plot.hillshade(ax=axes[1]) is axes[1]
    assert finished.plot.section(((610, 610), (700, 700)), ax=axes[2]) is axes[2]
    assert len(finished.plot.map(plt.subplots()[1]).collections[0].get_paths()) == len(finished.chunks)


def test_hillshade_shows_the_stored_heights_where_they_lie(finished):
    image = finished.plot.hillshade().images[0]
    np.testing.assert_array_equal(np.ma.getdata(image.get_array()), finished.dtm.values)
    x0, _, _, y1 = image.get_extent()
    assert (x0, y1) == (finished.dtm.x.values[0] - 1, finished.dtm.y.values[0] + 1)
    part = finished.plot.hillshade((640.0, 650.0, 680.0, 700.0)).images[0]
    assert tuple(part.get_extent()) == (640.0, 680.0, 650.0, 700.0)
    inside = finished.dtm.sel(x=slice(640, 680), y=slice(700, 650)).values
    np.testing.assert_array_equal(np.ma.getdata(part.get_array()), inside)
    with pytest.raises(ParameterError, match="does not meet the raster"):
        finished.plot.hillshade((5000.0, 0.0, 5010.0, 10.0))


def test_a_large_raster_is_read_from_its_overviews(finished, monkeypatch):
    monkeypatch.setattr(plotdata, "PIXELS", 100)
    image = finished.plot.hillshade().images[0]
    assert max(np.ma.getdata(image.get_array()).shape) <= 100


def test_a_section_takes_exactly_the_points_of_its_strip(finished):
    (x0, y0), (x1, y1), width = (615.0, 620.0), (705.0, 690.0), 6.0
    along, z, classes = plotdata.section_points(finished.tiles, ((x0, y0), (x1, y1)), width)
    expected = []
    for path in finished.tiles:
        las = laspy.read(path)
        for x, y, height, kind in zip(las.x, las.y, las.z, las.classification, strict=True):
            t = ((x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)) / ((x1 - x0) ** 2 + (y1 - y0) ** 2)
            foot = x0 + t * (x1 - x0), y0 + t * (y1 - y0)
            if 0 <= t <= 1 and np.hypot(x - foot[0], y - foot[1]) <= width / 2:
                expected.append((round(float(height), 3), int(kind)))
    assert sorted(zip(z.round(3).tolist(), classes.tolist(), strict=True)) == sorted(expected)
    assert len(z) > 100
    assert along.min() >= 0
    assert along.max() <= np.hypot(x1 - x0, y1 - y0)


def test_a_section_has_one_colour_per_class_and_ground_on_top():
    classes = np.array([2, 1, 4, 0, 7, 18, 9, 77, 2])
    ax = plot.draw_section(np.arange(9.0), np.zeros(9), classes, plt.subplots()[1])
    named = {t.get_text() for t in ax.get_legend().get_texts()}
    assert named == {"not ground, 3", "noise, 2", "water, 1", "other classes, 1", "ground, 2"}
    assert ax.collections[-1].get_offsets()[:, 0].tolist() == [0.0, 8.0]
    assert matplotlib.colors.to_hex(ax.collections[-1].get_facecolor()[0]).upper() == PALETTE["red"].upper()


@pytest.mark.parametrize(("line", "width"), [(((0, 0), (0, 0)), 2.0), (((0, 0), (9, 0)), 0.0)])
def test_an_impossible_section_is_refused(finished, line, width):
    with pytest.raises(ParameterError, match="a section needs"):
        finished.plot.section(line, width)


def test_a_section_beside_the_survey_says_so(finished):
    with pytest.raises(ParameterError, match="inside the survey"):
        finished.plot.section(((0, 0), (9, 0)))


def test_planes_are_those_of_the_published_method(finished):
    from ppdf_dask.filters.cloud import cloud_from_xyz
    from ppdf_dask.filters.ppdf.paper.classify import stages
    from ppdf_dask.filters.ppdf.paper.params import PaperParams

    chunk = finished.chunks[1]
    params = PaperParams(min_inliers=8)
    points = finished.open_points(chunk)
    found = stages(cloud_from_xyz(np.column_stack([points.x, points.y, points.z])), params).planes
    ax = finished.plot.planes(chunk, params=params)
    assert sum(len(c.get_paths()) for c in ax.collections[1:]) == len(found) > 0


def test_units_of_heights_become_metres():
    assert plotdata.unit_metres("US_survey_foot") == pytest.approx(0.3048006096)
    assert plotdata.unit_metres("") == 1.0
