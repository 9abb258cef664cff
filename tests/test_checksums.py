"""A delivery with a list of checksums: what is damaged on its way does not get in."""

import hashlib
import json

import numpy as np
import pytest
from faulty import Inline
from lasfiles import points, write

from ppdf_dask.errors import PartialRunError, PpdfError, SurveyError, TileError
from ppdf_dask.plan import plan
from ppdf_dask.single import classify_tile
from ppdf_dask.survey import Survey, scan


@pytest.fixture
def delivery(tmp_path):
    folder = tmp_path / "in"
    for k, name in enumerate(("a.laz", "b b.laz")):
        write(folder / name, points(500, seed=k) + np.array([k * 200_000, 0, 0]))
    lines = [f"{hashlib.sha256(f.read_bytes()).hexdigest()} *{f.name}" for f in sorted(folder.glob("*.laz"))]
    (folder / "sums.txt").write_text("# as sha256sum writes it\n" + "\n".join(lines) + "\n")
    return folder


def test_f5_a_delivery_as_its_list_says(delivery, tmp_path):
    survey = scan(delivery, checksums=delivery / "sums.txt")
    assert all(t.sha256 for t in survey.tiles)
    assert Survey.from_dict(json.loads(json.dumps(survey.as_dict()))) == survey
    assert plan(survey, out=tmp_path / "run").run(Inline()).counts["points"] == 1000


def test_f5_another_byte_is_found_and_the_rest_is_done(delivery, tmp_path):
    """A flipped byte that no decoder would see: the year of the header."""
    path = delivery / "a.laz"
    content = bytearray(path.read_bytes())
    content[92] ^= 1
    path.write_bytes(content)
    survey = scan(delivery, checksums=delivery / "sums.txt")
    with pytest.raises(PartialRunError, match=r"a\.laz has the SHA-256 [0-9a-f]{64}, its list says .*fetch it again"):
        plan(survey, out=tmp_path / "run").run(Inline())
    assert (tmp_path / "run" / "laz" / "b b.laz").exists()
    assert not (tmp_path / "run" / "laz" / "a.laz").exists()
    with pytest.raises(TileError, match="fetch it again"):
        classify_tile(scan(path, checksums=delivery / "sums.txt"), tmp_path / "out.laz")
    assert not (tmp_path / "out.laz").exists()


def test_f5_what_is_not_there_or_not_listed_is_noted(delivery):
    (delivery / "a.laz").unlink()
    write(delivery / "c.laz", points(500, seed=9) + np.array([900_000, 0, 0]))
    survey = scan(delivery, checksums=delivery / "sums.txt")
    found = {(p.code, p.path.rsplit("/", 1)[-1]) for p in survey.problems}
    assert {("missing", "a.laz"), ("unlisted", "c.laz")} <= found


@pytest.mark.parametrize("text", ["no sum at all", "12ab a.laz", "\x1b[31m" + "0" * 64])
def test_f5_a_list_that_is_none(delivery, text):
    (delivery / "sums.txt").write_text(text)
    with pytest.raises(SurveyError, match=r"sums\.txt, line 1: .*sha256sum"):
        scan(delivery, checksums=delivery / "sums.txt")


def test_f5_a_list_that_is_no_text(delivery):
    with pytest.raises(SurveyError, match=r"is not text"):
        scan(delivery, checksums=delivery / "a.laz")


def test_f5_a_list_given_later_is_a_change(delivery, tmp_path):
    """Otherwise a finished run would resume without looking at it."""
    plan(scan(delivery), out=tmp_path / "run").run(Inline())
    with pytest.raises(PpdfError, match=r"--accept-changes"):
        plan(scan(delivery, checksums=delivery / "sums.txt"), out=tmp_path / "run").run(Inline())
    text = (delivery / "sums.txt").read_text()
    (delivery / "sums.txt").write_text(text.translate(str.maketrans("0123", "1230")))
    with pytest.raises(PartialRunError, match="fetch it again"):
        plan(scan(delivery, checksums=delivery / "sums.txt"), out=tmp_path / "run").run(Inline(), accept_changes=True)
