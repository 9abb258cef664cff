"""The paper's experiments as commands: what is varied, what is counted, what is written."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ppdf_dask.cli import group
from ppdf_dask.errors import ParameterError, SurveyError
from ppdf_dask.experiments import ablation, labelled, outliers, raised, sensitivity, stages, thinning
from ppdf_dask.experiments.variants import Trials, Variant, score
from ppdf_dask.filters.ppdf.paper.params import PaperParams
from ppdf_dask.filters.ppdf.robust.params import RobustParams
from ppdf_dask.metrics import Scores
from ppdf_dask.synthetic import SyntheticParams, points, write_survey

LAND = SyntheticParams(density=1.5, water="none")


@pytest.fixture(scope="module")
def tile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("studies")
    return write_survey(place, LAND, extent=(0, 0, 60, 60), tile_size=60, classified=True)[0]


@pytest.fixture(scope="module")
def cloud() -> labelled.Labelled:
    return labelled.from_points("wood", points((0, 0, 60, 60), LAND))


def run(*args: str | Path) -> str:
    ran = CliRunner().invoke(group, [str(a) for a in args])
    assert ran.exit_code == 0, ran.output
    return ran.stdout


def test_the_ablation_changes_what_its_names_say() -> None:
    both, planes, quadrants = (v.params for v in ablation.paper_variants())
    assert both == PaperParams()
    assert planes == PaperParams(neighbours="nearest")
    assert quadrants == PaperParams(seeds="local_minimum")
    base, *others = ablation.robust_variants()
    assert base.params == RobustParams()
    assert len({v.params.fingerprint() for v in (base, *others)}) == 1 + len(others)
    for step in RobustParams().steps:
        (variant,) = [v for v in others if v.name == f"without {step}"]
        assert variant.params.steps == tuple(s for s in RobustParams().steps if s != step)


def test_ablation_command(tile: Path, cloud: labelled.Labelled, tmp_path: Path) -> None:
    found = json.loads(run("ablation", tile, "--json", "--plot", tmp_path / "figure16.png"))
    assert [v["name"] for v in found["variants"]] == ["both contributions", "only plane seeds", "only quadrants"]
    for variant, entry in zip(ablation.paper_variants(), found["variants"], strict=True):
        expected = score(cloud, variant.params)
        assert {k: entry["scores"][0][k] for k in "cdab"} == {k: getattr(expected, k) for k in "cdab"}
    assert (tmp_path / "figure16.png").stat().st_size > 1000
    assert (tmp_path / "figure16.svg").read_text().lstrip().startswith("<?xml")


def test_robust_ablation_draws_changes_against_the_default(cloud: labelled.Labelled) -> None:
    variants = ablation.robust_variants()[:3]
    rows = ((Scores(100, 100, 5, 5), Scores(100, 100, 10, 4), Scores(100, 100, 0, 6)),)
    axes = ablation.robust_figure(Trials(variants, ("a",), rows))
    assert [round(bar.get_width(), 9) for bar in axes.patches] == [2.0, -2.0]
    assert [t.get_text() for t in axes.get_yticklabels()] == [v.name for v in variants[1:]]


def test_sensitivity_tries_each_value_alone(tile: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for profile, base in (("paper", PaperParams()), ("robust", RobustParams())):
        values = sensitivity.RANGES[profile]
        assert set(values) <= {f.name for f in fields(base)}
        for variant in sensitivity.variants_of(base, values)[1:]:
            changed = [f.name for f in fields(base) if getattr(variant.params, f.name) != getattr(base, f.name)]
            assert len(changed) <= 1
    few = {
        "plane_size": (10, 20),
        "min_inliers": (20,),
        "division_distance": (1,),
        "classification_distance": (0.5, 1.5),
    }
    monkeypatch.setitem(sensitivity.RANGES, "paper", few)
    found = json.loads(run("sensitivity", tile, "--json", "--plot", tmp_path / "f17"))["parameters"]
    default = found["plane_size"]["total"][0][0]
    # The default value gives the default's error wherever it is tried.
    assert found["min_inliers"]["total"] == found["division_distance"]["total"] == [[default]]
    assert found["classification_distance"]["total"][0][1] == default
    assert found["classification_distance"]["total"][0][0] != default
    assert (tmp_path / "f17.svg").exists()
    monkeypatch.setitem(sensitivity.RANGES, "robust", {"cell_size": (2,), "inlier_share": (0.5,), "tolerance": (0.2,)})
    found = json.loads(run("sensitivity", tile, "--profile", "robust", "--json", "--plot", tmp_path / "odd"))[
        "parameters"
    ]
    assert len(found) == 3
    assert (tmp_path / "odd.svg").exists()


def test_stages_command(tile: Path, cloud: labelled.Labelled, tmp_path: Path) -> None:
    (found,) = json.loads(run("stages", tile, "--json", "--plot", tmp_path / "steps"))
    groups = {name: entry["points"] for name, entry in found["groups"].items()}
    assert found["points"] == int(cloud.usable.sum()) >= groups["under canopy"] >= groups["seeds from planes"] > 0
    assert groups["ground"] > groups["seeds from planes"]
    # A 60 m square has 36 windows of 10 m.
    assert groups["seeds from local minima"] == 36
    assert sum(found["planes_by_size_m"].values()) > 0
    assert (tmp_path / f"steps-{tile.stem}.png").exists()
    study = stages.study(cloud)
    extra = study.only_quadrants
    assert groups["found only thanks to quadrants"] == int(extra.sum())
    assert not (extra & study.nearest.ground).any()
    assert not (extra & ~study.both.ground).any()


def test_stages_without_labels_say_nothing_about_truth(cloud: labelled.Labelled) -> None:
    bare = labelled.Labelled("bare", cloud.mm, np.zeros(cloud.n, bool), cloud.scored, cloud.usable, cloud.last)
    study = stages.study(bare)
    assert all(entry["truly_ground"] is None for entry in study.as_dict()["groups"].values())
    assert len(stages.only_quadrants(study).collections) == 2


@pytest.mark.parametrize("group_size", [1, 4])
def test_injected_outliers_lie_deep_and_together(cloud: labelled.Labelled, group_size: int) -> None:
    dirty = outliers.inject(cloud, group_size, share=0.01, seed=3)
    added = dirty.mm[cloud.n :].reshape(-1, group_size, 3)
    assert len(added) == round(0.01 * cloud.usable.sum() / group_size)
    assert np.array_equal(dirty.mm[: cloud.n], cloud.mm)
    assert np.abs(added - added[:, :1]).max() <= 500
    ground = cloud.mm[cloud.reference]
    for first in added[:, 0]:
        above = ground[(ground[:, :2] == first[:2]).all(axis=1), 2]
        assert ((above - first[2] >= 2000) & (above - first[2] <= 15_000)).any()
    assert not dirty.scored[cloud.n :].any()
    assert dirty.last[cloud.n :].all()
    assert np.array_equal(outliers.inject(cloud, group_size, share=0.01, seed=3).mm, dirty.mm)
    assert not np.array_equal(outliers.inject(cloud, group_size, share=0.01, seed=4).mm, dirty.mm)


def test_outliers_count_their_own_and_the_clouds_points_apart(cloud: labelled.Labelled) -> None:
    (single, four) = outliers.injections(cloud, [Variant("robust", RobustParams())]).rows
    assert (single.group, four.group) == (1, 4)
    assert single.before == four.before == score(cloud, RobustParams())
    assert single.after.n == single.before.n
    assert 0 <= single.accepted <= single.outliers
    with pytest.raises(ParameterError, match="group = 0"):
        outliers.inject(cloud, 0)


def test_outliers_command(tile: Path, tmp_path: Path) -> None:
    found = json.loads(run("outliers", tile, "--filter", "pmf", "--share", "0.002", "--json", "--plot", tmp_path / "o"))
    assert [(r["variant"], r["group"]) for r in found["rows"]] == [
        (name, g) for name in ("ppdf:robust", "ppdf:paper", "pmf:default") for g in (1, 4)
    ]
    assert (tmp_path / "o.png").exists()


def test_raised_terrain_is_scored_apart() -> None:
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0, 60_000, 1000), np.arange(0, 60_000, 1000)))
    ridge = np.maximum(0, 8000 - np.abs(x - 30_000))
    mm = np.column_stack([np.append(x, 500), np.append(y, 500), np.append(ridge, 9000)])
    ground = np.append(np.ones(len(x), bool), False)
    whole = np.ones(len(mm), bool)
    made = labelled.Labelled("ridge", mm, ground, whole, whole, whole)
    (row,) = raised.raised_table(made, [Variant("paper", PaperParams())]).rows
    on_top = np.abs(x - 30_000) < 5000
    assert (row.raised, row.other) == (int(on_top.sum()), int((~on_top).sum()))
    total = score(made, PaperParams())
    assert row.raised_missed + row.other_missed == total.a
    flat = raised.raised_ground(labelled.Labelled("flat", mm * [1, 1, 0], ground, whole, whole, whole))
    assert not flat.any()


def test_raised_command(tile: Path, tmp_path: Path) -> None:
    text = run("raised", tile, "--plot", tmp_path / "r")
    assert all(name in text for name in ("ppdf:robust", "ppdf:paper", "only plane seeds", "only quadrants"))
    assert (tmp_path / "r.svg").exists()


def test_runtime_against_density(tile: Path, cloud: labelled.Labelled, tmp_path: Path) -> None:
    options = ["--steps", "2", "--repeat", "1", "--filter", "ppdf", "--json", "--plot", tmp_path / "d"]
    dense, thin = json.loads(run("benchmark", "density", tile, *options))["rows"]
    assert dense["points"] == int(cloud.last.sum())
    # Half the points, within six standard deviations of a binomial.
    assert abs(thin["points"] - dense["points"] / 2) < 3 * dense["points"] ** 0.5
    assert dense["us_per_point"] == pytest.approx(1e6 * dense["seconds"] / dense["points"])
    assert (tmp_path / "d.png").exists()
    kept = {tuple(p) for p in thinning.thinned(cloud, 1).mm.tolist()}
    assert {tuple(p) for p in thinning.thinned(cloud, 3).mm.tolist()} <= kept
    with pytest.raises(ParameterError, match="take fewer"):
        thinning.runtimes(cloud, [Variant("robust", RobustParams())], halvings=12, repeat=1)


def test_without_clouds_the_six_sites_are_taken() -> None:
    from ppdf_dask.cli.show import sources

    loaders = sources((), None, 20.0)
    assert len(loaders) == 6
    small = loaders[5]().check()
    assert small.name == "6-breaklines"
    assert np.ptp(small.mm[:, 0]) < 20_000


def test_a_cloud_without_labels_is_refused_where_labels_are_needed(tmp_path: Path) -> None:
    tiles = write_survey(tmp_path, LAND, extent=(0, 0, 30, 30), tile_size=30, truth=False)
    ran = CliRunner().invoke(group, ["ablation", str(tiles[0])])
    assert isinstance(ran.exception, SurveyError)
    assert "class 2" in str(ran.exception)
