"""benchmark accuracy: thinning seen from the data, what is offered and what is scored, means over complete clouds."""

from __future__ import annotations

import json
import math
from pathlib import Path

import laspy
import numpy as np
import pytest
from click.testing import CliRunner

from ppdf_dask import filters
from ppdf_dask.cli import group
from ppdf_dask.errors import ParameterError, SurveyError
from ppdf_dask.experiments import accuracy, labelled
from ppdf_dask.filters.cloud import cloud_from_grid, density
from ppdf_dask.metrics import Scores
from ppdf_dask.params import Parameters
from ppdf_dask.synthetic import SyntheticParams, points, write_survey


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two labelled tiles: one as it is, one whose ground is thinned to every tenth point."""
    place = tmp_path_factory.mktemp("labelled")
    params = SyntheticParams(density=2.0, low_noise=0.01)
    (tile,) = write_survey(place, params, extent=(0, 0, 90, 60), tile_size=90, classified=True)
    las = laspy.read(tile)
    las.user_data = (np.arange(len(las.points)) % 7 == 0).astype(np.uint8)
    las.write(place / "whole.laz")
    ground = np.flatnonzero(np.asarray(las.classification) == 2)
    classes = np.asarray(las.classification).copy()
    classes[ground[np.arange(len(ground)) % 10 != 0]] = 1
    las.classification = classes
    las.write(place / "thin.LAZ", do_compress=True)
    return place


def test_what_is_offered_and_scored(folder: Path) -> None:
    cloud = labelled.read(folder / "whole.laz", "user_data==0 and classification > 0")
    las = laspy.read(folder / "whole.laz")
    classes, number, total = (np.asarray(las[n]) for n in ("classification", "return_number", "number_of_returns"))
    assert np.array_equal(cloud.mm, np.round(las.xyz * 1000).astype(np.int64))
    assert np.array_equal(cloud.reference, classes == 2)
    assert np.array_equal(cloud.scored, np.asarray(las.user_data) == 0)
    assert (classes == 7).sum() > 10
    usable = ~np.isin(classes, [7, 9, 18])
    assert np.array_equal(cloud.usable, usable)
    assert np.array_equal(cloud.last, usable & (number == total))
    assert np.array_equal(labelled.read(folder / "whole.laz").scored, usable)


def test_a_filter_sees_the_returns_it_asks_for(folder: Path) -> None:
    cloud = labelled.read(folder / "whole.laz")
    for params in (filters.parameters("ppdf"), filters.parameters("ppdf", "paper")):
        seen = cloud.last if params.RETURNS == "last" else cloud.usable
        x, y, z = cloud.mm[seen].T
        offered = cloud_from_grid(x, y, z)
        chosen = filters.of(params)
        expected = np.zeros(cloud.n, bool)
        expected[seen] = chosen.classify(offered, chosen.resolve(params, density(offered))).ground
        assert np.array_equal(labelled.found_ground(cloud, params), expected)
    assert {filters.parameters("ppdf").RETURNS, filters.parameters("ppdf", "paper").RETURNS} == {"last", "all"}


def test_r30_by_hand() -> None:
    ground = [(0, 0, 0), (10_000, 0, 0), (0, 10_000, 0), (10_000, 10_000, 0)]
    other = [(5000, 5000, 299), (5000, 5000, -299), (5000, 5000, 300), (2000, 3000, 4000), (1000, 1000, 0)]
    mm = np.array([*ground, *other], np.int64)
    everything = np.ones(len(mm), bool)
    reference = np.arange(len(mm)) < len(ground)
    nothing = np.zeros(len(mm), bool)
    cloud = labelled.Labelled("hand", mm, reference, nothing, everything, everything)
    assert accuracy.r30_of(cloud) == 3 / 4
    noise_last = everything.copy()
    noise_last[-1] = False
    assert accuracy.r30_of(labelled.Labelled("hand", mm, reference, nothing, noise_last, everything)) == 2 / 4


def test_thinned_ground_is_seen_and_left_out_of_the_means(folder: Path) -> None:
    ran = CliRunner().invoke(group, ["benchmark", "accuracy", str(folder), "--score", "user_data==0", "--json"])
    assert ran.exit_code == 0, ran.output
    found = json.loads(ran.stdout)
    thin, whole = found["clouds"]
    assert (thin["cloud"], thin["thinned"], whole["cloud"], whole["thinned"]) == ("thin", True, "whole", False)
    assert thin["type_ii"] is None
    assert thin["kappa"] is None
    assert thin["type_i"] is not None
    assert found["complete"] == ["whole"]
    assert found["means"]["total"] == whole["total"]
    assert found["means"]["rmse"] == whole["rmse"]
    assert found["params"]["kind"] == "RobustParams"
    cloud = labelled.read(folder / "whole.laz", "user_data==0")
    expected = Scores.from_masks(
        cloud.reference, labelled.found_ground(cloud, filters.parameters("ppdf")), cloud.scored
    )
    assert {k: whole[k] for k in ("c", "d", "a", "b")} == {k: getattr(expected, k) for k in ("c", "d", "a", "b")}


def test_accuracy_table_and_options(folder: Path) -> None:
    options = ["--filter", "pmf", "--set", "threshold=nonsense"]
    ran = CliRunner().invoke(group, ["benchmark", "accuracy", str(folder), *options])
    assert isinstance(ran.exception, ParameterError)
    ran = CliRunner().invoke(group, ["benchmark", "accuracy", str(folder), "--filter", "pmf"])
    lines = ran.stdout.splitlines()
    assert [line.split("|")[1].strip() for line in lines[2:]] == ["whole", "mean of 1 complete", "thin"]
    assert len({len(line) for line in lines}) == 1
    assert "thinned" in lines[-1]


def test_means_weigh_clouds_alike() -> None:
    def row(name: str, r30: float, scores: Scores, rmse: float) -> accuracy.Accuracy:
        return accuracy.Accuracy(name, scores.n, scores.n, r30, scores, rmse)

    table = accuracy.AccuracyTable(
        Parameters(),
        (
            row("a", 0.0, Scores(10, 10, 1, 1), 0.1),
            row("b", 0.5, Scores(1000, 1000, 0, 0), math.nan),
            row("c", 0.51, Scores(10, 10, 10, 10), 9.0),
        ),
    )
    assert table.means()["total"] == pytest.approx(0.05)
    assert table.means()["rmse"] == pytest.approx(0.1)
    assert [r.cloud for r in table.complete] == ["a", "b"]


def test_unusable_data_is_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(SurveyError, match="holds no"):
        labelled.files_in(tmp_path)
    (tmp_path / "als").mkdir()
    (tmp_path / "als" / "broken.laz").write_bytes(b"LASF")
    assert labelled.files_in(tmp_path) == [tmp_path / "als" / "broken.laz"]
    with pytest.raises(SurveyError, match="broken"):
        labelled.read(tmp_path / "als" / "broken.laz")
    with pytest.raises(ParameterError, match="no dimension 'colour'"):
        labelled.read(folder / "whole.laz", "colour == 1")
    columns = points((0, 0, 20, 20), SyntheticParams(density=1.0))
    columns["classification"][:] = 1
    with pytest.raises(SurveyError, match="0 ground points"):
        accuracy.measure(labelled.from_points("bare", columns), filters.parameters("ppdf"))


def test_r30_of_the_labelled_clouds(data: Path) -> None:
    """The values of the clouds' own index."""
    expected = {"isprs_samp51": 0.00, "fontblanche_m30": 0.14, "lidR_topography": 0.84, "pyfor_test": 0.17}
    for name, r30 in expected.items():
        cloud = labelled.read(data / "als" / f"{name}.laz", "user_data==0")
        assert accuracy.r30_of(cloud) == pytest.approx(r30, abs=0.0051)
