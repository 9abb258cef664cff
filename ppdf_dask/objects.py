"""Objects of a store: whole values put, got, listed and removed by key, and small JSON nodes made of them.

With `ppdf_dask.store`, which knows the layout, the only importer of zarr. Each value arrives by one atomic put, so
nothing here needs a rename of the store behind it.
"""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Iterator
from functools import lru_cache
from typing import Any

from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync
from zarr.storage import LocalStore

from ppdf_dask.errors import DamagedError

LEFTOVER = ".partial"
"""How the name of a value ends whose writer was killed; it is never read."""


class ObjectStore:
    """Values by key below one root; nodes are Zarr groups whose attributes are a JSON object.

    Parameters
    ----------
    url : str
        Path of the root.

    Examples
    --------
    >>> import tempfile
    >>> objects = ObjectStore(tempfile.mkdtemp())
    >>> objects.put_node("ledger/tile/s_000000", {"points": 3})
    >>> objects.get_node("ledger/tile/s_000000"), objects.get_node("ledger/tile/s_000001")
    ({'points': 3}, None)
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._store = _local(url)

    # Values go to the file system directly where zarr lets them: by way of its event loop and a thread of that loop, a
    # small one costs two to six times as much, and a run has several for each chunk.

    def get(self, key: str) -> bytes | None:
        """Return a value, or None."""
        value = self._store.get_sync(key)
        return None if value is None else value.to_bytes()

    def put(self, key: str, value: bytes) -> None:
        """Put a value, all of it or nothing."""
        self._store.set_sync(key, default_buffer_prototype().buffer.from_bytes(value))

    def put_new(self, key: str, value: bytes) -> None:
        """Put a value unless the key has one, as one atomic step."""
        sync(self._store.set_if_not_exists(key, default_buffer_prototype().buffer.from_bytes(value)))

    def delete(self, key: str) -> None:
        """Remove one value; it need not be there."""
        self._store.delete_sync(key)

    def drop(self, path: str) -> None:
        """Remove all values below a path."""
        sync(self._store.delete_dir(path))

    def keys(self, path: str) -> Iterator[str]:
        """Yield the keys of all values below a path, sorted; leftovers of killed writers among them."""
        yield from sorted(sync(_collect(self._store.list_prefix(path))))

    def children(self, path: str) -> list[str]:
        """Return the sorted names one step below a path."""
        found = sync(_collect(self._store.list_dir(path)))
        return sorted(name for name in found if name != "zarr.json" and not name.endswith(LEFTOVER))

    def has(self, path: str) -> bool:
        """Tell whether there is a node or an array of this path."""
        return bool(sync(self._store.exists(f"{path}/zarr.json".lstrip("/"))))

    def put_node(self, path: str, attributes: dict[str, Any]) -> None:
        """Put a node."""
        self.put(f"{path}/zarr.json".lstrip("/"), node_bytes(attributes))

    def get_node(self, path: str) -> dict[str, Any] | None:
        """Return the attributes of a node or an array, or None.

        Raises
        ------
        DamagedError
            When its metadata is torn.
        """
        raw = self.get(f"{path}/zarr.json".lstrip("/"))
        if raw is None:
            return None
        try:
            return dict(json.loads(raw)["attributes"])
        except (ValueError, KeyError, TypeError, RecursionError):
            raise self.damage(path, "has torn metadata") from None

    def damage(self, path: str, what: str, kind: str = "torn") -> DamagedError:
        """Return the error that says what is wrong with an object and what helps."""
        return DamagedError(
            f"{path or 'the root'} in {self.url} {what}; `ppdf-dask verify` lists all that is damaged, "
            "`ppdf-dask run` redoes it",
            path,
            kind,
        )


def node_bytes(attributes: dict[str, Any]) -> bytes:
    """Return the value of a node."""
    node = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    return json.dumps(node, sort_keys=True).encode()


@lru_cache(maxsize=8)
def _local(url: str) -> LocalStore:
    # Opening one costs as much as a small value, and each task makes its own `ObjectStore`.
    return LocalStore(url)


async def _collect(names: AsyncIterator[str]) -> list[str]:
    return [name async for name in names]
