"""Eligibility and written classes: the vectorised rules against the table, point by point."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ppdf_dask.classes import Dims, check_writable, eligible, fixed_ground, last_returns, new_classes, odd_returns
from ppdf_dask.errors import ParameterError
from ppdf_dask.params import ClassRules


def oracle_seen(point, rules, returns, point_format):
    """The table of design section 5, read aloud."""
    rn, nr, cls, withheld, synthetic, overlap = point
    if withheld and not rules.use_withheld:
        return False
    if rules.skip_overlap and (overlap or (point_format <= 5 and cls == 12)):
        return False
    if rules.from_classes is None and synthetic:
        return False
    if rules.mode == "refine" and cls == 2:
        return True
    last = (rn == 0 and nr == 0) or rn == nr or rn == 0 or rn > nr
    if returns == "last" and not last:
        return False
    if rules.from_classes is not None:
        return cls in rules.from_classes
    return cls not in (7, 18, 9) and cls < 64


def oracle_class(old, seen, ground, rules):
    if not seen:
        return old
    if rules.mode == "refine" and old == 2:
        return 2
    if ground:
        return rules.ground_class
    if rules.mode == "reset" or (rules.mode == "update" and old == 2):
        return 1
    return old


def dims_of(rows):
    a = np.array(rows, np.uint8).reshape(-1, 6)
    return Dims(a[:, 0], a[:, 1], a[:, 2], *(a[:, k].astype(bool) for k in (3, 4, 5)))


interesting = st.sampled_from([0, 1, 2, 3, 5, 6, 7, 9, 12, 17, 18, 31, 63, 64, 65, 200, 255])
rows = st.lists(
    st.tuples(st.integers(0, 15), st.integers(0, 15), interesting, st.booleans(), st.booleans(), st.booleans()),
    max_size=40,
)
some_rules = st.builds(
    ClassRules,
    mode=st.sampled_from(["update", "refine", "reset"]),
    ground_class=st.sampled_from([2, 8, 40]),
    from_classes=st.none() | st.lists(interesting, max_size=4).map(tuple),
    skip_overlap=st.booleans(),
    use_withheld=st.booleans(),
)


@settings(max_examples=200, deadline=None)
@given(rows, some_rules, st.sampled_from(["last", "all"]), st.integers(0, 10), st.randoms(use_true_random=False))
def test_rules_are_those_of_the_table(points, rules, returns, point_format, random):
    dims = dims_of(points)
    seen = eligible(dims, rules, returns, point_format)
    assert seen.tolist() == [oracle_seen(p, rules, returns, point_format) for p in points]
    ground = np.array([random.random() < 0.5 for _ in points], bool)
    got = new_classes(dims.classification, seen, ground, rules)
    assert got.dtype == np.uint8
    expected = [oracle_class(p[2], s, g, rules) for p, s, g in zip(points, seen, ground, strict=True)]
    assert got.tolist() == expected
    fixed = fixed_ground(dims.classification, seen, rules)
    assert fixed.tolist() == [
        bool(s) and rules.mode == "refine" and p[2] == 2 for p, s in zip(points, seen, strict=True)
    ]


@pytest.mark.parametrize(
    ("number", "total", "last"),
    [(0, 0, True), (1, 1, True), (1, 2, False), (2, 2, True), (0, 3, True), (4, 3, True), (2, 3, False)],
)
def test_f17_return_numbers(number, total, last):
    assert last_returns(dims_of([(number, total, 1, 0, 0, 0)])).tolist() == [last]


def test_f17_odd_return_numbers_are_counted():
    pairs = [(0, 0), (0, 0), (0, 2), (3, 2), (1, 1), (1, 2)]
    assert odd_returns(dims_of([(*p, 1, 0, 0, 0) for p in pairs])) == (2, 2)


@pytest.mark.parametrize("cls", [7, 9, 18, 64, 65, 66, 68, 255])
def test_f18_noise_water_and_user_classes_are_seen_only_when_named(cls):
    dims = dims_of([(1, 1, cls, 0, 0, 0)])
    assert not eligible(dims, ClassRules(), "last", 6).any()
    assert eligible(dims, ClassRules(from_classes=(cls,)), "last", 6).all()


def test_f18_synthetic_and_withheld():
    synthetic, withheld = dims_of([(1, 1, 1, 0, 1, 0)]), dims_of([(1, 1, 1, 1, 0, 0)])
    assert not eligible(synthetic, ClassRules(), "last", 6).any()
    assert eligible(synthetic, ClassRules(from_classes=(1,)), "last", 6).all()
    assert not eligible(withheld, ClassRules(from_classes=(1,)), "last", 6).any()
    assert eligible(withheld, ClassRules(use_withheld=True), "last", 6).all()


def test_f18_class_12_is_overlap_in_old_formats_only():
    dims = dims_of([(1, 1, 12, 0, 0, 0)])
    rules = ClassRules(skip_overlap=True)
    assert [bool(eligible(dims, rules, "last", f)[0]) for f in (0, 5, 6, 10)] == [False, False, True, True]
    assert eligible(dims, ClassRules(), "last", 0).all()


def test_refine_keeps_a_first_return_ground_point_as_reference():
    dims = dims_of([(1, 2, 2, 0, 0, 0)])
    assert not eligible(dims, ClassRules(), "last", 6).any()
    assert eligible(dims, ClassRules(mode="refine"), "last", 6).all()


def test_inputs_are_not_changed():
    old = np.array([2, 1], np.uint8)
    new_classes(old, np.array([True, True]), np.array([False, True]), ClassRules())
    assert old.tolist() == [2, 1]


@pytest.mark.parametrize("point_format", range(11))
def test_class_over_31_needs_format_6(point_format):
    check_writable(ClassRules(ground_class=31), point_format, "a.laz")
    if point_format >= 6:
        check_writable(ClassRules(ground_class=255), point_format, "a.laz")
        return
    with pytest.raises(ParameterError, match=r"ground_class = 32 does not fit a\.laz: point format"):
        check_writable(ClassRules(ground_class=32), point_format, "a.laz")


def test_every_byte_of_a_record_is_unpacked_as_laspy_does():
    """All 256 values of each of the three bytes, against the second reader's bit masks."""
    import laspy

    for point_format in (3, 6):
        legacy = point_format < 6
        record = laspy.PackedPointRecord.zeros(256 * 3, laspy.PointFormat(point_format))
        names = (
            ("bit_fields", "raw_classification") if legacy else ("bit_fields", "classification_flags", "classification")
        )
        values = np.tile(np.arange(256, dtype=np.uint8), 3)
        for name, shift in zip(names, itertools.count()):
            record.array[name] = np.roll(values, 85 * shift)
        flat = record.array
        second = None if legacy else flat[names[2]]
        dims = Dims.unpack(flat[names[0]], flat[names[1]], second)
        for name in ("return_number", "number_of_returns", "classification", "withheld", "synthetic"):
            assert (getattr(dims, name) == np.asarray(record[name])).all(), name
        overlap = np.zeros(len(values), bool) if legacy else np.asarray(record["overlap"])
        assert (dims.overlap == overlap).all()
