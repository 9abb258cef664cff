"""Every point format and version through `run` and `classify`: all but the class stays, also for a second reader."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import lasfiles
import laspy
import numpy as np
import pytest
from faulty import Inline
from lasfiles import patch, points, write_copc

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
    """A true one, which laspy's own COPC reader finds its way through; chunks' edges lie on points of it."""
    mm = points(4000) // 1000 * 1000
    source = write_copc(tmp_path / "a.copc.laz", mm, crs="EPSG:2154", return_number=1, number_of_returns=1)
    with laspy.CopcReader.open(source) as reader:
        assert len(reader.query()) == 4000
        assert len(reader.query(level=0)) == 400
    before = laspy.read(source, laz_backend=laspy.LazBackend.Lazrs)
    survey = scan([source])
    assert survey.tiles[0].copc
    assert survey.tiles[0].name == "a.laz"
    result = plan(survey, params().replace(chunks=ChunkParams(chunk_size=20.0)), out=tmp_path / "run").run(Inline())
    assert result.counts["points"] == result.counts["eligible"] == 4000
    after = same_but_class(before, result.tiles[0])
    assert not [v for v in [*after.header.vlrs, *after.evlrs] if v.user_id == "copc"]
    plain = tmp_path / "plain.laz"
    before.header.vlrs.extract("CopcInfoVlr")
    before.evlrs = None
    before.write(plain, laz_backend=laspy.LazBackend.Lazrs)
    again = plan(scan([plain]), params().replace(chunks=ChunkParams(chunk_size=20.0)), out=tmp_path / "plain")
    classes = [np.asarray(laspy.read(r.tiles[0]).classification) for r in (result, again.run(Inline()))]
    assert (classes[0] == classes[1]).all()


def masked(head: bytes) -> bytes:
    """Return a header without the four places that a copy has to change: where what begins, compressed or not."""
    return head[:96] + bytes(9) + head[105:235] + bytes(12) + head[247:375]


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_f15_header_and_records_stay_to_the_byte(tmp_path, suffix):
    """Text in Latin-1, a date of zero, reserved bytes, old counts, statistics of extra bytes: none means us."""
    source = tmp_path / f"a{suffix}"
    write(source, 6, "1.4")
    raw = bytearray(source.read_bytes())
    raw[26:58] = "Höhenmodell, Scanner Nº 7".encode("latin-1").ljust(32, b"\0")
    raw[58:90] = bytes(range(224, 256))
    raw[90:94] = bytes(4)
    raw[107:131] = bytes(range(24))
    at = raw.index(b"somebody") - 2
    raw[at : at + 2] = b"\xbb\xaa"
    raw[at + 2 : at + 18] = "Müller & Söhne".encode("latin-1").ljust(16, b"\xff")
    raw[at + 22 : at + 54] = b"\xe9" * 32
    source.write_bytes(raw)
    assert {p.code for p in scan([source]).problems} == {"crs-missing", "legacy-count"}
    result = plan(scan([source]), params(mode="reset"), out=tmp_path / "run").run(Inline())
    copy = result.tiles[0].read_bytes()
    assert masked(copy) == masked(bytes(raw))

    def records(data):
        start, count = int.from_bytes(data[96:100], "little"), int.from_bytes(data[100:104], "little")
        found, position = [], 375
        for _ in range(count):
            end = position + 54 + int.from_bytes(data[position + 20 : position + 22], "little")
            found.append(bytes(data[position:end]))
            position = end
        assert position == start
        return [r for r in found if b"laszip encoded" not in r[:18]]

    assert records(copy) == records(raw)
    assert len(records(copy)) == 2
    begin = [int.from_bytes(d[235:243], "little") for d in (raw, copy)]
    assert copy[begin[1] :] == raw[begin[0] :]
    assert len(copy) - begin[1] == 60 + 70_000
    alone = classify_tile(scan([source]), tmp_path / "alone.laz", params(mode="reset"))
    assert alone["points"] == 900
    assert (tmp_path / "alone.laz").read_bytes() == copy
    assert verify(tmp_path / "run").findings == []


WAVES = b"\0\0" + b"LASF_Spec".ljust(16, b"\0") + (65535).to_bytes(2, "little") + (5000).to_bytes(8, "little")


@pytest.mark.parametrize(("point_format", "version"), [(4, "1.3"), (5, "1.3"), (9, "1.4"), (10, "1.4")])
def test_f15_waveforms_inside_the_file_stay_where_the_header_says(tmp_path, point_format, version):
    source = tmp_path / "a.las"
    waves = WAVES + bytes(32) + (np.arange(5000) % 251).astype(np.uint8).tobytes()
    before = write(source, point_format, version)
    raw = bytearray(source.read_bytes())
    raw[6] |= 0b10
    raw[227:235] = len(raw).to_bytes(8, "little")
    if version == "1.4":  # one more record behind the points
        raw[243:247] = (2).to_bytes(4, "little")
    source.write_bytes(raw + waves)
    result = plan(scan([source]), params(), out=tmp_path / "run").run(Inline())
    copy = result.tiles[0].read_bytes()
    at = int.from_bytes(copy[227:235], "little")
    assert copy[at : at + 5060] == waves
    assert copy[6] == raw[6]
    after = laspy.read(result.tiles[0])
    assert (all_but_class(after) == all_but_class(before)).all()
    if version == "1.4":
        assert [v.description for v in after.evlrs] == [NAMES[1], ""]


@pytest.mark.parametrize("claimed", [0, 1000, 100_000])
@pytest.mark.parametrize("behind", [0, 1])
def test_f15_waveforms_are_kept_whatever_length_they_claim(tmp_path, claimed, behind):
    """A recorder that was not closed leaves a length of zero; where the next record begins the waveforms end."""
    source = tmp_path / "a.las"
    write(source, 9, "1.4")
    raw = bytearray(source.read_bytes())
    evlrs, count = struct.unpack_from("<QI", raw, 235)
    raw = raw[: evlrs if count else len(raw)]
    waves = struct.pack("<H16sHQ32s", 0, b"LASF_Spec", 65535, claimed, b"") + b"W" * 1000
    extra = struct.pack("<H16sHQ32s", 0, b"somebody", 1, 50, b"") + b"E" * 50
    raw[6] |= 0b10
    struct.pack_into("<QQI", raw, 227, len(raw), len(raw + waves) if behind else 0, behind)
    source.write_bytes(raw + waves + extra * behind)
    result = plan(scan([source]), params(), out=tmp_path / "run").run(Inline())
    copy = result.tiles[0].read_bytes()
    at, first, number = struct.unpack_from("<QQI", copy, 227)
    assert copy[at : at + len(waves)] == waves
    assert number == behind
    assert copy[first : first + 110] == extra or not behind


@pytest.mark.parametrize(("point_format", "version"), [(4, "1.3"), (5, "1.4"), (9, "1.4"), (10, "1.4")])
def test_f15_waveforms_compressed_by_laszip_come_out_whole(tmp_path, point_format, version):
    before = write(tmp_path / "a.las", point_format, version)
    before.write(tmp_path / "b.laz", do_compress=True, laz_backend=laspy.LazBackend.Laszip)
    before = laspy.read(tmp_path / "b.laz", laz_backend=laspy.LazBackend.Laszip)
    result = plan(scan([tmp_path / "b.laz"]), params(), out=tmp_path / "run").run(Inline())
    assert result.tiles[0].name == "b.las"
    same_but_class(before, result.tiles[0])


def test_f7_f16_what_a_header_says_wrong_changes_nothing(tmp_path):
    """Bounds that do not hold the points, and no WKT bit: warned of, and handed on as they are."""
    source = lasfiles.write(tmp_path / "a.laz", points(800), crs="EPSG:2154")
    right = plan(scan([source]), params(), out=tmp_path / "right").run(Inline())
    high, low = np.array(laspy.read(source).header.maxs), np.array(laspy.read(source).header.mins)
    patch(source, lasfiles.BOUNDS, "6d", *np.column_stack([high + 30, low + 10]).ravel())
    patch(source, 6, "H", 0)
    survey = scan([source])
    assert [p.code for p in survey.problems] == ["wkt-bit"]
    result = plan(survey, params(), out=tmp_path / "run").run(Inline())
    assert result.tiles[0].read_bytes()[:227] == source.read_bytes()[:227]
    said = {p["code"]: p["message"] for p in result.summary["warnings"]}
    assert set(said) == {"wkt-bit", "bounds", "returns"}
    assert said["bounds"].startswith("has points up to 10.00 m outside the bounds of its header")
    assert said["returns"].startswith("has 800 points with return number 0 of 0")
    for each in (right, result):
        assert result.counts == right.counts
        classes = np.asarray(laspy.read(each.tiles[0]).classification)
        assert (classes == np.asarray(laspy.read(right.tiles[0]).classification)).all()
    assert (tmp_path / "run" / "dtm.tif").read_bytes() == (tmp_path / "right" / "dtm.tif").read_bytes()


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
