"""The header-only scan: what is found, what is refused, and that nothing hostile gets through."""

import json
import os
import pickle
import shutil
import xml.etree.ElementTree as ElementTree

import laspy
import numpy as np
import pyproj
import pytest
from faulty import in_child
from hypothesis import given, settings
from hypothesis import strategies as st
from lasfiles import (
    BOUNDS,
    COUNT,
    EVLR_COUNT,
    EVLR_START,
    FORMAT,
    LEGACY_COUNT,
    OFFSET_TO_POINTS,
    OFFSETS,
    RECORD_LENGTH,
    SCALES,
    VLR_COUNT,
    laszip_record,
    no_more_than,
    patch,
    peek,
    points,
    write,
)

from ppdf_dask.errors import SurveyError
from ppdf_dask.grid import Rect
from ppdf_dask.lasheader import Reject, read_header
from ppdf_dask.pairs import find_overlaps
from ppdf_dask.survey import Survey, scan
from ppdf_dask.tiles import Problem, Tile, find_files, output_names

UTM = "EPSG:25832"
US_FOOT = 1200 / 3937


def codes(survey, fatal=False):
    return [p.code for p in survey.problems if p.fatal == fatal]


# --- what is found -------------------------------------------------------------------------------------------------


def test_facts_of_a_tile(tmp_path):
    mm = points(1000)
    path = write(tmp_path / "a.laz", mm, crs=UTM, return_number=np.arange(1000) % 2 + 1, number_of_returns=2)
    survey = scan(path)
    (tile,) = survey.tiles
    assert (tile.path, tile.name) == (str(path), "a.laz")
    assert (tile.size, tile.mtime_ns) == (path.stat().st_size, path.stat().st_mtime_ns)
    assert (tile.version, tile.point_format, tile.record_length, tile.point_count) == ("1.4", 6, 30, 1000)
    assert tile.first_returns == 500
    assert tile.scales == (0.001,) * 3
    assert tile.offsets == (917_000.0, 6_450_000.0, 0.0)
    low, high = mm.min(axis=0).tolist(), mm.max(axis=0).tolist()
    assert tile.bounds == Rect(low[0], low[1], high[0] + 1, high[1] + 1) == survey.bounds
    assert tile.z_range == pytest.approx((low[2] / 1000, high[2] / 1000), abs=1e-9)
    assert (tile.compressed, tile.copc, tile.evlr_count) == (True, False, 0)
    assert pyproj.CRS.from_wkt(tile.crs).to_epsg() == 25832
    assert (survey.unit_xy, survey.unit_z, survey.point_count) == (1.0, 1.0, 1000)
    assert tile.density == pytest.approx(1000 * 1e6 / (tile.bounds.width * tile.bounds.height))


@pytest.mark.parametrize(("point_format", "version"), [(0, "1.2"), (3, "1.2"), (4, "1.3"), (1, "1.4"), (10, "1.4")])
def test_f14_versions(tmp_path, point_format, version):
    for suffix in (".las", ".laz"):
        path = write(tmp_path / f"a{suffix}", points(100), point_format=point_format, version=version)
        tile = scan(path).tiles[0]
        assert (tile.version, tile.point_format, tile.point_count, tile.compressed) == (
            version,
            point_format,
            100,
            suffix == ".laz",
        )


def test_las_1_0(tmp_path):
    """1.0 differs from 1.1 in the version byte and two signature bytes before the points."""
    path = write(tmp_path / "a.las", points(10), point_format=1, version="1.2")
    raw, start = bytearray(path.read_bytes()), peek(path, OFFSET_TO_POINTS, "I")
    raw[25] = 0
    path.write_bytes(raw[:start] + b"\xdd\xcc" + raw[start:])
    patch(path, OFFSET_TO_POINTS, "I", start + 2)
    tile = scan(path).tiles[0]
    assert (tile.version, tile.point_count) == ("1.0", 10)


def test_f21_folders_globs_case_and_magic(tmp_path):
    a = write(tmp_path / "north" / "A.LAZ", points(10, 1))
    b = write(tmp_path / "north" / "deep" / "b b.las", points(10, 2))
    c = write(tmp_path / "south" / "ünï %s {}.copc.LaZ", points(10, 3))
    odd = write(tmp_path / "south" / "tile.dat", points(10, 4))
    (tmp_path / "south" / "read.me").write_text("no tile")
    found = scan(tmp_path)
    assert [t.path for t in found.tiles] == sorted(map(str, (a, b, c)))
    assert [t.name for t in found.tiles] == ["north/A.laz", "north/deep/b b.laz", "south/ünï %s {}.laz"]
    assert [t.compressed for t in found.tiles] == [True, False, True]
    assert scan([tmp_path / "south", tmp_path / "north"]).as_dict() == found.as_dict()
    assert [t.path for t in scan(str(tmp_path / "**" / "*.la[sz]")).tiles] == [str(b)]
    assert [t.path for t in scan(str(tmp_path / "*")).tiles] == [t.path for t in found.tiles]
    assert [t.name for t in scan([odd, a]).tiles] == ["north/A.laz", "south/tile.laz"]
    assert [t.name for t in scan(b).tiles] == ["b b.laz"]


def test_f21_equal_basenames_keep_their_folders(tmp_path):
    files = [write(tmp_path / folder / "tile.laz", points(10, k)) for k, folder in enumerate(("x", "y"))]
    assert [t.name for t in scan(files).tiles] == ["x/tile.laz", "y/tile.laz"]


def test_f21_colliding_outputs_are_refused(tmp_path):
    write(tmp_path / "tile.laz", points(10, 1))
    write(tmp_path / "tile.las", points(10, 2))
    with pytest.raises(SurveyError, match=r"tile\.laz: its result would overwrite that of .*tile\.las"):
        scan(tmp_path)


def test_f21_a_literal_name_is_never_a_pattern(tmp_path):
    path = write(tmp_path / "a[1]*.laz", points(10))
    write(tmp_path / "a1x.laz", points(10, 1))
    assert [t.path for t in scan(path).tiles] == [str(path)]


@pytest.mark.parametrize("name", ["line\nbreak.laz", "bell\x07.laz", "back\\slash.laz", b"\xff\xfe.laz"])
def test_f21_names_that_cannot_be_stored_are_refused(tmp_path, name):
    path = os.path.join(os.fsencode(tmp_path), name if isinstance(name, bytes) else name.encode())
    shutil.copy(write(tmp_path / "ok.laz", points(10)), path)
    (tmp_path / "ok.laz").unlink()
    with pytest.raises(SurveyError, match="its name cannot be used in the output") as error:
        scan(tmp_path)
    str(error.value).encode()
    assert error.value.args[0].count("\n") == 2


@settings(max_examples=200, deadline=None)
@given(st.lists(st.text(st.characters(blacklist_characters="\0"), min_size=1, max_size=12), min_size=1, max_size=6))
def test_f22_no_name_leaves_the_output_folder(parts):
    names, _ = output_names(["/data/in/" + "/".join(parts)], "/data/in")
    for name in names.values():
        resolved = os.path.normpath(os.path.join("/run/laz", name))
        assert resolved.startswith("/run/laz/")
        assert resolved == "/run/laz/" + name
        assert name.isprintable()
        assert name.endswith(".laz")
        name.encode()


@pytest.mark.parametrize(
    "name", ["../a.laz", "/etc/a.laz", "x/../../a.laz", "C:a.laz", "a\\b.laz", "", "x//a.laz", "."]
)
def test_f22_names_from_a_manifest_are_checked(tmp_path, name):
    values = scan(write(tmp_path / "a.laz", points(10))).tiles[0].as_dict()
    with pytest.raises(SurveyError, match="cannot be used in the output"):
        Tile.from_dict(values | {"name": name})


def test_nothing_to_scan(tmp_path):
    for paths, text in (
        ([], "no tiles were given"),
        (tmp_path, "holds no .las or .laz file"),
        (tmp_path / "x.laz", "does not exist and matches nothing"),
        (str(tmp_path / "*.laz"), "matches nothing"),
    ):
        with pytest.raises(SurveyError, match=text):
            scan(paths)


def test_survey_survives_json_and_pickle(tmp_path):
    for k in range(3):
        write(tmp_path / f"{k}.laz", points(50, k), crs="EPSG:2263+6360")
    survey = scan(tmp_path)
    assert Survey.from_dict(json.loads(json.dumps(survey.as_dict()))) == survey
    assert pickle.loads(pickle.dumps(survey)) == survey


# --- headers that lie ----------------------------------------------------------------------------------------------


def broken(name, suffix, make, code):
    return pytest.param(suffix, make, code, id=name)


def whole(data):
    return lambda path: path.write_bytes(data)


def shorter(length):
    return lambda path: os.truncate(path, length if length >= 0 else path.stat().st_size + length)


def poke(position, layout, *values):
    return lambda path: patch(path, position, layout, *values)


def poke_laszip(offset, layout, *values):
    return lambda path: patch(path, laszip_record(path) + offset, layout, *values)


def poke_table(offset, layout, *values):
    return lambda path: patch(path, peek(path, peek(path, OFFSET_TO_POINTS, "I"), "q") + offset, layout, *values)


def no_laszip(path):
    patch(path, laszip_record(path) - 54 + 2, "16s", b"something else")


BROKEN = [
    broken("empty", ".laz", whole(b""), "empty"),
    broken("html", ".laz", whole(b"<!DOCTYPE html><title>404</title>" * 20), "signature"),
    broken("zip", ".laz", whole(b"PK\3\4" + bytes(500)), "signature"),
    broken("gzip", ".las", whole(b"\x1f\x8b\x08" + bytes(500)), "signature"),
    broken("short signature", ".las", whole(b"LAS"), "signature"),
    broken("cut in the header", ".las", shorter(100), "truncated"),
    broken("cut in the 1.4 header", ".las", shorter(300), "truncated"),
    broken("cut in the VLRs", ".laz", shorter(400), "header-size"),
    broken("cut in the points", ".las", shorter(-1), "count"),
    broken("cut between points", ".las", shorter(-300), "count"),
    broken("cut LAZ", ".laz", shorter(-40), "chunk-table"),
    broken("chunk table only half there", ".laz", shorter(-6), "chunk-table"),
    broken("LAZ never finished", ".laz", poke_table(0, "I", 1), "chunk-table"),
    broken("a trillion points", ".las", poke(COUNT, "Q", 10**12), "count"),
    broken("a trillion LAZ points", ".laz", poke(COUNT, "Q", 10**12), "count"),
    broken("all the points there can be", ".las", poke(COUNT, "Q", 2**64 - 1), "count"),
    broken("fewer points", ".las", poke(COUNT, "Q", 999), "count"),
    broken("no points but bytes", ".laz", poke(COUNT, "Q", 0), "count"),
    broken("fewer LAZ points", ".laz", poke_laszip(12, "I", 100), "count"),
    broken("record length 0", ".las", poke(RECORD_LENGTH, "H", 0), "record-length"),
    broken("record length too small", ".las", poke(RECORD_LENGTH, "H", 29), "record-length"),
    broken("record length of LAZ too large", ".laz", poke(RECORD_LENGTH, "H", 60_000), "laszip-vlr"),
    broken("point format 11", ".las", poke(FORMAT, "B", 11), "point-format"),
    broken("version 2.7", ".las", poke(24, "BB", 2, 7), "version"),
    broken("header larger than the file", ".las", poke(94, "H", 65535), "header-size"),
    broken("points before the header ends", ".las", poke(OFFSET_TO_POINTS, "I", 100), "header-size"),
    broken("points beyond the file", ".las", poke(OFFSET_TO_POINTS, "I", 2**32 - 1), "header-size"),
    broken("billions of VLRs", ".las", poke(VLR_COUNT, "I", 2**32 - 1), "vlr"),
    broken("a VLR beyond the points", ".laz", poke(375 + 20, "H", 65535), "vlr"),
    broken("EVLRs beyond the file", ".las", poke(EVLR_START, "QI", 2**63, 1), "evlr"),
    broken("billions of EVLRs", ".las", poke(EVLR_START, "QI", 1000, 2**32 - 1), "evlr"),
    broken("no laszip VLR", ".laz", no_laszip, "laszip-vlr"),
    broken("unknown compressor", ".laz", poke_laszip(0, "H", 9), "laszip-vlr"),
    broken("chunks of 0 points", ".laz", poke_laszip(12, "I", 0), "laszip-vlr"),
    broken("thousands of items", ".laz", poke_laszip(32, "H", 65535), "laszip-vlr"),
    broken("items that do not add up", ".laz", poke_laszip(36, "H", 31), "laszip-vlr"),
    broken("items without points", ".laz", poke_laszip(34, "H", 14), "laszip-vlr"),
    broken("billions of chunks", ".laz", poke_table(4, "I", 2**32 - 1), "chunk-table"),
    broken("chunk table at a negative place", ".laz", lambda p: patch(p, peek(p, 96, "I"), "q", -7), "chunk-table"),
    broken("scale 0", ".las", poke(SCALES, "d", 0.0), "scale"),
    broken("scale negative", ".laz", poke(SCALES + 8, "d", -0.01), "scale"),
    broken("scale NaN", ".laz", poke(SCALES + 16, "d", float("nan")), "scale"),
    broken("offset infinite", ".laz", poke(OFFSETS, "d", float("inf")), "offset"),
    broken("scale absurd", ".laz", poke(SCALES, "d", 1e300), "range"),
]


@pytest.mark.parametrize(("suffix", "make", "code"), BROKEN)
def test_f1_to_f8_broken_headers(tmp_path, suffix, make, code):
    good, bad = write(tmp_path / "good.laz", points(100, 9)), write(tmp_path / f"bad{suffix}", points(1000))
    make(bad)
    with no_more_than(300_000), pytest.raises(Reject) as reject:
        read_header(str(bad))
    assert reject.value.code == code
    with pytest.raises(SurveyError, match=r"1 file cannot be used:\n.*bad\.la[sz]: .*\n.*--skip-bad"):
        scan(tmp_path)
    survey = scan(tmp_path, skip_bad=True)
    assert [t.path for t in survey.tiles] == [str(good)]
    assert [(p.path, p.code) for p in survey.problems if p.fatal] == [(str(bad), code)]


def test_only_bad_files(tmp_path):
    (tmp_path / "a.laz").write_bytes(b"")
    with pytest.raises(SurveyError, match="no tile is left"):
        scan(tmp_path, skip_bad=True)


def test_many_bad_files_are_named_up_to_five(tmp_path):
    for k in range(9):
        (tmp_path / f"{k}.laz").write_bytes(b"")
    with pytest.raises(SurveyError, match="9 files cannot be used") as error:
        scan(tmp_path)
    assert str(error.value).count(".laz: is empty") == 5
    assert "and 4 more" in str(error.value)


def test_a_pipe_does_not_hang_the_scan(tmp_path):
    os.mkfifo(tmp_path / "a.laz")
    with pytest.raises(SurveyError, match="is not a regular file"):
        scan(tmp_path)


def test_f24_permission_denied(tmp_path):
    """Really: as a user who may not, in a process of its own."""
    path = write(tmp_path / "a.laz", points(10))
    path.chmod(0)

    def life():
        if os.getuid() == 0:
            os.setuid(65534)
        with pytest.raises(Reject, match="may not be read") as reject:
            read_header(str(path))
        assert reject.value.code == "permission"

    assert in_child(life) == 0


def test_broken_symbolic_link(tmp_path):
    (tmp_path / "a.laz").symlink_to(tmp_path / "gone.laz")
    with pytest.raises(SurveyError, match=r"a\.laz: does not exist"):
        scan(tmp_path)


def test_stray_bytes_and_old_counts_are_only_noted(tmp_path):
    path = write(tmp_path / "a.las", points(10))
    with path.open("ab") as file:
        file.write(b"\0" * 29)
    patch(path, LEGACY_COUNT, "I", 3)
    survey = scan(path)
    assert {"trailing", "legacy-count"} <= set(codes(survey))
    assert survey.point_count == 10


def test_a_chunk_table_that_leaves_bytes_out_is_noted(tmp_path):
    path = write(tmp_path / "a.laz", points(1000))
    path.write_bytes(path.read_bytes()[:-5] + bytes(5))
    assert "chunk-table" in codes(scan(path))


def test_evlrs_behind_the_points(tmp_path):
    las = laspy.read(write(tmp_path / "a.las", points(10)))
    for suffix in (".las", ".laz"):
        las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("me", 7, "", b"x" * 100_000)])
        las.write(tmp_path / f"b{suffix}")
        tile = scan(tmp_path / f"b{suffix}").tiles[0]
        assert (tile.evlr_count, tile.point_count) == (1, 10)
        patch(tmp_path / f"b{suffix}", peek(tmp_path / f"b{suffix}", EVLR_START, "Q") + 20, "Q", 2**62)
        with pytest.raises(SurveyError, match=r"EVLR 0 at byte .* claims"):
            scan(tmp_path / f"b{suffix}")
    assert EVLR_COUNT == EVLR_START + 8


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_f6_no_points(tmp_path, suffix):
    survey = scan(write(tmp_path / f"a{suffix}", points(0), crs=UTM))
    assert survey.point_count == 0
    assert survey.bounds is None
    assert survey.tiles[0].bounds == Rect(0, 0, 0, 0)
    assert survey.tiles[0].density is None
    assert codes(survey) == ["no-points"]


@pytest.mark.parametrize(
    "values",
    [
        (0.0,) * 6,
        (float("nan"),) * 6,
        (1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        (1e308, -1e308) * 3,
        (float("inf"), float("-inf")) * 3,
        (1e6, -1e6) * 3,
    ],
)
def test_f7_impossible_bounds_are_measured(tmp_path, values):
    path = write(tmp_path / "a.laz", points(500))
    right = scan(path).tiles[0]
    patch(path, BOUNDS, "6d", *values)
    survey = scan(path)
    assert survey.tiles[0].bounds == right.bounds
    assert survey.tiles[0].z_range == pytest.approx(right.z_range, abs=1e-9)
    assert "bounds" in codes(survey)


def test_f7_impossible_bounds_over_a_broken_body(tmp_path):
    path = patch(write(tmp_path / "a.laz", points(60_000)), BOUNDS, "6d", *(float("nan"),) * 6)
    patch(path, COUNT, "Q", 59_999)
    with pytest.raises(SurveyError, match="holds 60000 points but its header says 59999"):
        scan(path)


# --- CRS and units -------------------------------------------------------------------------------------------------


def with_wkt(path, text, seed=0):
    las = laspy.read(write(path, points(20, seed)))
    record = text if isinstance(text, bytes) else text.encode() + b"\0"
    las.header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", record))
    las.header.global_encoding.wkt = True
    las.write(path)
    return path


def with_keys(path, keys, seed=0):
    las = laspy.read(write(path, points(20, seed), point_format=1, version="1.2"))
    flat = [1, 1, 0, len(keys), *(v for key, value in keys.items() for v in (key, 0, 1, value))]
    las.header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", np.array(flat, "<u2").tobytes()))
    las.write(path)
    return path


def test_f12_one_crs_in_many_spellings(tmp_path):
    crs = pyproj.CRS.from_epsg(25832)
    gdal = crs.to_wkt("WKT1_GDAL")
    spellings = [gdal, crs.to_wkt("WKT1_ESRI"), crs.to_wkt("WKT2_2015"), crs.to_wkt("WKT2_2019", pretty=True)]
    spellings.append(gdal.replace("ETRS89 / UTM zone 32N", "our own name"))
    spellings.append("".join(part.split("]", 1)[1] if k else part for k, part in enumerate(gdal.split(",AUTHORITY["))))
    for k, text in enumerate(spellings):
        with_wkt(tmp_path / f"{k}.laz", text, k)
    with_keys(tmp_path / "keys.laz", {1024: 1, 3072: 25832}, 50)
    with_keys(tmp_path / "keys with unit.laz", {1024: 1, 3072: 25832, 3076: 9001}, 51)
    survey = scan(tmp_path)
    assert len(survey.tiles) == len(spellings) + 2
    assert (survey.unit_xy, survey.unit_z) == (1.0, 1.0)
    assert pyproj.CRS.from_wkt(survey.crs).equals(crs)
    assert len({t.crs for t in survey.tiles}) == 1


def test_f12_a_true_mix_is_refused_by_name(tmp_path):
    for name, crs in (("a", 25832), ("b", 25833), ("c", 25832)):
        write(tmp_path / f"{name}.laz", points(20), crs=crs)
    with pytest.raises(
        SurveyError, match=r"(?s)different.*zone 32N \(EPSG:25832\), 2 tiles:.*a\.laz.*c\.laz.*33N.*b\.laz"
    ):
        scan(tmp_path)


def test_f12_missing_in_some(tmp_path):
    write(tmp_path / "a.laz", points(20), crs=UTM)
    write(tmp_path / "b.laz", points(20, 1))
    with pytest.raises(SurveyError, match=r"(?s)1 of 2 tiles have no CRS:.*b\.laz.*--assume-crs"):
        scan(tmp_path)
    assert len(scan(tmp_path, assume_crs=UTM).tiles) == 2
    with pytest.raises(SurveyError, match="different coordinate reference systems"):
        scan(tmp_path, assume_crs="EPSG:25833")


def test_f12_missing_in_all(tmp_path):
    write(tmp_path / "a.laz", points(20))
    survey = scan(tmp_path)
    assert (survey.crs, survey.unit_xy, survey.unit_z) == (None, 1.0, 1.0)
    assert codes(survey) == ["crs-missing"]
    assert scan(tmp_path, assume_units="us-ft").unit_xy == US_FOOT
    assert pyproj.CRS.from_wkt(scan(tmp_path, assume_crs="EPSG:25832+7837").crs).is_compound


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:4258+7837", "EPSG:4979"])
def test_f12_degrees(tmp_path, crs):
    write(tmp_path / "a.laz", points(20), crs=crs)
    with pytest.raises(SurveyError, match=r"is in degrees .*reproject it"):
        scan(tmp_path)
    with pytest.raises(SurveyError, match="is in degrees"):
        scan(tmp_path, assume_units="m")
    with_keys(tmp_path / "a.laz", {1024: 2, 2048: 4326})
    with pytest.raises(SurveyError, match="is in degrees"):
        scan(tmp_path)


def test_f12_degrees_without_a_crs(tmp_path):
    mm = np.column_stack([np.arange(5) + 5000, np.arange(5) + 45_000, np.arange(5)])
    path = write(tmp_path / "a.laz", mm, scale=1e-7, offset=(0, 0, 0))
    with pytest.raises(SurveyError, match="looks like degrees"):
        scan(path)
    assert scan(path, assume_units="m").unit_xy == 1.0


def test_geocentric_is_refused(tmp_path):
    write(tmp_path / "a.laz", points(20), crs="EPSG:4978")
    with pytest.raises(SurveyError, match="without a horizontal plane"):
        scan(tmp_path)


@pytest.mark.parametrize(
    ("crs", "xy", "z"),
    [
        ("EPSG:2263", US_FOOT, US_FOOT),
        ("EPSG:2263+6360", US_FOOT, US_FOOT),
        ("EPSG:2263+5703", US_FOOT, 1.0),
        ("EPSG:6347+6360", 1.0, US_FOOT),
        ("EPSG:2222+8228", 0.3048, 0.3048),
        ("EPSG:25832+7837", 1.0, 1.0),
    ],
)
def test_f13_units(tmp_path, crs, xy, z):
    survey = scan(write(tmp_path / "a.laz", points(20), crs=crs))
    assert (survey.unit_xy, survey.unit_z) == (xy, z)
    assert ("height-unit" in codes(survey)) == (crs == "EPSG:2263")
    forced = scan(tmp_path, assume_units="ft")
    assert (forced.unit_xy, forced.unit_z) == (0.3048, 0.3048)
    header = laspy.read(tmp_path / "a.laz").header
    assert survey.bounds.x0 == pytest.approx(header.mins[0] * xy * 1000, abs=1)
    assert survey.tiles[0].z_range[1] == pytest.approx(header.maxs[2] * z)


def test_f13_heights_in_geotiff_keys(tmp_path):
    with_keys(tmp_path / "a.laz", {1024: 1, 3072: 6347, 4096: 5703, 4099: 9001})
    assert scan(tmp_path).unit_z == 1.0
    with_keys(tmp_path / "a.laz", {1024: 1, 3072: 6347, 4099: 9003})
    assert scan(tmp_path).unit_z == US_FOOT
    with_keys(tmp_path / "a.laz", {1024: 1, 3072: 6347, 4096: 6360})
    assert scan(tmp_path).unit_z == US_FOOT


def test_f13_contradicting_units_need_a_word(tmp_path):
    with_keys(tmp_path / "a.laz", {1024: 1, 3072: 32617, 3076: 9003})
    with pytest.raises(
        SurveyError, match=r"says its unit is US survey foot but that of EPSG:32617 is metre.*--assume-units"
    ):
        scan(tmp_path)
    assert scan(tmp_path, assume_units="us-ft").unit_xy == US_FOOT


@pytest.mark.parametrize("text", ["PROJCS[", "hello", "[" * 10_000, b"\xff\xfe\xfd", "GEOGCS[" * 500])
def test_f12_a_crs_that_cannot_be_read(tmp_path, text):
    path = with_wkt(tmp_path / "a.laz", text)
    with pytest.raises(SurveyError, match=r"a\.laz: has a CRS.*--assume-(crs|units)"):
        scan(path)
    assert scan(path, assume_units="ft").unit_xy == 0.3048
    user = with_keys(tmp_path / "b.laz", {1024: 1, 3072: 32767})
    with pytest.raises(SurveyError, match="GeoTIFF keys whose CRS cannot be understood"):
        scan(user)
    assert scan(user, assume_crs=UTM).unit_xy == 1.0


def test_heights_that_disagree(tmp_path):
    write(tmp_path / "a.laz", points(20), crs="EPSG:25832+7837")
    write(tmp_path / "b.laz", points(20, 1), crs="EPSG:25832")
    survey = scan(tmp_path)
    assert codes(survey) == ["height-missing"]
    assert pyproj.CRS.from_wkt(survey.crs).is_compound
    write(tmp_path / "b.laz", points(20, 1), crs="EPSG:25832+6360")
    with pytest.raises(SurveyError, match="different"):
        scan(tmp_path)


def test_f16_wkt_bit_unset(tmp_path):
    path = write(tmp_path / "a.laz", points(20), crs=UTM)
    patch(path, 6, "H", 0)
    assert codes(scan(path)) == ["wkt-bit"]


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=200), st.binary(max_size=80), st.booleans())
def test_hostile_crs_records_never_raise(wkt, keys, first):
    from ppdf_dask.crs import from_records

    real = pyproj.CRS.from_epsg(2263).to_wkt("WKT1_GDAL").encode()
    cut = len(wkt) * len(real) // 200
    for record in (wkt, real[:cut] + wkt + real[cut:]):
        frame = from_records(record, keys, first)
        assert frame.fault is None or frame.unit_xy is None or frame.wkt is not None


def test_a_user_who_mistypes(tmp_path):
    path = write(tmp_path / "a.laz", points(20))
    for options, text in (
        ({"assume_crs": "EPSG:nonsense"}, "assume_crs = 'EPSG:nonsense' is not a known"),
        ({"assume_crs": "EPSG:4326"}, "is in degrees"),
        ({"assume_units": "yard"}, "assume_units = 'yard' is unknown"),
        ({"duplicates": "both"}, "duplicates = 'both' is unknown"),
    ):
        with pytest.raises(SurveyError, match=text):
            scan(path, **options)


# --- the same file twice, and overlaps -----------------------------------------------------------------------------


def test_f11_named_twice(tmp_path):
    path = write(tmp_path / "a.laz", points(20))
    with pytest.raises(SurveyError, match=r"a\.laz is named twice"):
        scan([path, tmp_path])
    for policy in ("keep", "first"):
        survey = scan([path, tmp_path], duplicates=policy)
        assert [t.path for t in survey.tiles] == [str(path)]
        assert "duplicate" in codes(survey)


@pytest.mark.parametrize("link", [True, False])
def test_f11_copies_and_links(tmp_path, link):
    a = write(tmp_path / "a.laz", points(20))
    write(tmp_path / "c.laz", points(20, 1))
    b = tmp_path / "b.laz"
    if link:
        b.symlink_to(a)
    else:
        shutil.copy(a, b)
    with pytest.raises(SurveyError, match=r"(?s)there twice.*b\.laz has the content of .*a\.laz.*--duplicates"):
        scan(tmp_path)
    assert [t.name for t in scan(tmp_path, duplicates="keep").tiles] == ["a.laz", "b.laz", "c.laz"]
    survey = scan(tmp_path, duplicates="first")
    assert [t.name for t in survey.tiles] == ["a.laz", "c.laz"]
    assert codes(survey) == ["crs-missing", "duplicate"]


def test_f11_equal_headers_are_not_enough(tmp_path):
    """Same size, bounds and count, one point another: no duplicate, but the same points."""
    mm = points(20)
    inner = mm.copy()
    middle = [k for k in range(20) if not any(mm[k, c] in (mm[:, c].min(), mm[:, c].max()) for c in range(3))]
    inner[middle[0], 2] += 1
    write(tmp_path / "a.las", mm)
    write(tmp_path / "b.las", inner)
    with pytest.raises(SurveyError, match="95% of their points there in common"):
        scan(tmp_path)
    assert "duplicate" not in codes(scan(tmp_path, duplicates="keep"))


def tile_at(name, x0, y0, x1, y1, n=10):
    numbers = {"size": 1, "mtime_ns": 1, "record_length": 30, "point_format": 6, "first_returns": n, "evlr_count": 0}
    return Tile(
        path=name,
        name=name,
        version="1.4",
        point_count=n,
        scales=(0.01,) * 3,
        offsets=(0.0,) * 3,
        bounds=Rect(x0, y0, x1, y1),
        z_range=(0.0, 1.0),
        crs=None,
        compressed=True,
        copc=False,
        guid="0" * 32,
        **numbers,
    )


def test_f11_a_millimetre_is_tolerated():
    """Half-open boxes: a last point at 1000 mm makes x1 = 1001."""
    a = tile_at("a", 0, 0, 1001, 1001)
    assert find_overlaps([a, tile_at("b", 1000, 0, 2001, 1001)]) == ()
    assert find_overlaps([a, tile_at("b", 999, 0, 2001, 1001)]) == ()
    (found,) = find_overlaps([a, tile_at("b", 998, 0, 2001, 1001)])
    assert (found.first, found.second, found.share) == ("a", "b", 3 / 1001)
    assert find_overlaps([a, tile_at("b", 0, 998, 1001, 2001)])[0].share == 3 / 1001
    (inside,) = find_overlaps([tile_at("z", 100, 100, 200, 200), a])
    assert (inside.first, inside.second, inside.share) == ("a", "z", 1.0)
    assert find_overlaps([a, tile_at("empty", 0, 0, 1001, 1001, n=0)]) == ()


edges = st.tuples(st.integers(-50, 50), st.integers(-50, 50), st.integers(1, 60), st.integers(1, 60))


@settings(max_examples=150, deadline=None)
@given(st.lists(edges, max_size=25))
def test_overlaps_against_every_pair(boxes):
    tiles = [tile_at(f"{k:02d}", x, y, x + w, y + h) for k, (x, y, w, h) in enumerate(boxes)]
    expected = []
    for i, a in enumerate(tiles):
        for b in tiles[i + 1 :]:
            w = min(a.bounds.x1, b.bounds.x1) - max(a.bounds.x0, b.bounds.x0)
            h = min(a.bounds.y1, b.bounds.y1) - max(a.bounds.y0, b.bounds.y0)
            if w > 2 and h > 2:
                area = min(t.bounds.width * t.bounds.height for t in (a, b))
                expected.append((a.path, b.path, w * h / area))
    assert [(o.first, o.second, o.share) for o in find_overlaps(tiles)] == sorted(expected)


def test_f40_overlaps_of_a_hundred_thousand_tiles(monkeypatch):
    """Counted, not timed: the candidates looked at stay near one column of the mosaic per tile."""
    from ppdf_dask import pairs

    seen = []
    real = pairs._candidates

    def counted(boxes, axis, slack):
        seen.append(real(boxes, axis, slack))
        return seen[-1]

    monkeypatch.setattr(pairs, "_candidates", counted)
    side = 316
    tiles = [
        tile_at(f"{i:03d}_{j:03d}", i * 1000, j * 1000, i * 1000 + 1000, j * 1000 + 1000)
        for i in range(side)
        for j in range(side)
    ]
    tiles.append(tile_at("x", 500, 500, 1400, 900))
    assert [(o.first, o.second) for o in find_overlaps(tiles)] == [("000_000", "x"), ("001_000", "x")]
    assert min(seen) <= 2 * side * len(tiles)


# --- shown to people -----------------------------------------------------------------------------------------------


def test_f58_hostile_names_are_escaped(tmp_path):
    name = "<img src=x onerror=alert(1)>&\"'.laz"
    write(tmp_path / name, points(50), crs=UTM)
    write(tmp_path / "b.laz", points(60), crs=UTM)
    survey = scan(tmp_path)
    assert len(survey.overlaps) == 1
    html = survey._repr_html_()
    assert "<img" not in html
    ElementTree.fromstring(html)
    text = repr(survey)
    for fact in ("tiles: 2", "points: 110", "EPSG:25832", "metre (x, y), metre (z)", "overlaps: 1 pairs", "b.laz"):
        assert fact in text
        assert fact in text or fact in html


def test_svg_of_many_patches_stays_small():
    from ppdf_dask.maps import Patch, svg_map

    def rect(k):
        return Rect(k % 150 * 10, k // 150 * 10, k % 150 * 10 + 10, k // 150 * 10 + 10)

    few = [Patch(rect(k), "\x00<&>", "red") for k in range(100)]
    root = ElementTree.fromstring(svg_map(few, legend={"red": "<late>"}))
    assert len(root.findall("{*}rect")) == 101
    many = [Patch(rect(k), "a", "blue" if k % 3 else "#123456") for k in range(30_000)]
    root = ElementTree.fromstring(svg_map(many))
    drawn = root.findall("{*}rect")
    assert len(drawn) <= 64 * 64
    assert sum(int(r.find("{*}title").text.split()[0]) for r in drawn) == 30_000
    assert {r.get("fill") for r in drawn} == {"#0072B2"}
    assert svg_map([]) == ""
    with pytest.raises(ValueError, match="colour"):
        svg_map([Patch(rect(0), "", 'red" onload="x')])


def test_long_surveys_are_cut_short(tmp_path):
    tiles = tuple(tile_at(f"{k:04d}.laz", k, 0, k + 1, 1) for k in range(500))
    problems = tuple(Problem(f"{k}.laz", "x", "is odd", False) for k in range(500))
    survey = Survey(tiles, "/", None, 1.0, 1.0, problems)
    assert "and 480 more tiles" in repr(survey)
    assert len(repr(survey).splitlines()) < 60
    assert "and 480 more tiles" in survey._repr_html_()


def test_files_are_listed_once_per_mention(tmp_path):
    path = write(tmp_path / "a.laz", points(5))
    files, root = find_files([path, tmp_path])
    assert files == [str(path)] * 2
    assert root == str(tmp_path)
