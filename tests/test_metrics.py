"""Metrics: the test vectors of the specification, definitions at the edges, files that disagree."""

from __future__ import annotations

import math
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask.errors import ParameterError, SurveyError
from ppdf_dask.evaluate import evaluate, parse_score
from ppdf_dask.metrics import Scores, mean_std, pooled, tin_rmse

masks = st.integers(1, 60).flatmap(
    lambda n: st.tuples(*[st.lists(st.booleans(), min_size=n, max_size=n).map(lambda v: np.array(v)) for _ in range(3)])
)


def percent(scores: Scores, *names: str) -> list[float]:
    return [round(100 * getattr(scores, name), 2) for name in names]


def test_vectors_of_the_thesis_table() -> None:
    names = ("type_i", "type_ii", "total", "precision", "kappa")
    assert percent(Scores(1000, 2000, 0, 15), *names) == [0.0, 0.75, 0.50, 98.52, 98.88]
    assert percent(Scores(2232, 7768, 287, 287), *names) == [12.86, 3.69, 5.74, 87.14, 83.45]


@given(masks)
@settings(max_examples=60)
def test_counts_and_rates_follow_from_the_points(three: tuple[np.ndarray, ...]) -> None:
    reference, found, score = three
    s = Scores.from_masks(reference, found, score)
    cells = {(r, f): 0 for r in (True, False) for f in (True, False)}
    for r, f, u in zip(reference.tolist(), found.tolist(), score.tolist(), strict=True):
        cells[r, f] += u
    tp, fn, fp, tn = cells[True, True], cells[True, False], cells[False, True], cells[False, False]
    assert (s.c, s.d, s.a, s.b) == (tp + fn, fp + tn, fn, fp)

    def ratio(part: float, whole: float) -> float:
        return part / whole if whole else math.nan

    expected = {
        "type_i": ratio(fn, tp + fn),
        "type_ii": ratio(fp, fp + tn),
        "total": ratio(fn + fp, tp + fn + fp + tn),
        "oa": ratio(tp + tn, tp + fn + fp + tn),
        "precision": ratio(tp, tp + fp),
        "recall": ratio(tp, tp + fn),
        "f1": ratio(tp, tp + (fn + fp) / 2),
        "iou_ground": ratio(tp, tp + fn + fp),
        "iou_non_ground": ratio(tn, tn + fn + fp),
    }
    for name, value in expected.items():
        assert getattr(s, name) == pytest.approx(value, nan_ok=True), name
    n = tp + fn + fp + tn
    if n:
        po, pe = (tp + tn) / n, ((tp + fn) * (tp + fp) + (fp + tn) * (fn + tn)) / n**2
        assert s.kappa == pytest.approx((po - pe) / (1 - pe) if pe < 1 else 1.0, abs=1e-9)


def test_empty_denominators() -> None:
    nothing = Scores(0, 0, 0, 0)
    assert all(math.isnan(getattr(nothing, name)) for name in Scores.RATES)
    only_ground = Scores(5, 0, 0, 0)
    assert only_ground.kappa == 1.0
    assert math.isnan(only_ground.type_ii)
    assert math.isnan(only_ground.iou_non_ground)
    assert Scores(0, 5, 0, 0).kappa == 1.0
    assert Scores(5, 0, 5, 0).kappa == 0.0


def test_contradicting_counts_and_masks_are_refused() -> None:
    with pytest.raises(ParameterError, match="a <= c"):
        Scores(1, 1, 2, 0)
    with pytest.raises(ParameterError, match="must be the same"):
        Scores.from_masks([True], [True, False])
    with pytest.raises(ParameterError, match="boolean"):
        Scores.from_masks([2], [True])


def test_mean_std_skips_undefined_sites_and_pooled_adds_counts() -> None:
    sites = [Scores(10, 10, 1, 0), Scores(10, 0, 3, 0), Scores(30, 10, 3, 5)]
    table = mean_std(sites)
    assert table["type_ii"].n == 2
    assert table["type_ii"].mean == pytest.approx(0.25)
    assert table["type_ii"].std == pytest.approx(0.5 / math.sqrt(2))
    assert table["type_i"].n == 3
    assert pooled(sites) == Scores(50, 20, 7, 5)
    assert math.isnan(mean_std(sites[:1])["total"].std)


def test_tin_rmse_of_a_shifted_plane_at_map_coordinates() -> None:
    rng = np.random.default_rng(5)
    xy = rng.uniform(0, 100, (500, 2)).round(3) + np.array([512_000.0, 5_400_000.0])
    z = 0.3 * (xy[:, 0] - 512_000) + 200
    plane = np.column_stack([xy, z])
    inside = plane[np.all(np.abs(xy - [512_050.0, 5_400_050.0]) < 40, axis=1)]
    assert tin_rmse(plane, inside) == pytest.approx(0.0, abs=1e-9)
    # heights of a linear TIN over a plane are exact but for rounding, so the shift is what is left
    assert tin_rmse(plane + np.array([0, 0, 0.25]), inside) == pytest.approx(0.25, abs=1e-9)


def test_tin_rmse_takes_the_lowest_of_equal_places_and_the_nearest_outside() -> None:
    square = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, 1.0, 9.0)]
    assert tin_rmse(square, [(1.0, 1.0, 0.0)]) == 0.0
    assert tin_rmse([(0.0, 0.0, 1.0), (0.0, 2.0, 5.0)], [(3.0, 1.9, 5.0)]) == 0.0
    assert tin_rmse([(i, i, i) for i in range(9)], [(20.0, 20.0, 8.0)]) == 0.0
    assert math.isnan(tin_rmse(np.empty((0, 3)), square))
    with pytest.raises(ParameterError, match="NaN"):
        tin_rmse([(0.0, 0.0, math.nan)], square)


@pytest.mark.parametrize(
    "text", ["", "user_data", "user_data=0", "__import__('os')", "x==1 or y==2", "x==1 and", "x == y", "x==1;y==2"]
)
def test_score_expressions_that_are_not_comparisons_are_refused(text: str) -> None:
    with pytest.raises(ParameterError, match="not a comparison"):
        parse_score(text)


def write(path: Path, xyz: np.ndarray, classes: np.ndarray, user_data: np.ndarray) -> Path:
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.header.scales = [0.001] * 3
    las.header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
    las.x, las.y, las.z = xyz.T
    las.classification = classes
    las.user_data = user_data
    las.write(path)
    return path


@pytest.fixture
def cloud() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    xyz = rng.uniform(0, 50, (400, 3)).round(3) + np.array([500_000, 5_400_000, 0])
    classes = np.where(rng.random(400) < 0.5, 2, 5).astype(np.uint8)
    return xyz, classes, (np.arange(400) % 3 == 0).astype(np.uint8)


def test_evaluate_counts_only_what_is_to_be_scored(
    tmp_path: Path, cloud: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    xyz, classes, user = cloud
    found = classes.copy()
    found[:30] = 2
    found[30:50] = 1
    reference = write(tmp_path / "ref.laz", xyz, classes, user)
    classified = write(tmp_path / "got.laz", xyz, found, np.zeros_like(user))
    e = evaluate(reference, classified, "user_data == 0")
    assert e.scores == Scores.from_masks(classes == 2, found == 2, user == 0)
    assert (e.scored, e.left_out) == (int((user == 0).sum()), int((user == 1).sum()))
    assert e.dtm_rmse == pytest.approx(tin_rmse(xyz[found == 2], xyz[(classes == 2) & (user == 0)]))
    assert evaluate(reference, classified).scored == 400
    perfect = evaluate(reference, reference)
    assert (perfect.scores.total, perfect.scores.kappa) == (0.0, 1.0)
    assert perfect.dtm_rmse == pytest.approx(0.0, abs=1e-9)
    assert evaluate(reference, write(tmp_path / "five.laz", xyz, 7 - classes, user), ground_class=5).scores.total == 0.0


def test_evaluate_refuses_files_that_do_not_belong_together(
    tmp_path: Path, cloud: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> None:
    xyz, classes, user = cloud
    reference = write(tmp_path / "ref.laz", xyz, classes, user)
    with pytest.raises(SurveyError, match=r"400 points and .*short\.laz 399"):
        evaluate(reference, write(tmp_path / "short.laz", xyz[1:], classes[1:], user[1:]))
    moved = xyz.copy()
    moved[7, 1] += 0.002
    with pytest.raises(SurveyError, match="point 7 "):
        evaluate(reference, write(tmp_path / "moved.laz", moved, classes, user))
    with pytest.raises(ParameterError, match=r"no dimension 'mood'.*user_data"):
        evaluate(reference, reference, "mood==1")
    with pytest.raises(SurveyError, match="does not exist"):
        evaluate(reference, tmp_path / "none.laz")
    (tmp_path / "bad.laz").write_bytes(b"not a point cloud")
    with pytest.raises(SurveyError, match=r"bad\.laz cannot be read"):
        evaluate(reference, tmp_path / "bad.laz")
    torn = tmp_path / "torn.laz"
    whole = reference.read_bytes()
    torn.write_bytes(whole[:900] + bytes(400) + whole[1300:])
    with pytest.raises(SurveyError, match=r"torn\.laz"):
        evaluate(reference, torn)


def test_evaluate_of_empty_files_is_undefined_not_an_error(tmp_path: Path) -> None:
    nothing = np.empty((0, 3))
    empty = write(tmp_path / "empty.laz", nothing, np.empty(0, np.uint8), np.empty(0, np.uint8))
    e = evaluate(empty, empty)
    assert e.scored == 0
    assert e.as_dict()["kappa"] is None
