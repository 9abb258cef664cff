"""The comparison of filters: the same numbers as by hand, fair tuning, tables that hold, figures with one scale."""

from __future__ import annotations

import csv
import functools
import io
import json
import math
import statistics

import laspy
import numpy as np
import pytest
from click.testing import CliRunner

from ppdf_dask import filters
from ppdf_dask.cli import group
from ppdf_dask.errors import ParameterError, SurveyError
from ppdf_dask.experiments import compare as study
from ppdf_dask.experiments import figures, tuning, workers
from ppdf_dask.experiments.compare import Comparison, cases, configured, site_files
from ppdf_dask.experiments.labelled import read
from ppdf_dask.experiments.rasters import read_raster
from ppdf_dask.experiments.reports import SIX, Report, csv_text
from ppdf_dask.experiments.tuning import GRIDS, Grid, grids, leave_one_out
from ppdf_dask.experiments.workers import Case, Row, raster_path
from ppdf_dask.grid import Rect
from ppdf_dask.metrics import Scores
from ppdf_dask.quarantine import Failure
from ppdf_dask.synthetic import SyntheticParams
from ppdf_dask.synthetic.tiles import write_tile

SMALL = Grid("smrf", "default", {"slope": (0.05, 0.15, 0.6), "threshold": (0.1, 0.5)})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three sites of 50 m x 50 m, from nearly flat to steep; a name that a spreadsheet would compute."""
    place = tmp_path_factory.mktemp("sites")
    for k, (name, slope) in enumerate((("a", 5.0), ("=b", 20.0), ("c|d", 35.0))):
        params = SyntheticParams(seed=k, density=2.0, slope=slope, relief_length=60.0, low_noise=0.005)
        write_tile(Rect(0, 0, 50_000, 50_000), params, [(place / f"{name}.laz", True)], "EPSG:25832")
    return place


@pytest.fixture(scope="module")
def found(folder, client, tmp_path_factory):
    out = tmp_path_factory.mktemp("study")
    asked = cases(["smrf", "ppdf", "msf"])
    return out, study.compare(client, site_files(folder), asked, out, grids=[SMALL])


def by_hand(path, params):
    """Read with laspy, classify in metres, count."""
    las = laspy.read(path)
    classes = np.asarray(las.classification)
    usable = ~np.isin(classes, [7, 18, 9])
    seen = usable & (np.asarray(las.return_number) >= np.asarray(las.number_of_returns))
    if params.RETURNS == "all":
        seen = usable
    mask = np.zeros(len(classes), bool)
    mask[seen] = filters.classify_ground(np.asarray(las.xyz)[seen], params)
    return Scores.from_masks(classes == 2, mask, usable)


def test_rows_are_what_one_gets_by_hand(folder, found):
    _, result = found
    assert result.failures == ()
    assert result.cases == (
        *("smrf default", "ppdf robust", "ppdf paper"),
        *("msf default", "msf paper", "msf paper-seeded"),
        "smrf tuned",
    )
    assert [s["site"] for s in result.sites] == ["=b", "a", "c|d"]
    for row in result.rows:
        assert row.scores == by_hand(folder / f"{row.site}.laz", row.case.params), row.case.name
        assert row.offered <= row.points == len(laspy.read(folder / f"{row.site}.laz").points)
        assert row.cpu > 0
        assert row.seconds > 0
    # the two profiles of PPDF see different returns
    offered = {row.case.name: row.offered for row in result.rows if row.site == "c|d"}
    assert offered["ppdf robust"] < offered["ppdf paper"]


def test_tuning_leaves_the_scored_site_out(folder, found):
    _, result = found
    choice = SMALL.candidates()
    totals = {s: [by_hand(folder / f"{s}.laz", p).total for p in choice] for s in ("=b", "a", "c|d")}
    for row in result.of("smrf tuned"):
        others = [v for name, v in totals.items() if name != row.site]
        means = [statistics.fmean(column) for column in zip(*others, strict=True)]
        assert means[choice.index(row.case.params)] == pytest.approx(min(means))
    # the sites differ so much that seeing the left-out site would change a choice
    everything = min(range(len(choice)), key=lambda k: sum(v[k] for v in totals.values()))
    assert any(row.case.params != choice[everything] for row in result.of("smrf tuned"))


def test_leave_one_out_never_looks_at_the_site_itself():
    base = {"a": [0.3, 0.2, 0.1], "b": [0.1, 0.2, 0.3], "c": [0.1, 0.1, 0.4]}
    chosen = leave_one_out(base)
    for name in base:
        changed = leave_one_out(base | {name: [9.0, 0.0, 5.0]})
        assert changed[name] == chosen[name]
    assert leave_one_out({"a": [0.1, 0.1], "b": [0.2, 0.2]}) == {"a": 0, "b": 0}
    with pytest.raises(ParameterError, match="at least two"):
        leave_one_out({"a": [0.1]})


@pytest.mark.parametrize("grid", GRIDS, ids=lambda g: f"{g.filter} {g.name}")
def test_each_grid_holds_the_profile_it_starts_from(grid):
    choice = grid.candidates()
    assert filters.parameters(grid.filter, grid.profile) in choice
    assert len(set(map(repr, choice))) == len(choice) <= 18
    assert grid.name not in filters.get(grid.filter).profiles


def test_every_filter_of_this_package_has_a_grid():
    assert set(filters.names()) == {g.filter for g in GRIDS}
    assert [g.name for g in grids(["smrf", "ppdf"])] == ["tuned", "tuned", "paper-tuned"]


def test_terrain_models_and_their_errors(found):
    out, result = found
    for row in result.rows:
        reference = read_raster(raster_path(out, row.site, "reference")).astype(float)
        dtm = read_raster(raster_path(out, row.site, row.case.name)).astype(float)
        pairs = [(a, b) for a, b in zip(dtm.ravel(), reference.ravel(), strict=True) if not math.isnan(b)]
        both = [a - b for a, b in pairs if not math.isnan(a)]
        # float32 heights of some hundred metres differ by less than 1e-4 from their sums
        assert row.rmse == pytest.approx(math.sqrt(sum(e * e for e in both) / len(both)), abs=1e-4)
        assert row.missing == pytest.approx(1 - len(both) / len(pairs))
    strict = next(row for row in result.of("msf paper") if row.site == "c|d")
    assert strict.missing > 0.1  # the strict rule loses the slope, and the table says so


def test_cases_follow_the_profiles():
    assert [c.name for c in cases(["smrf", "csf"], ["paper"])] == ["csf paper", "csf paper-smooth"]
    assert [c.name for c in cases(["pmf"], ["all"])] == ["pmf default", "pmf paper", "pmf paper-points", "pmf pdal"]
    assert {c.filter for c in cases(["all"])} == set(filters.names())
    assert len(cases(["smrf", "all", "smrf"])) == len(cases(["all"]))
    with pytest.raises(ParameterError, match="no filter has a profile papr"):
        cases(["pmf"], ["papr"])
    with pytest.raises(ParameterError, match="no filter 'x'"):
        cases(["x"])


def test_parameters_come_from_a_file(tmp_path):
    path = tmp_path / "params.toml"
    path.write_text('[smrf.steep]\nslope = 0.3\n[msf.mine]\nprofile = "paper"\ncell = 2.0\n')
    steep, mine = configured(path)
    assert (steep.name, steep.params.slope, mine.params.variant, mine.params.cell) == ("smrf steep", 0.3, "strict", 2.0)
    for text, words in (
        ("[smrf.steep]\nslop = 1.0\n", r"\[smrf.steep\].*no parameter 'slop'"),
        ("[smrf]\nslope = 1.0\n", r"tables \[FILTER.NAME\]"),
        ("smrf = 1\n", r"tables \[FILTER.NAME\]"),
        ("[smurf.a]\n", "no filter 'smurf'"),
        ("[", "not a readable TOML"),
    ):
        path.write_text(text)
        with pytest.raises(ParameterError, match=words):
            configured(path)


def test_what_cannot_be_done_is_named_and_the_rest_stands(folder, client, tmp_path, monkeypatch):
    from ppdf_dask.errors import PpdfError

    real = workers.found_ground

    def sometimes(cloud, params):
        if cloud.name == "a" and params == filters.parameters("msf"):
            raise PpdfError("a bad day")
        return real(cloud, params)

    monkeypatch.setattr(workers, "found_ground", sometimes)
    grid = Grid("msf", "default", {"slope": (20.0, 30.0)})
    result = study.compare(client, site_files(folder), cases(["msf"], ["default"]), tmp_path, grids=[grid])
    assert [(f.stage, f.error) for f in result.failures] == [("tune", "a bad day"), ("compare", "a bad day")]
    assert [(r.case.name, r.site) for r in result.rows] == [("msf default", "=b"), ("msf default", "c|d")]
    text = Report(result).markdown()
    assert "- compare a-msf-default: a bad day" in text
    assert [cell.strip() for cell in Report(result).summary().splitlines()[2].split("|")][1:3] == ["msf default", "2"]


def test_a_site_without_reference_stops_the_study(folder, client, tmp_path):
    with pytest.raises(SurveyError, match="a has 0 ground points"):
        study.measure_sites(client, site_files(folder, "user_data==1")[1:2], tmp_path)
    with pytest.raises(ParameterError, match="no filter was chosen"):
        study.compare(client, site_files(folder), [], tmp_path)
    with pytest.raises(ParameterError, match="at least two"):
        study.compare(client, site_files(folder)[:1], [], tmp_path, grids=[SMALL])


def made(values):
    """A comparison of known counts: (case, site) to (a, b) of 1000 ground and 2000 other points."""
    params = filters.parameters("smrf")
    rows = tuple(
        Row(site, Case(*case.split(), params), Scores(1000, 2000, a, b), 0.5, 0.25, 3000, 2000, 2.0, 1.0)
        for (case, site), (a, b) in values.items()
    )
    names = dict.fromkeys(site for _, site in values)
    sites = tuple(
        {"site": n, "rect": (0, 0, 9, 9), "points": 1, "density": 1.0, "ground": 1, "slope_deg": 1.0, "cover": 0.1,
         "canopy_height_m": math.nan} for n in names
    )  # fmt: skip
    return Comparison(sites, rows, (Failure("compare", "x", "why", ""),))


def test_the_tables_hold_means_deviations_and_every_site():
    result = made({("smrf x", "a"): (0, 15), ("smrf x", "b|c"): (60, 30), ("msf y", "a"): (30, 0)})
    report = Report(result, "A remark.")
    lines = report.summary().splitlines()
    totals = [100 * 15 / 3000, 100 * 90 / 3000]
    cells = [c.strip() for c in lines[2].split(" | ")]
    assert cells[0] == "| smrf x"
    assert cells[1] == "2"
    assert cells[2] == f"{statistics.mean(totals):.2f} ± {statistics.stdev(totals):.2f}"
    assert cells[3] == f"3.00 ± {statistics.stdev([0.0, 6.0]):.2f}"
    assert cells[-1].startswith("0.002")  # 4000 points seen in 2 s
    assert "1.00 ± -" in lines[3]  # one site has no deviation
    text = report.markdown()
    assert "A remark." in text
    assert all(line.replace("\\|", "").count("|") == lines[0].count("|") for line in lines)
    assert "| msf y  | 1.00 |    - |" in text
    back = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert back["cases"][0]["total"] == pytest.approx(
        {"mean": statistics.mean(totals) / 100, "std": statistics.stdev(totals) / 100, "n": 2}
    )
    assert back["cases"][0]["pooled"]["total"] == pytest.approx(105 / 6000)
    assert back["rows"][1]["params"]["slope"] == 0.15
    assert back["sites"][0]["canopy_height_m"] is None


def test_csv_runs_no_formula():
    result = made({("smrf x", "=HYPERLINK(1)"): (900, 2000), ("smrf x", '@a,"b'): (0, 0)})
    first, second = csv.DictReader(io.StringIO(Report(result).csv()))
    assert first["site"] == "'=HYPERLINK(1)"
    assert second["site"] == "'@a,\"b"
    assert float(first["kappa"]) < 0  # a negative number stays a number
    assert [int(first[k]) for k in "cdab"] == [1000, 2000, 900, 2000]
    for start in ("=", "+", "-", "@", "\t=", " =", "\r+", "\n-"):
        (row,) = csv.reader(io.StringIO(csv_text([f"{start}1"], [])))
        assert row == ["'" + start.replace("\t", " ").replace("\r", " ").replace("\n", " ") + "1"]


def test_figures_share_one_scale(found):
    out, result = found
    panels = [a for a in figures.terrain_figure(result, out, "c|d").axes if a.images]
    assert [a.get_title() for a in panels] == ["reference", *result.cases]
    assert len({a.images[0].get_clim() for a in panels}) == 1
    assert {a.get_xlim() + a.get_ylim() for a in panels} == {(0.0, 50.0, 0.0, 50.0)}
    panels = [a for a in figures.difference_figure(result, out, "c|d").axes if a.images]
    ((low, high),) = {a.images[0].get_clim() for a in panels}
    assert low == -high <= -0.5
    drawn = panels[0].images[0].get_array().filled(np.nan)
    wanted = read_raster(raster_path(out, "c|d", "smrf default")) - read_raster(raster_path(out, "c|d", "reference"))
    assert np.array_equal(drawn, wanted, equal_nan=True)
    for layer in figures.LAYERS:
        panels = [a for a in figures.site_figure(result.sites, out, layer).axes if a.images]
        assert len(panels) == 3
        assert len({a.images[0].get_clim() for a in panels}) == 1


def test_error_figure_draws_each_site_and_the_mean(found):
    _, result = found
    figure = figures.errors_figure(result)
    assert [a.get_title() for a in figure.axes] == ["total %", "type I %", "type II %", "kappa %", "precision %"]
    axes = figure.axes[0]
    bars = [bar.get_width() for bar in axes.patches]
    means = [100 * statistics.fmean(r.scores.total for r in result.of(case)) for case in result.cases]
    assert bars == pytest.approx(means)
    times = figures.runtime_figure(result).axes[0]
    drawn = {float(line.get_xdata()[0]) for line in times.lines if len(line.get_xdata()) == 1}
    assert {row.cpu for row in result.rows} <= drawn


def test_command_writes_everything(folder, client, tmp_path, monkeypatch):
    monkeypatch.setattr(tuning, "GRIDS", (SMALL,))
    config = tmp_path / "params.toml"
    config.write_text("[pmf.wide]\nwindow = 50.0\n")
    words = [
        "compare",
        str(folder),
        "--filters",
        "smrf",
        "--tune",
        "--config",
        str(config),
        "--out",
        str(tmp_path / "o"),
    ]
    shown = CliRunner().invoke(group, [*words, "--quiet", "--json", "--scheduler", client.scheduler.address])
    assert shown.exit_code == 0, shown.output
    values = json.loads(shown.stdout)
    assert [c["case"] for c in values["cases"]] == ["smrf default", "pmf wide", "smrf tuned"]
    assert values == json.loads((tmp_path / "o" / "compare.json").read_text())
    assert "chosen on the others" in (tmp_path / "o" / "compare.md").read_text()
    assert len((tmp_path / "o" / "compare.csv").read_text().splitlines()) == 1 + 3 * 3
    for name in ("errors", "runtime", "terrain-a", "difference-=b", "sites-slope", "sites-cover", "sites-chm"):
        for suffix in ("png", "svg"):
            assert (tmp_path / "o" / "figures" / f"{name}.{suffix}").stat().st_size > 1000
    again = CliRunner().invoke(group, ["compare", str(folder), "--filters", "smrf,", "--profiles", "papr"])
    assert isinstance(again.exception, ParameterError)
    nowhere = CliRunner().invoke(group, ["compare", str(tmp_path / "none"), "--filters", "smrf"])
    assert "is no folder" in str(nowhere.exception)


def test_sites_command_measures_the_six_sites(client, tmp_path, monkeypatch):
    from ppdf_dask import synthetic

    two = synthetic.six_sites()[1:3]
    monkeypatch.setattr(synthetic, "six_sites", lambda: two)
    words = ["sites", "six-sites", "--quiet", "--scheduler", client.scheduler.address, "--out", str(tmp_path)]
    words += ["--site-size", "30"]
    shown = CliRunner().invoke(group, words)
    assert shown.exit_code == 0, shown.output
    assert shown.stdout.splitlines()[2].startswith("| 2-valleys |")
    assert SIX in (tmp_path / "sites.md").read_text()
    assert "not public" in SIX
    first = (tmp_path / "six-sites-30m" / "2-valleys.laz").stat().st_mtime_ns
    table = json.loads((tmp_path / "sites.json").read_text())["sites"]
    assert [s["site"] for s in table] == ["2-valleys", "3-ridges"]
    assert table[0]["points"] == read(tmp_path / "six-sites-30m" / "2-valleys.laz").usable.sum()
    assert (tmp_path / "rasters" / "2-valleys" / "chm.tif").is_file()
    assert CliRunner().invoke(group, [*words, "--json"]).exit_code == 0
    assert (tmp_path / "six-sites-30m" / "2-valleys.laz").stat().st_mtime_ns == first


def test_terrestrial_is_passed_on(tmp_path, monkeypatch):
    from ppdf_dask import synthetic
    from ppdf_dask.experiments import terrestrial
    from ppdf_dask.experiments.terrestrial import KINDS, METHODS, ThesisTable, Tuned

    def table(seeds, *, tuning_seed):
        rows = [Tuned(kind, m, METHODS[m](), Scores(1000, 2000, 0, 15)) for kind in KINDS for m in METHODS]
        return ThesisTable(tuple(rows), tuning_seed, tuple(seeds))

    small = functools.partial(synthetic.terrestrial_plot, edge=6.0, density=40.0)
    monkeypatch.setattr(synthetic, "terrestrial_plot", small)
    monkeypatch.setattr(terrestrial, "thesis_table", table)
    words = ["compare", "terrestrial", "--seeds", "4,5", "--tuning-seed", "6", "--out", str(tmp_path)]
    shown = CliRunner().invoke(group, words)
    assert shown.exit_code == 0, shown.output
    assert "98.52" in shown.stdout
    values = json.loads((tmp_path / "terrestrial.json").read_text())
    assert (values["seeds"], values["tuning_seed"]) == ([4, 5], 6)
    lines = list(csv.DictReader(io.StringIO((tmp_path / "terrestrial.csv").read_text())))
    assert len(lines) == 5 * 2
    assert float(lines[0]["kappa"]) == pytest.approx(98.88, abs=0.005)
    assert (tmp_path / "figures" / "terrestrial.svg").is_file()
    assert all((tmp_path / "figures" / f"terrestrial-{kind}-removed.png").is_file() for kind in KINDS)
    bad = CliRunner().invoke(group, ["compare", "terrestrial", "--seeds", "4,x"])
    assert "whole numbers" in str(bad.exception)
