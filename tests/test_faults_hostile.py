"""What a stranger may put into configuration, ledger and folder: refused in a sentence, never run, never believed."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner
from lasfiles import points, write

from ppdf_dask.cli import group
from ppdf_dask.errors import ParameterError, PpdfError

DEEP = b'{"a":' * 100_000 + b"}" * 100_000
JUNK = (b"", b"{", DEEP, b"[]", b"null", b"\xff\xff", b'{"attributes": 3}', b'{"attributes": {}}')


def told(*words: object) -> str:
    """Run a command; return what it says. Only an error that says what to do may end it."""
    shown = CliRunner().invoke(group, [str(word) for word in words])
    if isinstance(shown.exception, PpdfError):
        return str(shown.exception)
    assert shown.exception is None or isinstance(shown.exception, SystemExit), repr(shown.exception)
    return shown.output


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[dtm]\nresolution = "abc"', "resolution = 'abc' is not a finite number of m"),
        ("[dtm]\nresolution = true", "resolution = True is not a finite number of m"),
        ("[dtm]\nresolution = inf", "resolution = inf is not a finite number of m"),
        ('[classes]\nfrom_classes = "abc"', "from_classes = 'abc' must be a list of ASPRS classes"),
        ('[classes]\nfrom_classes = ["x"]', "must be a list of ASPRS classes"),
        ("[classes]\nfrom_classes = 3", "must be a list of ASPRS classes"),
        ("[classes]\nfrom_classes = [256]", "must be a list of ASPRS classes"),
        ("[classes]\nground_class = 2.5", "ground_class = 2.5 class is not a whole number"),
        ("[classes]\nground_class = 256", "above the largest allowed value, 255"),
        ('[classes]\nskip_overlap = "no"', "skip_overlap = 'no' is neither true nor false"),
        ("[classes]\nmode = {}", "mode = {} is unknown"),
        ("[filter]\nname = 3", "name = 3 is not a text"),
        ("[filter]\nprofile = [1]", "profile = [1] is not a text"),
        ('[filter]\nname = "../../x"', "there is no filter '../../x'"),
        ('[filter]\nname = "os.system"', "there is no filter 'os.system'"),
        ("[chunks]\nchunk_size = 1e9", "above the largest allowed value"),
        ("x = 1", "'x' is unknown; the tables are"),
        ("[dtm\n", "is not valid TOML"),
        ("a = " + "[" * 5000 + "]" * 5000, "nested too deeply"),
        (b"\xff\xfe", "is not valid TOML"),
    ],
)
def test_f57_configuration_is_data(tmp_path, text, said):
    source = write(tmp_path / "a.laz", points(50))
    (tmp_path / "c.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    assert said in told("plan", source, "--config", tmp_path / "c.toml")


@pytest.mark.parametrize(
    "text", ["$(touch {})", "`touch {}`", ";touch {}", "|touch {}", "__import__('os').mknod('{}')"]
)
def test_f57_no_option_or_name_reaches_a_shell(tmp_path, text):
    mark, source = tmp_path / "mark", write(tmp_path / "in" / "a.laz", points(50))
    hostile = text.format("mark" if "/" in text else mark)
    told("plan", source, "--assume-crs", hostile)
    told("plan", source, "--filter", hostile)
    told("evaluate", source, source, "--score", hostile)
    name = tmp_path / "in" / (text.format("mark") + ".laz")
    name.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(source, name)
    told("scan", tmp_path / "in", "--duplicates", "keep")
    told("classify", name, tmp_path / "out" / name.name, "--filter", "pmf")
    assert (tmp_path / "out" / name.name).exists()
    assert not mark.exists()
    assert not Path("mark").exists()


@pytest.fixture(scope="module")
def finished(undisturbed, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("hostile") / "run"
    shutil.copytree(undisturbed, out)
    return out


@pytest.mark.parametrize("name", ["zarr.json", "lock", "ledger/plan/p/plan", "ledger/tile/s_000/s_000000"])
def test_f36_f52_a_ledger_written_by_a_stranger(finished, name):
    path = finished / "run.zarr" / (name if name.endswith(".json") else f"{name}/zarr.json")
    kept = path.read_bytes() if path.exists() else None
    path.parent.mkdir(exist_ok=True)
    for junk in JUNK:
        path.write_bytes(junk)
        assert told("status", finished)
    told("verify", finished)
    if kept is None:
        shutil.rmtree(path.parent)
    else:
        path.write_bytes(kept)


def test_f36_f56_an_array_that_claims_to_be_enormous_is_not_allocated(finished):
    path = finished / "run.zarr" / "classification" / "c_0025_0024" / "zarr.json"
    kept = path.read_text()
    meta = json.loads(kept)
    meta["shape"] = [10**14]
    path.write_text(json.dumps(meta))
    assert "missing   classification/c_0025_0024" in told("verify", finished)
    path.write_text(kept)
    (finished / "damage.json").unlink()


def test_f22_notes_and_failures_of_a_stranger_lead_nowhere(finished, tiles, tmp_path):
    """A note asks for removals: only below the store, and never up from it."""
    from faulty import Inline, small_plan

    treasure = tmp_path / "treasure"
    treasure.write_text("mine")
    up = os.path.relpath(treasure, finished / "run.zarr")
    (finished / "damage.json").write_text(json.dumps({"redo": [], "remove": [up, str(treasure), "a/../../../x"]}))
    client = Inline()
    small_plan(tiles, finished).run(client)
    assert client.ran == []
    assert treasure.read_text() == "mine"
    for junk in JUNK:
        (finished / "damage.json").write_bytes(junk)
        (finished / "failures.json").write_bytes(junk)
        assert "is damaged; remove it" in told("status", finished)
    (finished / "failures.json").unlink()
    small_plan(tiles, finished).run(Inline())
    assert not (finished / "damage.json").exists()


def test_f36_a_chunk_named_by_a_stranger_is_no_path(finished):
    for piece in ("../../etc/passwd", "c_0025_0024/../..", "", "s_999999"):
        with pytest.raises(ParameterError, match="is no chunk, tile or block"):
            CliRunner().invoke(group, ["debug", str(finished), piece], catch_exceptions=False)
