"""Which points a filter sees and which classes are written: pure functions for the table of design section 5.

| | robust | paper | changed by |
|---|---|---|---|
| returns | last and only (0 of 0 counts as only) | all | `ClassRules.returns` |
| withheld | not seen | not seen | `use_withheld` |
| noise 7, 18; water 9; 64 and up; synthetic flag | not seen | not seen | `from_classes` |
| overlap flag, old class 12 | seen | seen | `skip_overlap` |
| existing 2 | seen, may become 1 | the same | mode ``"refine"``: stays 2 and is a reference |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from ppdf_dask.errors import ParameterError
from ppdf_dask.params import ClassRules

Bytes = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]

UNCLASSIFIED, GROUND, LOW_NOISE, WATER, OLD_OVERLAP, HIGH_NOISE = 1, 2, 7, 9, 12, 18
FIRST_USER_CLASS = 64
LEGACY_FORMATS = range(6)
LARGEST_LEGACY_CLASS = 31

_NEVER_GROUND = np.zeros(256, np.bool_)
_NEVER_GROUND[[LOW_NOISE, WATER, HIGH_NOISE]] = True
_NEVER_GROUND[FIRST_USER_CLASS:] = True


@dataclass(frozen=True)
class Dims:
    """What decides whether a point is seen, unpacked from its record.

    Attributes
    ----------
    return_number, number_of_returns, classification : ndarray of uint8, shape (n,)
        As stored.
    withheld, synthetic, overlap : ndarray of bool, shape (n,)
        The flags. Point formats 0 to 5 have no overlap flag: there class 12 stands for it, and `overlap` is False.
    """

    return_number: Bytes
    number_of_returns: Bytes
    classification: Bytes
    withheld: Bools
    synthetic: Bools
    overlap: Bools

    @classmethod
    def unpack(cls, returns: Bytes, first: Bytes, second: Bytes | None) -> Dims:
        """Unpack the bytes of a point record (LAS 1.4 R15, tables 7 to 18).

        Parameters
        ----------
        returns : ndarray of uint8, shape (n,)
            Byte 14 of the record.
        first : ndarray of uint8, shape (n,)
            Byte 15: class and flags of formats 0 to 5, flags of formats 6 to 10.
        second : ndarray of uint8, shape (n,), or None
            Byte 16, the class of formats 6 to 10; None for formats 0 to 5.

        Returns
        -------
        Dims

        Examples
        --------
        >>> old = np.array([0b1000_0010], np.uint8)
        >>> dims = Dims.unpack(np.array([0b0001_0001], np.uint8), old, None)
        >>> dims.classification.tolist(), dims.withheld.tolist(), dims.number_of_returns.tolist()
        ([2], [True], [2])
        """
        if second is None:
            return cls(
                return_number=returns & np.uint8(0b111),
                number_of_returns=(returns >> np.uint8(3)) & np.uint8(0b111),
                classification=first & np.uint8(0b1_1111),
                withheld=(first & 0x80) != 0,
                synthetic=(first & 0x20) != 0,
                overlap=np.zeros(len(first), np.bool_),
            )
        return cls(
            return_number=returns & np.uint8(0b1111),
            number_of_returns=returns >> np.uint8(4),
            classification=second,
            withheld=(first & 0b100) != 0,
            synthetic=(first & 0b1) != 0,
            overlap=(first & 0b1000) != 0,
        )


def last_returns(dims: Dims) -> Bools:
    """Tell which points are last or only returns.

    0 of 0 counts as only; impossible numbers (0 of n, k of n with k > n) count as last, see `odd_returns`.

    Examples
    --------
    >>> zeros = np.zeros(5, np.bool_)
    >>> number, total = np.array([1, 2, 0, 0, 3], np.uint8), np.array([2, 2, 0, 4, 1], np.uint8)
    >>> last_returns(Dims(number, total, number, zeros, zeros, zeros)).tolist()
    [False, True, True, True, True]
    """
    last: Bools = (dims.return_number >= dims.number_of_returns) | (dims.return_number == 0)
    return last


def odd_returns(dims: Dims) -> tuple[int, int]:
    """Count points without return numbers (0 of 0) and with impossible ones (0 of n, k of n with k > n)."""
    none = (dims.return_number == 0) & (dims.number_of_returns == 0)
    wrong = ((dims.return_number == 0) & ~none) | (dims.return_number > dims.number_of_returns)
    return int(none.sum()), int(wrong.sum())


def eligible(dims: Dims, rules: ClassRules, returns: Literal["last", "all"], point_format: int) -> Bools:
    """Tell which points the filter sees.

    Parameters
    ----------
    dims : Dims
        The points.
    rules : ClassRules
        The user's rules; `ClassRules.returns` is not read here, since its default depends on the filter.
    returns : {"last", "all"}
        `RunParams.returns`.
    point_format : int
        0 to 10; in formats 0 to 5 class 12 means overlap.

    Returns
    -------
    ndarray of bool, shape (n,)
        With mode ``"refine"`` an existing ground point is seen whatever its return and `from_classes`, since it is a
        reference; its flags (withheld, overlap, synthetic) still count.
    """
    classes = dims.classification
    seen: Bools
    if rules.from_classes is None:
        seen = ~_NEVER_GROUND[classes] & ~dims.synthetic
    else:
        wanted = np.zeros(256, np.bool_)
        wanted[list(rules.from_classes)] = True
        seen = wanted[classes]
    if returns == "last":
        seen &= last_returns(dims)
    if rules.mode == "refine":
        reference = classes == GROUND
        seen |= reference if rules.from_classes is not None else reference & ~dims.synthetic
    if not rules.use_withheld:
        seen &= ~dims.withheld
    if rules.skip_overlap:
        seen &= ~dims.overlap
        if point_format in LEGACY_FORMATS:
            seen &= classes != OLD_OVERLAP
    return seen


def fixed_ground(classification: Bytes, seen: Bools, rules: ClassRules) -> Bools:
    """Tell which of the seen points are ground from the start: existing ground in mode ``"refine"``, else none."""
    if rules.mode != "refine":
        return np.zeros(len(seen), np.bool_)
    fixed: Bools = seen & (classification == GROUND)
    return fixed


def new_classes(old: Bytes, seen: Bools, ground: Bools, rules: ClassRules) -> Bytes:
    """Return the classes to write.

    Parameters
    ----------
    old : ndarray of uint8, shape (n,)
        Classes as read.
    seen, ground : ndarray of bool, shape (n,)
        The filter's input (`eligible`) and its answer; `ground` is not read where `seen` is False.
    rules : ClassRules
        Mode and ground class.

    Returns
    -------
    ndarray of uint8, shape (n,)
        A new array. Points that were not seen keep their class.

    Examples
    --------
    >>> old = np.array([1, 2, 5, 2, 9], np.uint8)
    >>> seen = np.array([True, True, True, True, False])
    >>> ground = np.array([True, False, False, True, False])
    >>> [new_classes(old, seen, ground, ClassRules(mode=m)).tolist() for m in ("update", "refine", "reset")]
    [[2, 1, 5, 2, 9], [2, 2, 5, 2, 9], [2, 1, 1, 2, 9]]
    """
    out = old.copy()
    found = seen & ground
    lost = seen & ~ground
    if rules.mode == "refine":
        out[found & (old != GROUND)] = rules.ground_class
        return out
    out[found] = rules.ground_class
    out[lost if rules.mode == "reset" else lost & (old == GROUND)] = UNCLASSIFIED
    return out


def check_writable(rules: ClassRules, point_format: int, name: str) -> None:
    """Refuse a ground class that a file's point format cannot hold, before any work starts.

    Parameters
    ----------
    rules : ClassRules
        Its `ground_class`.
    point_format : int
        0 to 10.
    name : str
        The file, for the message.

    Raises
    ------
    ParameterError
        For a class over 31 and point formats 0 to 5, which have 5 bits for it.

    Examples
    --------
    >>> check_writable(ClassRules(ground_class=31), 3, "old.laz")
    >>> try:
    ...     check_writable(ClassRules(ground_class=40), 3, "old.laz")
    ... except ParameterError as error:
    ...     print(str(error)[:58])
    ground_class = 40 does not fit old.laz: point format 3 hol
    """
    if point_format in LEGACY_FORMATS and rules.ground_class > LARGEST_LEGACY_CLASS:
        raise ParameterError(
            f"ground_class = {rules.ground_class} does not fit {name}: point format {point_format} holds classes 0 to "
            f"{LARGEST_LEGACY_CLASS}; choose one of those, or bring the file to point format 6 or later first"
        )
