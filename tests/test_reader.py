"""Streaming decode: exact integers whatever the file's scale, offset, unit and batches; broken bodies by name."""

import os
import tracemalloc
from fractions import Fraction
from math import ceil, floor

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lasfiles import COUNT, OFFSETS, SCALES, laszip_record, no_more_than, patch, peek, points, write

from ppdf_dask.errors import SurveyError, TileError
from ppdf_dask.filters.cloud import to_grid
from ppdf_dask.params import ClassRules
from ppdf_dask.reader import BATCH, GridAxis, batches
from ppdf_dask.survey import scan


def decode(path, size=BATCH, rules=None, returns="all", **options):
    survey = scan(path, **options)
    units = {"unit_xy": survey.unit_xy, "unit_z": survey.unit_z}
    rules = ClassRules() if rules is None else rules
    return list(batches(survey.tiles[0], rules=rules, returns=returns, size=size, **units))


def mm(found):
    return np.column_stack([np.concatenate([getattr(b, name) for b in found]) for name in "xyz"])


def joined(found, name):
    return np.concatenate([getattr(b, name) for b in found])


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", range(11))
def test_every_point_format_agrees_with_laspy(tmp_path, point_format, suffix):
    rng = np.random.default_rng(point_format)
    n = 2500
    top = 32 if point_format < 6 else 256
    path = write(
        tmp_path / f"a{suffix}",
        points(n),
        point_format=point_format,
        return_number=rng.integers(0, 8, n),
        number_of_returns=rng.integers(0, 8, n),
        classification=rng.integers(0, top, n),
        withheld=rng.integers(0, 2, n),
        synthetic=rng.integers(0, 2, n),
    )
    las = laspy.read(path)
    found = decode(path, size=1000)
    assert [b.n for b in found] == [1000, 1000, 500]
    assert [b.start for b in found] == [0, 1000, 2000]
    assert (mm(found) == points(n)).all()
    assert (joined(found, "classification") == np.asarray(las.classification)).all()
    use = ClassRules(from_classes=tuple(range(256)))
    assert (joined(decode(path, rules=use), "eligible") == (np.asarray(las.withheld) == 0)).all()
    last = joined(
        decode(path, rules=ClassRules(from_classes=tuple(range(256)), use_withheld=True), returns="last"), "eligible"
    )
    rn, nr = np.asarray(las.return_number), np.asarray(las.number_of_returns)
    assert (last == ((rn >= nr) | (rn == 0))).all()
    assert sum(b.no_returns for b in found) == ((rn == 0) & (nr == 0)).sum()
    assert sum(b.odd_returns for b in found) == (((rn == 0) & (nr > 0)) | (rn > nr)).sum()


def test_extra_bytes_do_not_shift_the_fields(tmp_path):
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = [0.001] * 3
    header.add_extra_dim(laspy.ExtraBytesParams(name="height", type="float64"))
    header.add_extra_dim(laspy.ExtraBytesParams(name="odd", type="3u1"))
    las = laspy.LasData(header)
    las.X, las.Y, las.Z = (np.arange(10, dtype=np.int32) * k for k in (1, 2, 3))
    las.classification = np.arange(10, dtype=np.uint8)
    for suffix in (".las", ".laz"):
        las.write(tmp_path / f"a{suffix}")
        found = decode(tmp_path / f"a{suffix}")
        assert mm(found).tolist() == [[i, 2 * i, 3 * i] for i in range(10)]
        assert joined(found, "classification").tolist() == list(range(10))


def test_batch_size_does_not_matter(tmp_path):
    path = write(tmp_path / "a.laz", points(1234))
    whole = mm(decode(path))
    for size in (1, 7, 1233, 1234, 1235):
        found = decode(path, size=size)
        assert (mm(found) == whole).all()
        assert all(b.n == size for b in found[:-1])


def test_scales_and_offsets_agree_to_the_last_bit(tmp_path):
    """The same places (multiples of 10 mm, which every scale can hold) in files with different integers."""
    rows = points(5000) // 10 * 10
    kinds = [
        (0.01, (917_000.0, 6_450_000.0, 0.0)),
        (0.001, (917_000.0, 6_450_000.0, 100.0)),
        (0.00025, (917_012.345, 6_450_099.99, 0.25)),
        (0.0001, (916_999.9999, 6_449_999.5, -7.0)),
        (0.01, (900_000.25, 6_500_000.75, 0.13)),
    ]
    for k, (scale, offset) in enumerate(kinds):
        shifted = rows + [round(1000 * o) % round(1000 * scale) if scale == 0.01 else 0 for o in offset]
        path = write(tmp_path / f"{k}.laz", shifted, scale=scale, offset=offset)
        assert (mm(decode(path)) == shifted).all(), (scale, offset)


def test_half_millimetres_go_up_whatever_the_offset(tmp_path):
    """0.5 mm steps: half of all places are ties; floats of different offsets carry different noise there."""
    steps = np.column_stack([np.arange(2001)] * 3)
    expected = (np.arange(2001) + 1) // 2
    for k, offset in enumerate([0.0, 917_000.0, 6_450_000.0]):
        path = write(tmp_path / f"{k}.laz", steps / 2 + 1000 * offset, scale=0.0005, offset=(offset,) * 3)
        assert (mm(decode(path)) == (expected + round(1000 * offset))[:, None]).all()


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from([0.01, 0.001, 0.00025, 0.0001, 0.0005, 0.1, 1.0, 1e-6, 0.0025, 0.003, 1 / 3, 1e-7]),
    st.sampled_from([0.0, 500_000.0, 5_400_000.0, -1234.5, 0.125, 49.02539999999999, 1e9, 600_000.0000001]),
    st.sampled_from([1.0, 0.3048, 1200 / 3937, 0.3048006096, 0.201168]),
    st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=30),
)
def test_grid_axis_is_exact(scale, offset, unit, values):
    """Against rational arithmetic: nearest micrometre, a half one down; then nearest millimetre, a half one up."""
    axis = GridAxis.of(scale, offset, unit)
    got = axis.to_mm(np.array(values, np.int32))
    exact_unit = {0.3048: Fraction(381, 1250), 1.0: Fraction(1), 0.201168: Fraction("0.201168")}
    factor = exact_unit.get(unit, Fraction(1200, 3937)) * 1_000_000
    for value, found in zip(values, got.tolist(), strict=True):
        micro = (value * Fraction(repr(scale)) + Fraction(repr(offset))) * factor
        nearest = floor(Fraction(ceil(micro - Fraction(1, 2)) + 500, 1000))
        if axis.parts:
            assert found == nearest
        else:  # floats: at most the neighbour, and only when the noise (4 roundings of 2**-53) can reach the tie
            noise = abs(micro) * Fraction(4, 2**53) + 1
            near_tie = abs(micro - (floor(micro / 1000) * 1000 + 500)) <= noise
            assert found == nearest or (near_tie and abs(found - nearest) == 1)


def test_a_half_micrometre_does_not_lift_a_half_millimetre():
    """Tenths of micrometres: 499.5 goes to 499 and so to 0 mm, which is the nearest one."""
    values = np.array([4994, 4995, 4996, 5000, 5005, -4995, -5005], np.int32)
    assert GridAxis.of(1e-7, 0.0, 1.0).to_mm(values).tolist() == [0, 0, 1, 1, 1, 0, -1]


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from([0.01, 0.001, 0.00025, 0.0005, 1e-5]),
    st.sampled_from([0.0, 500_000.0, 6_450_000.0, -1234.5]),
    st.lists(st.integers(-(2**27), 2**27), min_size=1, max_size=50),
)
def test_integers_agree_with_metres(scale, offset, values):
    """A run over a file and `classify_ground` over its coordinates in metres see the same places."""
    integers = np.array(values, np.int32)
    assert (GridAxis.of(scale, offset, 1.0).to_mm(integers) == to_grid(integers * scale + offset)).all()


@pytest.mark.parametrize(
    ("crs", "feet"), [("EPSG:2263+6360", Fraction(1200, 3937)), ("EPSG:2222+8228", Fraction(381, 1250))]
)
def test_f13_feet_become_exact_millimetres(tmp_path, crs, feet):
    path = write(tmp_path / "a.laz", points(500), crs=crs, scale=0.01, offset=(0.0, 0.0, 0.0))
    las = laspy.read(path)
    found = mm(decode(path))
    for column, name in enumerate("XYZ"):
        exact = [Fraction(int(v), 100) * feet * 1000 for v in np.asarray(las[name])]
        assert found[:, column].tolist() == [floor(v + Fraction(1, 2)) for v in exact]


def test_f13_foot_copy_equals_metre_copy_where_it_is_exact(tmp_path):
    """Multiples of 0.3048 m are whole feet."""
    feet = np.column_stack([np.arange(900), np.arange(900) * 2 + 100_000, np.arange(900) % 77])
    foot = write(tmp_path / "ft.laz", feet * 1000, scale=0.01, offset=(0, 0, 0))
    metre = write(tmp_path / "m.laz", feet * 304.8, scale=0.0001, offset=(0, 0, 0))
    assert (mm(decode(foot, assume_units="ft")) == mm(decode(metre))).all()


def test_refine_marks_fixed_ground(tmp_path):
    classes = np.tile(np.array([1, 2, 5], np.uint8), 100)
    path = write(tmp_path / "a.laz", points(300), classification=classes, return_number=1, number_of_returns=2)
    found = decode(path, rules=ClassRules(mode="refine"), returns="last")
    assert (joined(found, "fixed") == (classes == 2)).all()
    assert (joined(found, "eligible") == (classes == 2)).all()
    assert not joined(decode(path), "fixed").any()


@pytest.mark.parametrize("n", [0, 1, 2])
def test_f6_few_points(tmp_path, n):
    for suffix in (".las", ".laz"):
        assert sum(b.n for b in decode(write(tmp_path / f"a{suffix}", points(n)))) == n


def test_several_chunks_of_laz(tmp_path):
    rows = points(120_001)
    for point_format in (3, 6):
        assert (mm(decode(write(tmp_path / "a.laz", rows, point_format=point_format), size=33_333)) == rows).all()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_f23_changed_since_the_scan(tmp_path, suffix):
    path = write(tmp_path / f"a{suffix}", points(3000))
    tile = scan(path).tiles[0]

    def read():
        return batches(tile, unit_xy=1.0, unit_z=1.0, rules=ClassRules(), returns="all", size=1000)

    half = read()
    next(half)
    os.utime(path, ns=(1, 1))
    with pytest.raises(TileError, match=r"a\.la[sz] changed since the scan: .* mtime 1 ns now; scan again"):
        list(half)
    with pytest.raises(TileError, match="changed since the scan"):
        list(read())
    path.unlink()
    with pytest.raises(TileError, match="cannot be read now"):
        list(read())


def cut(tile, path, length):
    """Shorten a file under a tile that was scanned before, and let it look unchanged."""
    import dataclasses

    os.truncate(path, length)
    status = path.stat()
    return dataclasses.replace(tile, size=status.st_size, mtime_ns=status.st_mtime_ns)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", [1, 6])
def test_f2_f3_cut_bodies(tmp_path, suffix, point_format):
    path = write(tmp_path / f"a{suffix}", points(2000), point_format=point_format)
    tile = scan(path).tiles[0]
    for share in (0.9, 0.6, 0.3):
        short = cut(tile, path, int(path.stat().st_size * share))
        with pytest.raises(TileError, match=r"a\.la[sz]"):
            list(batches(short, unit_xy=1.0, unit_z=1.0, rules=ClassRules(), returns="all"))


@pytest.mark.parametrize("point_format", [6, 7, 10])
@pytest.mark.parametrize("change", [-1, 1, 37])
def test_f3_layered_laz_with_a_wrong_count(tmp_path, point_format, change):
    path = write(tmp_path / "a.laz", points(60_000), point_format=point_format)
    patch(path, COUNT, "Q", 60_000 + change)
    with pytest.raises(TileError, match=f"holds 60000 points but its header says {60_000 + change}"):
        decode(path)


def test_f3_old_laz_with_a_larger_count(tmp_path):
    path = write(tmp_path / "a.laz", points(60_000), point_format=1, version="1.2")
    patch(path, 107, "I", 61_000)
    with pytest.raises(TileError, match="cannot be decoded between points 0 and 61000"):
        decode(path)


def test_f5_f56_lying_layer_size_is_refused_before_decoding(tmp_path):
    path = write(tmp_path / "a.laz", points(1000))
    first = peek(path, 96, "I") + 8 + 30
    assert peek(path, first, "I") == 1000
    patch(path, first + 4 + 8, "I", 2**32 - 1)
    with no_more_than(5_000_000), pytest.raises(TileError, match="chunk 0 claims to reach byte"):
        decode(path)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_f5_flipped_bytes_end_in_points_or_a_tile_error(tmp_path_factory, data):
    """Any byte of a file: every answer but a refusal has as many points as the header says."""
    folder = tmp_path_factory.mktemp("flip")
    suffix = data.draw(st.sampled_from([".las", ".laz"]))
    path = write(folder / f"a{suffix}", points(300), point_format=data.draw(st.sampled_from([1, 3, 6, 7])))
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(raw)
    # 1000 records of at most 64 kB, a few times over.
    with no_more_than(1000 * 65536 * 3):
        try:
            survey = scan(path, assume_units="m")
            tile = survey.tiles[0]
            found = batches(tile, unit_xy=1.0, unit_z=1.0, rules=ClassRules(), returns="all", size=1000)
            read, said = sum(b.n for b in found), ""
        except SurveyError as error:
            read, said = None, str(error)
    assert str(path) in said or read == tile.point_count


def test_memory_grows_with_the_batch_not_with_the_file(tmp_path):
    peaks = []
    for n in (20_000, 200_000):
        path = write(tmp_path / f"{n}.laz", points(n))
        tile = scan(path).tiles[0]
        tracemalloc.start()
        for batch in batches(tile, unit_xy=1.0, unit_z=1.0, rules=ClassRules(), returns="all", size=5000):
            assert batch.n == 5000
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


def test_variable_chunks_as_copc_has_them(tmp_path):
    import io
    import struct

    import lazrs

    source = write(tmp_path / "a.las", points(1000))
    head = source.read_bytes()
    start = struct.unpack_from("<I", head, 96)[0]
    vlr = lazrs.LazVlr.new_for_compression(6, 0, True)
    record = vlr.record_data()
    entry = struct.pack("<H16sHH32s", 0, b"laszip encoded", 22204, len(record), b"") + record
    body = io.BytesIO()
    body.write(head[:start] + entry)
    compressor = lazrs.LasZipCompressor(body, vlr)
    sizes = [1, 600, 99, 300]
    done = 0
    for size in sizes:
        compressor.compress_many(np.frombuffer(head[start + 30 * done : start + 30 * (done + size)], np.uint8))
        compressor.finish_current_chunk()
        done += size
    compressor.done()
    path = tmp_path / "b.laz"
    path.write_bytes(body.getvalue())
    patch(path, 96, "I", start + len(entry))
    patch(path, 100, "I", peek(path, 100, "I") + 1)
    patch(path, 104, "B", 6 | 0x80)
    assert peek(path, laszip_record(path) + 12, "I") == 0xFFFFFFFF
    assert (mm(decode(path)) == points(1000)).all()
    assert (mm(decode(path, size=77)) == points(1000)).all()


def test_scale_and_offset_are_read_where_the_specification_puts_them(tmp_path):
    path = write(tmp_path / "a.laz", points(5), scale=0.01)
    patch(path, SCALES, "ddd", 1.0, 2.0, 3.0)
    patch(path, OFFSETS, "ddd", 10.0, 20.0, 30.0)
    las = laspy.read(path)
    expected = np.column_stack(
        [np.asarray(las[n], np.int64) * s + 10 * s for n, s in zip("XYZ", (1, 2, 3), strict=True)]
    )
    assert (mm(decode(path)) == expected * 1000).all()
