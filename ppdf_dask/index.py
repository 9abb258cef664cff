"""Which fragments each chunk consists of: written once by the driver when the tile stage ends.

A folder that is gone would look like an empty place. With the index, a place is empty because the ledger says so: what
a tile's record promises has to be there, with the promised number of points and made with the same fingerprint, and
what it does not promise (leavings of an attempt that failed, of a tile that is no longer part) is never read.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.chunktable import ChunkTable, chunk_at, place
from ppdf_dask.ledger import digest
from ppdf_dask.store import RunStore, index_path

Parts = dict[str, dict[str, tuple[int, str]]]
"""Part (core, buffer) to source to (points, fingerprint)."""

Rows = npt.NDArray[np.void]

_ROW = np.dtype([("place", "<i8"), ("source", "<i4"), ("core", "<u4"), ("cells", "<u4"), ("buffer", "<u4")])


def packed(chunks: dict[str, list[int]] | Rows) -> Rows:
    """Return what a tile's record says of its chunks as an array; what is one already stays as it is.

    Parameters
    ----------
    chunks : dict or structured ndarray
        Chunk id to core points, occupied density cells and buffer points.
    """
    if isinstance(chunks, dict):
        return np.array([(place(chunk), 0, *counts) for chunk, counts in chunks.items()], _ROW)
    return chunks


@dataclass(frozen=True)
class Index:
    """The index of a run, as its tiles' records give it.

    Attributes
    ----------
    sources : dict
        Source to the fingerprint of its fragments, in ascending order.
    labels : dict
        Source to the number of its batches of labels.
    rows : structured ndarray
        One row for each chunk and source: place of the chunk, number of the source in `sources`, core points, occupied
        density cells and buffer points; in the order of places and sources.
    """

    sources: dict[str, str]
    labels: dict[str, int]
    rows: Rows

    @classmethod
    def of(cls, tiles: dict[str, dict[str, Any]]) -> Index:
        """Build the index from the records of the tile stage.

        Examples
        --------
        >>> tile = {"fingerprint": "f", "chunks": {"c_0000_0000": [3, 1, 0], "c_0001_0000": [0, 0, 2]}}
        >>> index = Index.of({"s_000000": tile})
        >>> index.parts("c_0001_0000"), dict(index.points)
        ({'core': {}, 'buffer': {'s_000000': (2, 'f')}}, {'c_0000_0000': 3})
        """
        names = sorted(tiles)
        rows = np.concatenate([np.empty(0, _ROW), *(packed(tiles[name]["chunks"]) for name in names)])
        rows["source"] = np.repeat(np.arange(len(names)), [len(tiles[name]["chunks"]) for name in names])
        rows = rows[np.argsort(rows["place"], kind="stable")]
        fingerprints = {name: tiles[name]["fingerprint"] for name in names}
        return cls(fingerprints, {name: tiles[name].get("labels", 0) for name in names}, rows)

    @cached_property
    def _names(self) -> list[str]:
        return list(self.sources)

    @cached_property
    def _first(self) -> npt.NDArray[np.intp]:
        """First row of each chunk, and the end."""
        begins = np.flatnonzero(np.diff(self.rows["place"], prepend=self.rows["place"][:1] - 1))
        return np.append(begins, len(self.rows))

    @cached_property
    def loaded(self) -> ChunkTable:
        """Points of each chunk, its stored buffer included."""
        return self._table(self.rows["core"].astype(np.int64) + self.rows["buffer"])

    @cached_property
    def points(self) -> ChunkTable:
        """Core points of each chunk that has any."""
        every = self._table(self.rows["core"].astype(np.int64))
        some = every.counts > 0
        return ChunkTable(every.places[some], every.counts[some])

    def _table(self, counts: npt.NDArray[np.int64]) -> ChunkTable:
        begins = self._first[:-1]
        return ChunkTable(self.rows["place"][begins], np.add.reduceat(counts, begins) if len(begins) else counts)

    def parts(self, chunk: str) -> Parts:
        """Return what a chunk consists of; raises KeyError for a chunk that no tile has points for."""
        return self._parts(self.loaded.row(chunk))

    def _parts(self, k: int) -> Parts:
        found: Parts = {"core": {}, "buffer": {}}
        for _, number, core, _, buffer in self.rows[self._first[k] : self._first[k + 1]].tolist():
            source = self._names[number]
            for part, count in (("core", core), ("buffer", buffer)):
                if count:
                    found[part][source] = (count, self.sources[source])
        return found

    def each(self) -> Iterator[tuple[str, Parts]]:
        """Yield each chunk and what it consists of."""
        return ((chunk, self._parts(k)) for k, chunk in enumerate(self.loaded))

    def cells(self) -> tuple[int, list[tuple[str, list[str]]]]:
        """Return the occupied density cells of the chunks whose core one source alone has, and the other chunks.

        Returns
        -------
        cells : int
            Their number.
        shared : list of (str, list of str)
            Chunks and the sources of their cores: what of their cells is the same only the fragments know.
        """
        own = self.rows[self.rows["core"] > 0]
        _, inverse, times = np.unique(own["place"], return_inverse=True, return_counts=True)
        several = own[times[inverse] > 1]
        by_chunk = groupby(several.tolist(), key=lambda row: row[0])
        shared = [(chunk_at(number), [self._names[row[1]] for row in rows]) for number, rows in by_chunk]
        return int(own["cells"][times[inverse] == 1].sum(dtype=np.int64)), shared

    def shards(self) -> Iterator[tuple[str, dict[str, Parts]]]:
        """Yield what is written as one object each: its path and the chunks it is about."""
        # All chunks of a shard are neighbours in their column.
        for path, chunks in groupby(self.each(), key=lambda item: index_path(item[0])):
            yield path, dict(chunks)

    def _paths(self) -> set[str]:
        return {index_path(chunk) for chunk in self.loaded}

    @cached_property
    def _key(self) -> dict[str, str]:
        return {"digest": digest([self.sources, hashlib.sha256(self.rows.tobytes()).hexdigest()])}

    def publish(self, store: RunStore) -> None:
        """Write the index, and remove the fragments it does not know."""
        paths = self._paths()
        if self.is_published(store) and all(map(store.has, paths)):
            return
        store.drop_record("index", "key")
        for path, chunks in self.shards():
            store.put_node(path, {"chunks": chunks})
        for path in store.indexed():
            if path not in paths:
                store.drop(path)
        for path in list(self.orphans(store)):
            store.drop(path)
        store.put_record("index", "key", self._key)

    def is_published(self, store: RunStore) -> bool:
        """Tell whether this index, and no older one, was written to its end."""
        return store.get_record("index", "key") == self._key

    def orphans(self, store: RunStore) -> Iterator[str]:
        """Yield the paths of fragments that no finished tile claims, and of results of chunks that are no more."""
        for group in ("classification", "ground"):
            yield from (f"{group}/{chunk}" for chunk in store.children(group) if chunk not in self.points)
        for source in store.children("labels"):
            kept = store.children(f"labels/{source}")
            numbers = {f"{number:06d}" for number in range(self.labels.get(source, 0))}
            yield from (f"labels/{source}/{name}" for name in kept if name not in numbers)
        for chunk in store.chunks():
            if chunk not in self.loaded:
                yield f"chunks/{chunk}"
                continue
            for part, known in self.parts(chunk).items():
                for source in store.sources(chunk, part):
                    if source not in known:
                        yield f"chunks/{chunk}/{part}/{source}"


def fragments(store: RunStore, chunk: str, part: str) -> dict[str, npt.NDArray[np.int32]]:
    """Read one part of a chunk.

    Parameters
    ----------
    store : RunStore
        A store with an index.
    chunk, part : str
        Any chunk id; ``"core"`` or ``"buffer"``.

    Returns
    -------
    dict
        Source to its points, int32 (rows, n); empty where the index knows of nothing.

    Raises
    ------
    DamagedError
        When a fragment is not what the index says.
    """
    known = parts_of(store, chunk).get(part, {})
    return {source: store.read_points(chunk, part, source, (n, key)) for source, (n, key) in sorted(known.items())}


def parts_of(store: RunStore, chunk: str) -> Parts:
    """Return what a chunk consists of; nothing where the index knows of nothing."""
    shard = store.get_node(index_path(chunk))
    return {} if shard is None else shard["chunks"].get(chunk, {})


def owns_points(store: RunStore, chunk: str) -> bool:
    """Tell whether a chunk has core points, so that it must have a classification."""
    return bool(parts_of(store, chunk).get("core"))
