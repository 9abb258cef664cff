"""The clocks of the benchmark: what they count, and that nothing stays wrapped; no test depends on a time."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ppdf_dask import filters
from ppdf_dask.cli import group
from ppdf_dask.errors import ParameterError, PpdfError
from ppdf_dask.experiments import clock, speed
from ppdf_dask.filters.cloud import cloud_from_xyz, density
from ppdf_dask.synthetic import SyntheticParams, write_survey


@pytest.fixture(scope="module")
def tile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("speed")
    return write_survey(folder, SyntheticParams(density=2.0), extent=(0, 0, 60, 60), tile_size=60, truth=False)[0]


def hillside() -> np.ndarray:
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0, 40, 0.8), np.arange(0, 40, 0.8)))
    return np.column_stack([x, y, 0.2 * x + 0.05 * (x * y % 3)])


@pytest.mark.parametrize("name", ["ppdf:robust", "ppdf:paper"])
def test_stages_exist_are_all_seen_and_change_nothing(name: str) -> None:
    (choice,) = speed.Choice.of(name)
    cloud = cloud_from_xyz(hillside())
    params = filters.of(choice.params).resolve(choice.params, density(cloud))
    targets = clock.STAGES[type(params).__name__]
    before = {t: getattr(import_module(t.split(":")[0]), t.split(":")[1]) for t in targets}
    plain = filters.of(params).classify(cloud, params)
    with clock.recorded(params, memory=True) as record:
        found = filters.of(params).classify(cloud, params)
    assert np.array_equal(found.ground, plain.ground)
    assert set(record.seconds) <= set(targets.values())
    assert len(record.seconds) >= 4
    assert set(record.peak) == set(record.seconds)
    assert all(held > 0 for held in record.peak.values())
    assert before == {t: getattr(import_module(t.split(":")[0]), t.split(":")[1]) for t in targets}


def test_a_filter_without_known_stages_has_none() -> None:
    with clock.recorded(filters.parameters("pmf")) as record:
        filters.classify_ground(hillside(), "pmf")
    assert record.seconds == {}


def test_processor_time_counts_child_processes() -> None:
    start = clock.processor_time()
    subprocess.run([sys.executable, "-c", "sum(i * i for i in range(3_000_000))"], check=True)
    # The interpreter alone takes some milliseconds; the sum about a hundred.
    assert clock.processor_time() - start > 0.02


def test_rounds_are_interleaved_and_medians_per_name() -> None:
    seen: list[str] = []
    steps = list(clock.interleaved({"a": lambda: seen.append("a"), "b": lambda: seen.append("b")}, 3))
    assert seen == ["a", "b"] * 3
    times = clock.timings(steps)
    assert list(times) == ["a", "b"]
    assert times["a"].seconds == sorted(s for n, s, _ in steps if n == "a")[1]


def test_choices() -> None:
    assert [c.name for c in speed.Choice.of("ppdf:paper")] == ["ppdf:paper"]
    assert {c.filter for c in speed.Choice.of("all")} == set(filters.names())
    with pytest.raises(ParameterError, match="no profile"):
        speed.Choice.of("ppdf:fast")


def test_speed_command(tile: Path) -> None:
    ran = CliRunner().invoke(group, ["benchmark", "speed", str(tile), "--filter", "ppdf", "--repeat", "2", "--json"])
    assert ran.exit_code == 0, ran.output
    (found,) = json.loads(ran.stdout)["files"]
    (robust,) = found["filters"]
    assert robust["filter"] == "ppdf:robust"
    assert robust["classify_over_copy"] == pytest.approx(robust["classify"]["cpu_s"] / found["copy"]["cpu_s"])
    assert robust["decode_over_filter"] == pytest.approx(found["decode"]["cpu_s"] / robust["alone"]["cpu_s"])
    assert len(found["decode"]["cpu_all_s"]) == len(robust["alone"]["cpu_all_s"]) == 2
    assert sum(s["share"] for s in robust["stages"]) == pytest.approx(1.0)
    assert 0 < robust["offered"] < found["points"]
    if sys.platform == "linux":
        # The mask alone takes a byte per point.
        assert robust["bytes_per_point"] >= 1


def test_speed_table_without_memory(tile: Path) -> None:
    options = ["--filter", "ppdf", "--filter", "pmf", "--repeat", "1", "--no-memory"]
    ran = CliRunner().invoke(group, ["benchmark", "speed", str(tile), *options])
    assert ran.exit_code == 0, ran.output
    assert "ppdf:robust classify, LAZ to LAZ" in ran.stdout
    assert "pmf:default alone" in ran.stdout
    assert "\x1b" not in ran.stdout


def test_the_first_call_in_a_process_is_measured_apart_from_the_imports(tile: Path) -> None:
    options = ["--filter", "pmf", "--repeat", "1", "--no-memory", "--compilation", "--json"]
    ran = CliRunner().invoke(group, ["benchmark", "speed", str(tile), *options])
    assert ran.exit_code == 0, ran.output
    (call,) = json.loads(ran.stdout)["first_call_s"].values()
    assert set(call) == {"imports", "cold", "warm"}
    assert min(call.values()) > 0


def test_the_childs_last_words_are_told() -> None:
    with pytest.raises(PpdfError, match="no filter"):
        speed.child({"filter": "none", "profile": "x", "params": {}, "points": None})
