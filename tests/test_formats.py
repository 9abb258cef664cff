"""Every point format and version through `run` and `classify`: all but the class stays, also for a second reader."""

from __future__ import annotations

import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest
from faulty import Inline
from lasfiles import patch, points

from ppdf_dask.errors import ParameterError, TileError
from ppdf_dask.filters.pmf import PmfParams
from ppdf_dask.params import ChunkParams, ClassRules, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.single import classify_tile
from ppdf_dask.survey import scan
from ppdf_dask.verify import verify

NAMES = ("VLR of somebody", "EVLR of somebody")


def write(path: Path, point_format: int, version: str, n: int = 900) -> laspy.LasData:
    """Write a file whose every bit that means nothing to us is random."""
    rng = np.random.default_rng(point_format)
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [0.01, 0.01, 0.001], [917_000.0, 6_450_000.0, 100.0]
    header.system_identifier, header.generating_software = "a scanner", "a program"
    header.add_extra_dim(laspy.ExtraBytesParams(name="height above sea", type="float32", description="m"))
    header.add_extra_dim(laspy.ExtraBytesParams(name="colours", type="3u2"))
    header.vlrs.append(laspy.VLR("somebody", 4711, NAMES[0], rng.bytes(321)))
    las = laspy.LasData(header)
    las.points = laspy.ScaleAwarePointRecord.zeros(n, header=header)
    records = las.points.array.view(np.uint8).reshape(n, header.point_format.size)
    records[:, 12:] = rng.integers(0, 256, (n, records.shape[1] - 12))
    mm = points(n, seed=point_format)
    las.X, las.Y, las.Z = (
        mm[:, k] // d - o for k, (d, o) in enumerate(((10, 91700000), (10, 645000000), (1, 100_000)))
    )
    las.classification = rng.choice([0, 1, 2, 5, 7, 12, 31], n)
    las.withheld = rng.random(n) < 0.1
    if version == "1.4":
        las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("somebody", 4712, NAMES[1], rng.bytes(70_000))])
    las.write(path, do_compress=path.suffix == ".laz", laz_backend=laspy.LazBackend.Lazrs)
    return laspy.read(path, laz_backend=laspy.LazBackend.Lazrs)


def all_but_class(las: laspy.LasData) -> np.ndarray:
    records = np.array(las.points.array.view(np.uint8).reshape(len(las), las.point_format.size))
    if las.point_format.id < 6:
        records[:, 15] &= 0b1110_0000
    else:
        records[:, 16] = 0
    return records


def same_but_class(before: laspy.LasData, path: Path) -> laspy.LasData:
    """Compare a result with its source by the reader that wrote it and by LASzip's own."""
    for backend in (laspy.LazBackend.Lazrs, laspy.LazBackend.Laszip):
        after = laspy.read(path, laz_backend=backend)
        np.testing.assert_array_equal(all_but_class(after), all_but_class(before), err_msg=str(backend))
    a, b = before.header, after.header
    assert (a.point_format, a.point_format.size, a.point_count) == (b.point_format, b.point_format.size, b.point_count)
    for name in ("system_identifier", "uuid", "creation_date", "global_encoding", "file_source_id"):
        left, right = getattr(a, name), getattr(b, name)
        assert getattr(left, "value", left) == getattr(right, "value", right), name
    assert (a.scales == b.scales).all()
    assert (a.offsets == b.offsets).all()

    def kept(records):
        """All records; laspy puts the one that describes the extra bytes last."""
        return sorted(
            (v.user_id, v.record_id, v.description, v.record_data_bytes())
            for v in records or []
            if v.user_id not in ("laszip encoded", "copc")
        )

    assert kept(a.vlrs) == kept(b.vlrs)
    assert kept(before.evlrs) == kept(after.evlrs)
    return after


def params(**rules: object) -> RunParams:
    return RunParams(filter=PmfParams(), chunks=ChunkParams(chunk_size=100.0), classes=ClassRules(**rules))


CASES = [(f, v) for f in range(11) for v in ("1.2", "1.3", "1.4") if f < 4 or v == "1.4" or (f < 6 and v == "1.3")]


@pytest.mark.parametrize(("point_format", "version"), CASES)
def test_f14_f15_all_but_the_class_stays(tmp_path, point_format, version):
    (tmp_path / "in").mkdir()
    source = tmp_path / "in" / ("a.laz" if point_format not in (4, 5, 9, 10) else "a.las")
    before = write(source, point_format, version)
    assert [v.description for v in before.header.vlrs if v.user_id == "somebody"] == [NAMES[0]]
    result = plan(scan([source], assume_units="m"), params(mode="reset"), out=tmp_path / "run").run(Inline())
    after = same_but_class(before, result.tiles[0])
    assert (np.asarray(after.classification) != np.asarray(before.classification)).any()
    assert result.tiles[0].suffix == (".las" if point_format in (4, 5, 9, 10) else ".laz")
    alone = tmp_path / f"alone{result.tiles[0].suffix}"
    classify_tile(scan([source], assume_units="m"), alone, params(mode="reset"))
    assert alone.read_bytes() == result.tiles[0].read_bytes()


@pytest.mark.parametrize("minor", [0, 1])
def test_las_1_0_and_1_1(tmp_path, minor):
    before = write(tmp_path / "a.las", 1, "1.2")
    patch(tmp_path / "a.las", 25, "B", minor)
    result = plan(scan([tmp_path / "a.las"]), params(), out=tmp_path / "run").run(Inline())
    assert result.tiles[0].read_bytes()[25] == minor
    assert not verify(tmp_path / "run").findings
    if minor == 0:  # laspy does not know LAS 1.0
        patch(result.tiles[0], 25, "B", 1)
    same_but_class(before, result.tiles[0])


def test_f20_a_copc_file_comes_out_as_plain_laz(tmp_path):
    """There is no writer of COPC: a LAZ file with the records that mark one has to do."""
    before = write(tmp_path / "plain.laz", 6, "1.4")
    before.header.vlrs.insert(0, laspy.VLR("copc", 1, "COPC info VLR", bytes(160)))
    before.evlrs.append(laspy.VLR("copc", 1000, "EPT Hierarchy", bytes(32)))
    before.write(tmp_path / "a.copc.laz", do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
    survey = scan([tmp_path / "a.copc.laz"])
    assert survey.tiles[0].copc
    assert survey.tiles[0].name == "a.laz"
    result = plan(survey, params(), out=tmp_path / "run").run(Inline())
    after = same_but_class(before, result.tiles[0])
    assert not [v for v in [*after.header.vlrs, *after.evlrs] if v.user_id == "copc"]


def test_f18_every_mode_writes_what_the_table_says(tmp_path):
    source = tmp_path / "a.laz"
    las = write(source, 6, "1.4")
    old = np.asarray(las.classification)
    seen = ~np.asarray(las.withheld, bool) & ~np.asarray(las.synthetic, bool) & ~np.isin(old, (7, 9, 18)) & (old < 64)
    out = {}
    for name, rules in {
        "update": {},
        "reset": {"mode": "reset"},
        "refine": {"mode": "refine"},
        "eight": {"ground_class": 8},
        "only": {"from_classes": (1, 5)},
        "withheld": {"use_withheld": True},
        "overlap": {"skip_overlap": True},
    }.items():
        plan(scan([source]), params(returns="all", **rules), out=tmp_path / name).run(Inline())
        out[name] = np.asarray(laspy.read(tmp_path / name / "laz" / "a.laz").classification)
        changed = out[name] != old
        assert changed.any(), name
        if name not in ("only", "withheld"):
            assert not (changed & ~seen).any(), name
    assert set(out["update"][(out["update"] != old)]) <= {1, 2}
    assert set(out["reset"][seen]) <= {1, 2}
    assert (out["refine"][(old == 2) & seen] == 2).all()
    assert set(out["eight"][(out["eight"] != old)]) <= {1, 8}
    assert not (out["only"] != old)[~np.isin(old, (1, 5))].any()
    withheld = np.asarray(las.withheld, bool)
    assert not (out["update"] != old)[withheld].any()
    assert (out["withheld"] != old)[withheld].any()
    assert not (out["overlap"] != old)[np.asarray(las.overlap, bool)].any()


def test_f18_a_class_beyond_the_format_is_refused_when_planned(tmp_path):
    write(tmp_path / "a.laz", 3, "1.2")
    made = plan(scan([tmp_path / "a.laz"]), params(ground_class=40), out=tmp_path / "run")
    with pytest.raises(ParameterError, match=r"ground_class = 40 does not fit .*a\.laz: point format 3"):
        made.check()
    with pytest.raises(ParameterError, match="ground_class = 40"):
        made.run(Inline())
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_f6_few_points_and_none(tmp_path, n):
    write(tmp_path / "a.laz", 6, "1.4", n)
    result = plan(scan([tmp_path / "a.laz"]), params(), out=tmp_path / "run").run(Inline())
    assert len(laspy.read(result.tiles[0])) == n
    assert result.counts["points"] == n


def test_f6_f10_collinear_and_equal_points(tmp_path):
    las = write(tmp_path / "a.laz", 6, "1.4", 500)
    las.X, las.Y = np.arange(500) * 10, np.arange(500) * 10
    las.write(tmp_path / "line.laz", laz_backend=laspy.LazBackend.Lazrs)
    las.X, las.Y, las.Z = np.zeros((3, 500), np.int32)
    las.write(tmp_path / "dot.laz", laz_backend=laspy.LazBackend.Lazrs)
    for name in ("line.laz", "dot.laz"):
        result = plan(scan([tmp_path / name]), params(), out=tmp_path / name[:-4]).run(Inline())
        assert np.isnan(result.dtm.values).all()
        found = laspy.read(result.tiles[0])
        assert len(found) == 500
    seen = np.isin(np.asarray(las.classification), (0, 1, 2, 5, 12, 31)) & ~np.asarray(las.withheld, bool)
    seen &= ~np.asarray(las.synthetic, bool) & (np.asarray(las.return_number) >= np.asarray(las.number_of_returns))
    ground = np.asarray(found.classification)[seen] == 2
    assert ground.all() or not ground.any(), "exact duplicates get one label"


@pytest.mark.parametrize("point_format", [9, 10])
def test_a_writer_that_loses_bytes_is_caught(tmp_path, point_format):
    """lazrs 0.8.2 damages waveform packets: what is written is decoded again in full and compared."""
    write(tmp_path / "a.las", point_format, "1.4")
    with pytest.raises(TileError, match="does not read back as written"):
        classify_tile(scan([tmp_path / "a.las"]), tmp_path / "b.laz", params())
    assert list(tmp_path.iterdir()) == [tmp_path / "a.las"]


def test_f21_names_as_long_as_they_can_be(tmp_path):
    (tmp_path / "in").mkdir()
    for name in ("a" * 251 + ".laz", "-rf {x} %s $(id);'\".LAZ", "Höhe 7.laz"):
        write(tmp_path / "in" / name, 6, "1.4")
        result = plan(scan([tmp_path / "in"]), params(), out=tmp_path / "run").run(Inline())
        assert len(list((tmp_path / "run" / "laz").iterdir())) == 1 == len(result.tiles)
        (tmp_path / "in" / name).unlink()
        shutil.rmtree(tmp_path / "run")
