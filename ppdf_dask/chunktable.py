"""What a driver knows of many chunks, in arrays: a country has a million, and dicts of each would be gigabytes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from ppdf_dask.errors import ParameterError
from ppdf_dask.grid import chunk_id, parse_id

Int64 = npt.NDArray[np.int64]
Numbers = TypeVar("Numbers", int, Int64)

_ROWS = 1 << 32


def places(ix: Numbers, iy: Numbers) -> Numbers:
    """Return a number for each chunk, in the order of column and row.

    Parameters
    ----------
    ix, iy : int or ndarray of int64
        Columns and rows, below 2**31 in size: a chunk has 5 m at least, and coordinates are 64-bit millimetres of
        places on the earth.
    """
    return ix * _ROWS + (iy + _ROWS // 2)


def place(chunk: str) -> int:
    """Return the number of the chunk with this id."""
    return places(*parse_id(chunk))


def columns_and_rows(numbers: Numbers) -> tuple[Numbers, Numbers]:
    """Return what `places` was given.

    Examples
    --------
    >>> columns_and_rows(places(np.array([-3, 4]), np.array([5, -6])))
    (array([-3,  4]), array([ 5, -6]))
    """
    return numbers // _ROWS, numbers % _ROWS - _ROWS // 2


def chunk_at(number: int) -> str:
    """Return the id of the chunk with this number."""
    return chunk_id(*columns_and_rows(number))


class ChunkTable(Mapping[str, int]):
    """A number for each chunk, 16 bytes a chunk.

    Parameters
    ----------
    places : ndarray of int64, shape (n,)
        Where the chunks are, ascending (see `places`).
    counts : ndarray of int64, shape (n,)
        Their numbers.

    Examples
    --------
    >>> table = ChunkTable(places(np.array([0, 7]), np.array([1, -2])), np.array([10, 20]))
    >>> dict(table), table["c_0007_m0002"], "c_0007_0002" in table
    ({'c_0000_0001': 10, 'c_0007_m0002': 20}, 20, False)
    """

    def __init__(self, places: Int64, counts: Int64) -> None:
        self.places, self.counts = places, counts

    def row(self, chunk: str) -> int:
        """Return the position of a chunk; raises KeyError when there is none."""
        try:
            number = place(chunk)
        except ParameterError:
            raise KeyError(chunk) from None
        row = int(np.searchsorted(self.places, number))
        if row == len(self.places) or self.places[row] != number:
            raise KeyError(chunk)
        return row

    def __getitem__(self, chunk: str) -> int:
        return int(self.counts[self.row(chunk)])

    def __iter__(self) -> Iterator[str]:
        return (chunk_at(int(number)) for number in self.places)

    def __len__(self) -> int:
        return len(self.places)


class ChunkRecords(Mapping[str, dict[str, Any]]):
    """What is kept of the records of chunks, 33 bytes a chunk; those that have one come in the order of their places.

    Parameters
    ----------
    chunks : ChunkTable
        The chunks that may have a record.
    numbers : tuple of str
        Names of the values that are whole numbers.
    rare : str
        Name of a value that is an empty dict for nearly all chunks.

    Examples
    --------
    >>> table = ChunkTable(places(np.array([0, 7]), np.array([1, -2])), np.array([10, 20]))
    >>> records = ChunkRecords(table, ("ground",), "shared")
    >>> records["c_0007_m0002"] = {"ground": 5, "shared": {"a b": 1}}
    >>> dict(records), "c_0000_0001" in records
    ({'c_0007_m0002': {'ground': 5, 'shared': {'a b': 1}}}, False)
    """

    def __init__(self, chunks: ChunkTable, numbers: tuple[str, ...], rare: str) -> None:
        self._chunks, self._names, self._rare = chunks, numbers, rare
        self._values = np.zeros((len(chunks), len(numbers)), np.int64)
        self._known = np.zeros(len(chunks), bool)
        self._others: dict[int, dict[str, Any]] = {}

    def __setitem__(self, chunk: str, record: dict[str, Any]) -> None:
        row = self._chunks.row(chunk)
        self._values[row] = [record[name] for name in self._names]
        self._known[row] = True
        self._others.pop(row, None)
        if record[self._rare]:
            self._others[row] = record[self._rare]

    def _record(self, row: int) -> dict[str, Any]:
        values = dict(zip(self._names, self._values[row].tolist(), strict=True))
        return {**values, self._rare: self._others.get(row, {})}

    def __getitem__(self, chunk: str) -> dict[str, Any]:
        row = self._chunks.row(chunk)
        if not self._known[row]:
            raise KeyError(chunk)
        return self._record(row)

    def __iter__(self) -> Iterator[str]:
        return (chunk_at(int(number)) for number in self._chunks.places[self._known])

    def __len__(self) -> int:
        return int(self._known.sum())
