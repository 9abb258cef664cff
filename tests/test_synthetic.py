"""The synthetic survey: the same wherever it is cut, with the ground where it says it is."""

from __future__ import annotations

import hashlib
import math
from itertools import pairwise
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from ppdf_dask.errors import ParameterError
from ppdf_dask.synthetic import SyntheticParams, points, six_sites, terrestrial_plot, true_height, write_survey
from ppdf_dask.synthetic import scanner as scanner_module
from ppdf_dask.synthetic.scanner import bands_of, rect_of
from ppdf_dask.synthetic.terrestrial import _Scene, _visible

X, Y = 500_000.0, 5_400_000.0
RECT = (X, Y, X + 90.0, Y + 70.0)
BUSY = SyntheticParams(
    density=2.0, low_noise=0.01, high_noise=0.01, low_outliers=0.01, house_share=1.0, boulder_share=0.3
)

Cloud = dict[str, np.ndarray]


def rows(cloud: Cloud) -> np.ndarray:
    """All dimensions of all points, as sortable rows."""
    table = np.column_stack([np.asarray(cloud[name], np.float64) for name in sorted(cloud)])
    return table[np.lexsort(table.T)]


def joined(clouds: list[Cloud]) -> Cloud:
    return {name: np.concatenate([c[name] for c in clouds]) for name in clouds[0]}


@pytest.fixture(scope="module")
def busy() -> Cloud:
    return points(RECT, BUSY)


@given(
    x=st.lists(st.integers(1, 89_999), min_size=1, max_size=2, unique=True),
    y=st.lists(st.integers(1, 69_999), min_size=0, max_size=1),
    pulses=st.sampled_from([1, 500, 200_000]),
)
@settings(max_examples=12, deadline=None)
def test_any_cut_gives_the_same_points(busy: Cloud, x: list[int], y: list[int], pulses: int) -> None:
    xs = [X, *(X + v / 1000 for v in sorted(x)), X + 90.0]
    ys = [Y, *(Y + v / 1000 for v in y), Y + 70.0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scanner_module, "BAND_PULSES", pulses)
        parts = [points((x0, y0, x1, y1), BUSY) for x0, x1 in pairwise(xs) for y0, y1 in pairwise(ys)]
    assert np.array_equal(rows(joined(parts)), rows(busy))


def test_a_survey_across_strips_and_negative_coordinates_is_cut_the_same() -> None:
    # 360 m wide flight strips meet at x = 0
    whole = points((-40.0, -15.0, 40.0, 15.0), BUSY)
    parts = [points((-40.0, -15.0, -0.5, 15.0), BUSY), points((-0.5, -15.0, 40.0, 15.0), BUSY)]
    assert len(set(whole["point_source_id"].tolist())) == 2
    assert np.array_equal(rows(joined(parts)), rows(whole))
    assert np.all(np.diff(whole["gps_time"]) >= 0)


def test_points_lie_inside_and_are_ordered_by_time(busy: Cloud) -> None:
    assert busy["x"].min() >= RECT[0]
    assert busy["x"].max() < RECT[2]
    assert busy["y"].min() >= RECT[1]
    assert busy["y"].max() < RECT[3]
    assert np.all(np.diff(busy["gps_time"]) >= 0)


def test_returns_of_a_pulse_are_numbered_from_the_top() -> None:
    params = BUSY.replace(canopy_cover=0.9)
    cloud = points((X, Y, X + 60.0, Y + 60.0), params)
    number, count, time = cloud["return_number"], cloud["number_of_returns"], cloud["gps_time"]
    assert count.max() > 2
    assert np.all((number >= 1) & (number <= count))
    same = time[1:] == time[:-1]
    assert np.all(count[1:][same] == count[:-1][same])
    assert np.all(number[1:][same] > number[:-1][same])
    # surfaces are measured with noise and come last, leaves are 0.8 m apart
    assert np.all(cloud["z"][1:][same] < cloud["z"][:-1][same])
    # nothing is seen through the ground: ground is the last return
    ground = cloud["classification"] == 2
    assert np.all(number[ground] == count[ground])
    # only pulses cut by the rectangle's edge lack returns (they lean by at most 0.18 of a tree's height)
    inner = (np.abs(cloud["x"] - X - 30.0) < 30.0 - 0.2 * 1.4 * params.canopy_height) & (count > 1)
    times, found = np.unique(time, return_counts=True)
    assert np.array_equal(found[np.searchsorted(times, time[inner])], count[inner])


@given(
    seed=st.integers(0, 2**31 - 1),
    slope=st.floats(0.0, 40.0),
    noise=st.floats(0.0, 0.2),
    terrace=st.sampled_from([0.0, 2.0]),
)
@settings(max_examples=15, deadline=None)
def test_ground_points_lie_on_the_true_terrain(seed: int, slope: float, noise: float, terrace: float) -> None:
    params = SyntheticParams(
        seed=seed, slope=slope, height_noise=noise, terrace_height=terrace, density=1.0, canopy_cover=0.3
    )
    cloud = points((X, Y, X + 40.0, Y + 40.0), params)
    ground = cloud["classification"] == 2
    error = cloud["z"][ground] - true_height(cloud["x"][ground], cloud["y"][ground], params)
    # noise is bounded by 2 sqrt(3) sigma; heights are rounded to 1 mm; a cliff of 60 m/m turns the last bit of a
    # coordinate (1e-9 m) into less than 1e-6 m
    assert np.all(np.abs(error) <= 2 * math.sqrt(3) * noise + 0.0005 + 1e-6)


def test_objects_stand_above_the_ground_and_noise_lies_where_it_should(busy: Cloud) -> None:
    above = busy["z"] - true_height(busy["x"], busy["y"], BUSY)
    kind = busy["classification"]
    assert set(np.unique(kind).tolist()) >= {1, 2, 3, 4, 5, 6, 7, 18}
    assert np.median(above[kind == 5]) > 5.0
    assert np.median(above[kind == 6]) > 2.0
    assert above[kind == 7].max() <= -2.0 + 0.001
    assert above[kind == 7].min() >= -15.001
    assert above[kind == 18].min() >= 39.999
    # a vegetation point is measured from its pulse's foot; no foot is farther than the lean of the tallest tree
    assert above[kind == 5].max() < 1.4 * BUSY.canopy_height + 0.2 * 1.4 * BUSY.canopy_height * 3
    delivered = busy["delivered"]
    assert set(delivered[kind == 7].tolist()) == {1, 7}
    assert np.all(delivered[kind == 18] == 18)
    assert set(delivered[np.isin(kind, [1, 2, 3, 4, 5, 6])].tolist()) == {1}


@pytest.mark.parametrize("density", [0.2, 4.0, 30.0])
def test_density_is_what_was_asked_for(density: float) -> None:
    edge = 20.0 * max(1.0, 2.0 / math.sqrt(density))
    bare = SyntheticParams(density=density, canopy_cover=0.0, shrub_share=0.0, water="none")
    n = len(points((X, Y, X + edge, Y + edge), bare)["x"])
    # one jittered pulse per lattice cell: only cells on the rim are in or out by chance
    rim = 4 * edge * math.sqrt(density)
    assert abs(n - density * edge * edge) <= rim


def test_water_is_level_and_returns_class_9_or_nothing() -> None:
    params = SyntheticParams(water="returns", stream_width=12.0, density=2.0)
    place = (X, Y, X + 200.0, Y + 200.0)
    cloud = points(place, params)
    water = cloud["classification"] == 9
    assert water.sum() > 50
    assert np.abs(cloud["z"][water] - (params.elevation - 1.0)).max() <= 2 * math.sqrt(3) * params.height_noise + 0.001
    assert np.all(cloud["delivered"][water] == 9)
    void = points(place, params.replace(water="void"))
    assert not np.any(void["classification"] == 9)
    assert np.any(points(place, params.replace(water="none"))["classification"] == 2)


def test_terrain_has_the_slopes_terraces_and_edges_asked_for() -> None:
    x, y = np.meshgrid(X + np.arange(0, 500, 0.5), Y + np.arange(0, 500, 0.5))

    def slopes(params: SyntheticParams) -> np.ndarray:
        gy, gx = np.gradient(true_height(x, y, params), 0.5)
        return np.degrees(np.arctan(np.hypot(gx, gy)))

    plain = SyntheticParams(slope=30.0, roughness=0.0, terrace_height=0.0, scarp_height=0.0, spurs=0.0, water="none")
    flat = slopes(plain.replace(slope=0.0))
    assert flat.max() == 0.0
    steep = slopes(plain)
    assert 15.0 < steep.mean() < 35.0
    assert steep.min() < 3.0
    assert np.percentile(slopes(plain.replace(slope=40.0)), 90) > 38.0
    tangent, terraced = (np.tan(np.radians(v)) for v in (steep, slopes(plain.replace(terrace_height=2.0))))
    # terraced slopes are risers up to five times as steep and level treads (both shares would be 0 without terraces)
    assert (terraced > 2 * tangent).mean() > 0.02
    assert (terraced < 0.2 * tangent).mean() > 0.02
    assert (np.abs(terraced - tangent) < 0.01).mean() > 0.2
    # a break line is a jump of the slope from one pixel to the next
    sharp, smooth = plain.replace(rounding=0.01), plain.replace(rounding=10.0)
    jump = [np.abs(np.diff(slopes(p), axis=1)).max() for p in (sharp, smooth)]
    assert jump[0] > 10.0 > 5.0 > jump[1]
    scarp = slopes(plain.replace(slope=0.0, scarp_height=5.0))
    assert scarp.max() > 40.0
    assert np.median(scarp) < 1.0


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_same_seed_same_files_and_any_layout_the_same_points(tmp_path: Path) -> None:
    extent = (X - 20.0, Y - 10.0, X + 50.0, Y + 40.0)
    params = BUSY.replace(density=1.0)
    first = write_survey(tmp_path / "a", params, extent=extent, tile_size=40)
    again = write_survey(tmp_path / "b", params, extent=extent, tile_size=40)
    assert [p.name for p in first] == [p.name for p in again]
    assert len(first) == 3 * 2
    for folder in ("tiles", "truth"):
        for path in first:
            assert digest(tmp_path / "a" / folder / path.name) == digest(tmp_path / "b" / folder / path.name)
    assert not list(tmp_path.rglob("*.part"))
    other = write_survey(tmp_path / "c", params.replace(seed=2), extent=extent, tile_size=40)
    assert digest(other[0]) != digest(first[0])

    layouts = [first, write_survey(tmp_path / "d", params, extent=extent, tile_size=1000, truth=False)]
    assert not (tmp_path / "d" / "truth").exists()
    clouds = []
    for tiles in layouts:
        parts = []
        for path in tiles:
            las = laspy.read(path)
            assert (las.header.point_format.id, str(las.header.version)) == (6, "1.4")
            assert las.header.parse_crs().to_epsg() == 25832
            names = [n for n in las.point_format.dimension_names if n not in "XYZ"]
            offset = np.round(las.header.offsets * 1000)
            places = {n: np.asarray(las[n], np.int64) + offset[k] for k, n in enumerate("XYZ")}
            parts.append(places | {n: np.asarray(las[n]) for n in names})
        clouds.append(joined(parts))
    assert np.array_equal(rows(clouds[0]), rows(clouds[1]))


def test_truth_is_the_same_file_with_other_classes(tmp_path: Path) -> None:
    (tile,) = write_survey(tmp_path, BUSY, extent=(X, Y, X + 30.0, Y + 30.0))
    (reference,) = write_survey(tmp_path / "ref", BUSY, extent=(X, Y, X + 30.0, Y + 30.0), classified=True)
    given_, truth = laspy.read(tile), laspy.read(tmp_path / "truth" / tile.name)
    for name in given_.point_format.dimension_names:
        assert np.array_equal(given_[name], truth[name]) == (name != "classification"), name
    assert digest(reference) == digest(tmp_path / "truth" / tile.name)
    assert not (tmp_path / "ref" / "truth").exists()


def test_a_band_is_all_that_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scanner_module, "BAND_PULSES", 3000)
    rect = rect_of((X, Y, X + 60.0, Y + 400.0))
    sizes = [len(band.x) for band in bands_of(rect, BUSY)]
    assert len(sizes) > 10
    assert max(sizes) <= 3000 * 5


@pytest.mark.parametrize("extent", [(0.0, 0.0, 0.0, 10.0), (0.0, 0.0, math.nan, 10.0), (0.0, 9.0, 10.0, 3.0)])
def test_empty_extents_are_refused(extent: tuple[float, float, float, float], tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="extent"):
        write_survey(tmp_path, extent=extent)


def test_parameters_are_validated() -> None:
    with pytest.raises(ParameterError, match="canopy_cover"):
        SyntheticParams(canopy_cover=1.5)
    with pytest.raises(ParameterError, match="'void'"):
        SyntheticParams(water="ice")  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="tile_size"):
        write_survey("unused", tile_size=0)


def site_statistics(site: object) -> dict[str, float]:
    """Density, slope, cover and canopy height as the paper measured them."""
    x0, y0, x1, _ = site.extent  # type: ignore[attr-defined]
    n = int(x1 - x0)
    cloud = points(site.extent, site.params)  # type: ignore[attr-defined]
    ground = cloud["classification"] == 2
    xy = np.column_stack([cloud["x"] - x0, cloud["y"] - y0])[ground]
    z = cloud["z"][ground]
    some = np.arange(0, len(z), max(1, len(z) // 5000))
    near = KDTree(xy).query(xy[some], 10)[1]
    d, dz = xy[near] - xy[near].mean(1, keepdims=True), z[near] - z[near].mean(1, keepdims=True)
    gradient = np.array([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(d, dz, strict=True)])
    column, row = (cloud["x"] - x0).astype(int), (cloud["y"] - y0).astype(int)
    real = ~np.isin(cloud["classification"], [7, 18])
    dsm = np.full((n, n), -np.inf)
    np.maximum.at(dsm, (row[real], column[real]), cloud["z"][real])
    px, py = np.meshgrid(x0 + 0.5 + np.arange(n), y0 + 0.5 + np.arange(n))
    chm = dsm - true_height(px, py, site.params)  # type: ignore[attr-defined]
    valid = np.isfinite(chm)
    tall = valid & (chm > 2.0)

    def blocks(a: np.ndarray) -> np.ndarray:
        return a.reshape(n // 10, 10, n // 10, 10).sum((1, 3))

    return {
        "density": len(cloud["x"]) / n**2,
        "slope": float(np.degrees(np.arctan(np.linalg.norm(gradient, axis=1))).mean()),
        "cover": float((blocks(tall) / blocks(valid)).mean()),
        "canopy": float(chm[tall].mean()),
    }


def test_six_sites_span_the_ranges_of_the_paper() -> None:
    sites = six_sites()
    table = [site_statistics(s) for s in sites]
    assert [s.points_per_m2 for s in sites] == [21.74, 7.90, 7.82, 6.73, 8.10, 2.16]
    for site, found in zip(sites, table, strict=True):
        # the sites were set by hand to 2 % of the paper's densities
        assert found["density"] == pytest.approx(site.points_per_m2, rel=0.02), site.name
    for name, low, high, slack in (
        ("slope", 18.3, 37.11, 0.5),
        ("cover", 0.0727, 0.8467, 0.01),
        ("canopy", 7.83, 23.6, 0.3),
    ):
        values = sorted(t[name] for t in table)
        assert values[0] == pytest.approx(low, abs=slack), name
        assert values[-1] == pytest.approx(high, abs=slack), name


@pytest.mark.parametrize("kind", ["flat", "slope", "complex"])
def test_terrestrial_plot_looks_like_a_tripod_scan(kind: str) -> None:
    xyz, ground = terrestrial_plot(kind, seed=2, edge=12.0, density=250.0)  # type: ignore[arg-type]
    again = terrestrial_plot(kind, seed=2, edge=12.0, density=250.0)  # type: ignore[arg-type]
    assert np.array_equal(xyz, again[0])
    assert np.array_equal(ground, again[1])
    assert not np.array_equal(xyz[:100], terrestrial_plot(kind, 3, edge=12.0, density=250.0)[0][:100])  # type: ignore[arg-type]
    assert xyz.shape == (len(ground), 3)
    assert 100 < len(xyz) / 144.0 < 1500
    tree = KDTree(xyz[ground][:, :2])
    near = np.abs(xyz[:, :2]).max(axis=1) < 5.5
    above = xyz[:, 2] - xyz[ground][tree.query(xyz[:, :2])[1], 2]
    # stems reach metres up, stumps and shrubs stand low, outliers lie below
    assert above[near & ~ground].max() > 5.0
    assert ((above > 0.1) & (above < 0.7) & ~ground).sum() > 200
    assert (above[~ground] < -0.25).sum() >= 3
    slope = np.linalg.lstsq(np.column_stack([xyz[ground][:, :2], np.ones(ground.sum())]), xyz[ground][:, 2], rcond=None)
    tangent = float(np.hypot(*slope[0][:2]))
    assert tangent < 0.1 if kind == "flat" else tangent > 0.15


def test_density_falls_with_the_distance_from_the_tripods() -> None:
    xyz, ground = terrestrial_plot("flat", seed=4, edge=40.0, density=30.0)
    at = xyz[ground][:, :2]
    middle = (np.abs(at) < 4.0).all(axis=1).sum() / 64.0
    corner = (at > 15.0).all(axis=1).sum() / 25.0
    # the corner is at least 15 m from all three tripods, where at most 3 / 9 of the points are seen
    assert 0 < corner < middle / 2


def test_stems_stumps_and_terraces_hide_what_lies_behind() -> None:
    stem, stump = (4.0, 0.0, 0.2, 8.0), (0.0, 4.0, 0.3, 0.4)
    scene = _Scene(0.0, 0.0, 0.0, np.uint64(1), np.array([stem, stump]), np.empty((0, 4)), np.array([[0.0, 0.0, 1.6]]))
    asked = np.array(
        [
            (3.7, 0.0, 0.0),  # before the stem
            (3.8, 0.0, 2.0),  # its bark towards the tripod
            (4.2, 0.0, 2.0),  # its bark on the far side
            (4.5, 0.0, 0.0),  # ground in its shadow
            (4.5, 0.6, 0.0),  # ground beside the shadow
            (0.0, 4.5, 0.0),  # ground behind the stump
            (0.0, 4.0, 0.4),  # the top of the stump
            (0.0, 4.5, 1.0),  # a leaf seen over the stump
            (0.1, 0.1, 0.0),  # under the tripod
        ]
    )
    seen = _visible(asked, scene, np.zeros(len(asked)))
    assert seen.tolist() == [True, True, False, False, True, False, True, True, False]
    ridge = scene._replace(swell=2.0, cylinders=np.empty((0, 4)))
    below = asked - np.array([0.0, 0.0, 20.0])
    assert not _visible(below, ridge, np.zeros(len(below))).any()


def test_terrestrial_plot_refuses_unknown_kinds() -> None:
    with pytest.raises(ParameterError, match="'slope'"):
        terrestrial_plot("hill")  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="edge"):
        terrestrial_plot("flat", edge=1.0)
