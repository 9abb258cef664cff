"""A filter of another package: installed beside this one, it is found by name and runs through the whole engine."""

from __future__ import annotations

import json
import sys

import laspy
import numpy as np
import pytest
from click.testing import CliRunner

from ppdf_dask import filters
from ppdf_dask.cli import group
from ppdf_dask.errors import ParameterError

FLAT = """
from dataclasses import dataclass
import numpy as np
from ppdf_dask.filters import Filter
from ppdf_dask.filters.cloud import Verdict
from ppdf_dask.params import Parameters, quantity

@dataclass(frozen=True, kw_only=True)
class FlatParams(Parameters):
    height: float = quantity(1.0, "m", low=0.0, doc="what lies lower is ground")

def classify(cloud, params):
    ground = cloud.z[: cloud.n_core] < params.height * 1000
    return Verdict(ground, np.zeros(cloud.n_core, np.bool_))

FILTER = Filter("flat", {"default": FlatParams(), "high": FlatParams(height=250.0)}, classify, lambda params: 1.0,
                False, lambda params, density: params, 10.0)
NOTHING = 7
"""


def install(place, entries, version="1.0", name="flatland"):
    """Put a package and its metadata where Python looks: what pip leaves behind."""
    package, info = place / name, place / f"{name}-{version}.dist-info"
    package.mkdir()
    info.mkdir()
    (package / "__init__.py").write_text(FLAT)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = [f"{key} = {value}" for key, value in entries.items()]
    (info / "entry_points.txt").write_text("\n".join(["[ppdf_dask.filters]", *lines, ""]))


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """A folder on the path; what is installed is looked up anew, before and after."""
    monkeypatch.syspath_prepend(tmp_path)
    filters._entries.cache_clear()
    yield tmp_path
    filters._entries.cache_clear()
    sys.modules.pop("flatland", None)


def test_it_is_found_by_name_and_by_its_parameters(fresh):
    install(fresh, {"flat": "flatland:FILTER"})
    assert {"flat", "ppdf", "smrf"} <= set(filters.names())
    xyz = np.array([[0.0, 0.0, 0.4], [3.0, 1.0, 0.999], [1.0, 1.0, 1.0], [1.0, 2.0, 9.0]])
    assert filters.classify_ground(xyz, "flat").tolist() == [True, True, False, False]
    assert filters.classify_ground(xyz, filters.parameters("flat", "high")).all()
    with pytest.raises(ParameterError, match=r"height = -1 m is below"):
        filters.parameters("flat").replace(height=-1)


def test_a_broken_package_is_named_and_in_nobodys_way(fresh):
    install(fresh, {"gone": "flatland:ABSENT", "lost": "flatland.nowhere:FILTER", "seven": "flatland:NOTHING"})
    for name, reason in (("gone", "ABSENT"), ("lost", "No module named"), ("seven", "not a ppdf_dask Filter")):
        with pytest.raises(ParameterError, match=reason):
            filters.get(name)
    assert filters.of(filters.parameters("smrf")).name == "smrf"


def test_two_packages_with_one_name_are_refused(fresh):
    install(fresh, {"smrf": "flatland:FILTER"})
    with pytest.raises(ParameterError, match=r"'smrf' is offered by flatland:FILTER and ppdf_dask.filters.smrf:FILTER"):
        filters.get("smrf")


def test_it_runs_through_the_engine(fresh, tiles, client):
    install(fresh, {"flat": "flatland:FILTER"})
    middle = float(np.median(np.concatenate([laspy.read(path).z for path in tiles.glob("*.laz")])))
    config, out = fresh / "params.toml", fresh / "run"
    config.write_text(f"[filter]\nheight = {middle}\n")

    def command(*words):
        done = CliRunner().invoke(group, [*map(str, words)], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        return done.stdout

    where = ["--chunk-size", 20, "--scheduler", client.scheduler.address, "--quiet"]
    command("run", tiles, "--out", out, "--filter", "flat", "--config", config, *where)
    checked = 0
    for path in tiles.glob("*.laz"):
        before, after = laspy.read(path), laspy.read(out / "laz" / path.name)
        last = np.asarray(before.return_number) >= np.asarray(before.number_of_returns)
        asked = last & ~np.isin(before.classification, [7, 9, 18])
        low = np.round(np.asarray(before.z) * 1000) < round(middle * 1000)
        assert ((np.asarray(after.classification) == 2) == (asked & low)).all()
        checked += int(asked.sum())
    assert checked > 2000
    told = json.loads(command("seams", out, "--json"))
    assert (told["filter"], told["buffer_m"] >= 1.0, told["differ"]) == ("flat", True, 0)
    assert told["points"] > 100
