"""Which fragments each chunk consists of: written once by the driver when the tile stage ends.

A folder that is gone would look like an empty place. With the index, a place is empty because the ledger says so: what
a tile's record promises has to be there, with the promised number of points and made with the same fingerprint, and
what it does not promise (leavings of an attempt that failed, of a tile that is no longer part) is never read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.ledger import digest
from ppdf_dask.store import RunStore, index_path

Parts = dict[str, dict[str, tuple[int, str]]]
"""Part (core, buffer) to source to (points, fingerprint)."""


@dataclass
class Index:
    """The index of a run, as its tiles' records give it.

    Attributes
    ----------
    chunks : dict
        Chunk id to its parts.
    labels : dict
        Source to the number of its batches of labels.
    """

    chunks: dict[str, Parts] = field(default_factory=dict)
    labels: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, tiles: dict[str, dict[str, Any]]) -> Index:
        """Build the index from the records of the tile stage.

        Examples
        --------
        >>> tile = {"fingerprint": "f", "chunks": {"c_0000_0000": [3, 1, 0], "c_0001_0000": [0, 0, 2]}}
        >>> index = Index.of({"s_000000": tile})
        >>> index.chunks["c_0001_0000"], index.points
        ({'core': {}, 'buffer': {'s_000000': (2, 'f')}}, {'c_0000_0000': 3})
        """
        chunks: dict[str, Parts] = {}
        for source, record in sorted(tiles.items()):
            for chunk, (core, _, buffer) in record["chunks"].items():
                parts = chunks.setdefault(chunk, {"core": {}, "buffer": {}})
                for part, count in (("core", core), ("buffer", buffer)):
                    if count:
                        parts[part][source] = (count, record["fingerprint"])
        return cls(dict(sorted(chunks.items())), {s: record.get("labels", 0) for s, record in tiles.items()})

    @property
    def points(self) -> dict[str, int]:
        """Core points of each chunk that has any."""
        counts = ((chunk, sum(n for n, _ in parts["core"].values())) for chunk, parts in self.chunks.items())
        return {chunk: n for chunk, n in counts if n}

    def loaded(self, chunk: str) -> int:
        """Return the points of a chunk, its stored buffer included."""
        return sum(n for part in self.chunks[chunk].values() for n, _ in part.values())

    def shards(self) -> dict[str, dict[str, Parts]]:
        """Return what is written as one object each: its path to the chunks it is about."""
        found: dict[str, dict[str, Parts]] = {}
        for chunk, parts in self.chunks.items():
            found.setdefault(index_path(chunk), {})[chunk] = parts
        return found

    def publish(self, store: RunStore) -> None:
        """Write the index, and remove the fragments it does not know."""
        shards, key = self.shards(), {"digest": digest(self.chunks)}
        if store.get_record("index", "key") == key and all(map(store.has, shards)):
            return
        store.drop_record("index", "key")
        for path, chunks in shards.items():
            store.put_node(path, {"chunks": chunks})
        for path in store.indexed():
            if path not in shards:
                store.drop(path)
        for path in list(self.orphans(store)):
            store.drop(path)
        store.put_record("index", "key", key)

    def is_published(self, store: RunStore) -> bool:
        """Tell whether this index, and no older one, was written to its end."""
        return store.get_record("index", "key") == {"digest": digest(self.chunks)}

    def orphans(self, store: RunStore) -> Iterator[str]:
        """Yield the paths of fragments that no finished tile claims, and of results of chunks that are no more."""
        owners = self.points
        for group in ("classification", "ground"):
            yield from (f"{group}/{chunk}" for chunk in store.children(group) if chunk not in owners)
        for source in store.children("labels"):
            kept = store.children(f"labels/{source}")
            numbers = {f"{number:06d}" for number in range(self.labels.get(source, 0))}
            yield from (f"labels/{source}/{name}" for name in kept if name not in numbers)
        for chunk in store.chunks():
            if chunk not in self.chunks:
                yield f"chunks/{chunk}"
                continue
            for part, known in self.chunks[chunk].items():
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
