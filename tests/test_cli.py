"""The command line as a user meets it: real processes, real exit codes, plain words."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest

from ppdf_dask.cli import COMMANDS

HEAVY = ("numpy", "numba", "dask", "distributed", "zarr", "xarray", "laspy", "rich", "scipy", "matplotlib")


def cli(*words: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-m", "ppdf_dask", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ | environment,
    )


def test_help_imports_nothing_heavy():
    program = (
        "import sys; sys.argv = ['ppdf-dask', '--help']\n"
        "from ppdf_dask.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        f"print('LOADED', [m for m in {HEAVY} if m in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert shown.endswith("LOADED []\n")
    assert all(name in shown for name in COMMANDS)


def test_importing_the_package_loads_nothing_heavy():
    program = f"import sys, ppdf_dask; print([m for m in {HEAVY} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout == "[]\n"


def test_public_names_exist():
    import ppdf_dask

    for name in ppdf_dask.__all__:
        assert getattr(ppdf_dask, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ppdf_dask.nothing


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_has_help_with_an_example(command):
    shown = cli(command, "--help")
    assert shown.returncode == 0
    assert f"ppdf-dask {command}" in shown.stdout


def test_run_in_worker_processes_and_again(small_survey, tmp_path):
    words = ("run", small_survey / "tiles", "--out", tmp_path / "RUN", "--chunk-size", "60", "--workers", "2")
    first = cli(*words, "--json-log", tmp_path / "log.jsonl")
    assert first.returncode == 0, first.stderr
    assert "Result:" in first.stdout
    assert "dashboard http://127.0.0.1:" in first.stderr
    assert "\x1b[" not in first.stdout + first.stderr
    events = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert {e["stage"] for e in events} >= {"run", "tile", "classify", "merge", "dtm"}
    again = cli(*words, "--quiet")
    assert (again.returncode, again.stdout) == (0, "")
    for tile in (small_survey / "truth").glob("*.laz"):
        shown = cli("evaluate", tile, tmp_path / "RUN" / "laz" / tile.name, "--json")
        assert json.loads(shown.stdout)["scored"] == len(laspy.read(tile))
        break


def test_classify_and_evaluate_agree_with_the_library(small_survey, tmp_path):
    from ppdf_dask.evaluate import evaluate

    tile = sorted((small_survey / "tiles").glob("*.laz"))[4]
    assert cli("classify", tile, tmp_path / "out.laz").returncode == 0
    truth = small_survey / "truth" / tile.name
    shown = cli("evaluate", truth, tmp_path / "out.laz")
    assert f"kappa {evaluate(truth, tmp_path / 'out.laz').scores.kappa:.1%}" in shown.stdout
    assert (np.asarray(laspy.read(tmp_path / "out.laz").classification) == 2).any()


def test_errors_are_one_plain_sentence_with_the_exit_code(tmp_path, small_survey):
    (tmp_path / "page.laz").write_text("<html>404</html>")
    bad = cli("scan", tmp_path / "page.laz")
    assert bad.returncode == 2
    assert "page.laz" in bad.stderr
    assert "Traceback" not in bad.stderr
    wrong = cli("plan", small_survey / "tiles", "--resolution", "-1")
    assert wrong.returncode == 2
    assert "resolution = -1.0 m is below" in wrong.stderr
    unknown = cli("classify", tmp_path / "nothing.laz", tmp_path / "b.laz")
    assert unknown.returncode == 2
    remote = cli("run", small_survey / "tiles", "--out", tmp_path / "r", "--scheduler", "tcp://192.0.2.1:8786")
    assert remote.returncode == 4
    assert "not encrypted" in remote.stderr


def test_configuration_file_and_options_make_the_same_plan(small_survey, tmp_path):
    (tmp_path / "a.toml").write_text(
        "[dtm]\nresolution = 0.5\n[chunks]\nchunk_size = 60\n[filter]\nprofile = 'paper'\n"
    )
    tiles = small_survey / "tiles"
    from_file = cli("plan", tiles, "--config", tmp_path / "a.toml", "--json").stdout
    options = cli("plan", tiles, "--resolution", "0.5", "--chunk-size", "60", "--profile", "paper", "--json").stdout
    assert json.loads(from_file)["params"] == json.loads(options)["params"]
    assert json.loads(options)["params"]["filter"]["kind"] == "PaperParams"
    (tmp_path / "b.toml").write_text("[dtm]\nresolutoin = 0.5\n")
    assert "has no parameter 'resolutoin'" in cli("plan", tiles, "--config", tmp_path / "b.toml").stderr


def test_scan_as_json_round_trips(small_survey):
    from ppdf_dask.survey import Survey, scan

    shown = cli("scan", small_survey / "tiles", "--json").stdout
    assert Survey.from_dict(json.loads(shown)) == scan([small_survey / "tiles"])


def test_the_readme_names_every_command():
    text = (Path(__file__).parents[1] / "README.md").read_text()
    missing = [name for name in COMMANDS if f"ppdf-dask {name}" not in text]
    assert not missing, f"README.md does not show {missing}"
