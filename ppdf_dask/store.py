"""The Zarr v3 layout of a run and every read and write of it; the only importer of zarr.

Layout of ``run.zarr`` (each leaf has exactly one writer)::

    chunks/<chunk>/core/<source>     int32 (3, n): x, y, z in mm; x, y from the chunk's lower-left corner
    chunks/<chunk>/buffer/<source>   the same for the surroundings of the chunk
    classification/<chunk>           uint8 (n): 1 ground, 0 not, 255 never written; order of the core fragments
    ground/<chunk>                   int32 (3, n): the ground points, for the terrain model
    dtm/{height,distance,y,x}        float32 blocks of the global raster, one shard each
    ledger/<stage>/<id>              what is done: a Zarr group whose attributes are the record

A record of the ledger is one object written by one atomic put, so no rename is needed of the store behind it. Every
array carries a checksum (crc32c) per object, and its fill value can never be taken for data.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zarr
from zarr.abc.store import Store
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.core.buffer import default_buffer_prototype
from zarr.core.sync import sync
from zarr.storage import LocalStore

from ppdf_dask.errors import StoreError

FORMAT = 1
"""Version of the layout above; a store of another version is refused."""

# Bit shuffling in zstd packs the integers of a fragment to 4 to 6 bytes a point at 50 million points a second; a delta
# in front of it gains nothing (measured on three clouds of 0.3 to 15 points/m2).
_POINTS = (BloscCodec(typesize=4, cname="zstd", clevel=3, shuffle="bitshuffle"), Crc32cCodec())
_BYTES = (BloscCodec(typesize=1, cname="zstd", clevel=3, shuffle="bitshuffle"), Crc32cCodec())

# One object for a fragment up to this many points; a longer one gets more, in proportion to the data.
_CHUNK_POINTS = 8_000_000


class RunStore:
    """Reads and writes one ``run.zarr``; cheap to make, so each task makes its own.

    Parameters
    ----------
    url : str
        Path of the ``run.zarr`` folder.

    Examples
    --------
    >>> import tempfile, numpy as np
    >>> store = RunStore(tempfile.mkdtemp() + "/run.zarr")
    >>> store.create({"survey": "demo"})
    >>> store.write_points("c_0000_0000", "core", "s_000000", np.zeros((3, 4), np.int32))
    >>> store.sources("c_0000_0000", "core")
    ['s_000000']
    >>> store.read_points("c_0000_0000", "core", "s_000000").shape
    (3, 4)
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self._store: Store = LocalStore(url)

    def exists(self) -> bool:
        """Tell whether the root of the store has been written."""
        return self._get("zarr.json") is not None

    def create(self, attributes: dict[str, Any]) -> None:
        """Write the root group; existing content stays."""
        for group in ("chunks", "classification", "ground", "ledger"):
            self._put_group(group, {})
        self._put_group("", {"ppdf_dask_format": FORMAT, **attributes})

    def attributes(self) -> dict[str, Any]:
        """Return the root attributes.

        Raises
        ------
        StoreError
            When there is no store or it has another layout version.
        """
        found = self._get_group("")
        if found is None:
            raise StoreError(f"{self.url} is not a run's store; give the --out folder of an earlier run")
        if found.get("ppdf_dask_format") != FORMAT:
            raise StoreError(
                f"{self.url} has layout version {found.get('ppdf_dask_format')}, this version reads {FORMAT}; "
                "use the version that wrote it or run anew with --overwrite"
            )
        return found

    def erase(self) -> None:
        """Remove everything below the store's root."""
        sync(self._store.clear())

    # -- points ---------------------------------------------------------------------------------------------------

    def write_points(
        self,
        chunk: str,
        part: str,
        source: str,
        points: npt.NDArray[np.int32],
        attributes: dict[str, Any] | None = None,
    ) -> None:
        """Write one fragment, replacing what an interrupted attempt left under its name."""
        self._write(f"chunks/{chunk}/{part}/{source}", points, _POINTS, -(2**31), attributes)

    def read_points(self, chunk: str, part: str, source: str) -> npt.NDArray[np.int32]:
        """Read one fragment, int32 (rows, n)."""
        points: npt.NDArray[np.int32] = self._read(f"chunks/{chunk}/{part}/{source}")
        return points

    def fragment_attributes(self, chunk: str, part: str, source: str) -> dict[str, Any]:
        """Return a fragment's attributes without reading its points."""
        return self._get_group(f"chunks/{chunk}/{part}/{source}") or {}

    def sources(self, chunk: str, part: str) -> list[str]:
        """Return the sorted ids of the source files that have a fragment in this part of the chunk."""
        return self._children(f"chunks/{chunk}/{part}")

    def chunks(self) -> list[str]:
        """Return the sorted ids of all chunks with fragments."""
        return self._children("chunks")

    def drop_points(self) -> None:
        """Remove all fragments: they are only needed until the run is complete."""
        sync(self._store.delete_dir("chunks"))

    # -- results --------------------------------------------------------------------------------------------------

    def write_classification(self, chunk: str, ground: npt.NDArray[np.bool_], counts: dict[str, int]) -> None:
        """Write a chunk's mask; `counts` gives the points of each source in the order of the mask."""
        attributes = {"sources": list(counts), "counts": list(counts.values())}
        self._write(f"classification/{chunk}", ground.astype(np.uint8), _BYTES, 255, attributes)

    def read_classification(self, chunk: str) -> dict[str, npt.NDArray[np.bool_]]:
        """Return the mask of each source of a chunk.

        Raises
        ------
        StoreError
            When the chunk is not there, torn, or holds a value that is no class.
        """
        path = f"classification/{chunk}"
        attributes = self._get_group(path)
        if attributes is None:
            raise StoreError(f"{path} is missing in {self.url}; run again to classify the chunk")
        values = self._read(path)
        if (values > 1).any() or sum(attributes["counts"]) != len(values):
            raise StoreError(f"{path} in {self.url} is incomplete; `ppdf-dask verify` lists it, `run` redoes it")
        bounds = np.cumsum([0, *attributes["counts"]])
        return {
            source: values[bounds[k] : bounds[k + 1]].view(np.bool_) for k, source in enumerate(attributes["sources"])
        }

    def classified(self) -> list[str]:
        """Return the sorted ids of all chunks that have a mask."""
        return self._children("classification")

    def write_ground(self, chunk: str, points: npt.NDArray[np.int32]) -> None:
        """Write a chunk's ground points, int32 (3, n), for the terrain model."""
        self._write(f"ground/{chunk}", points, _POINTS, -(2**31), None)

    def read_ground(self, chunk: str) -> npt.NDArray[np.int32]:
        """Read a chunk's ground points; a chunk without any has none."""
        if self._get(f"ground/{chunk}/zarr.json") is None:
            return np.empty((3, 0), np.int32)
        points: npt.NDArray[np.int32] = self._read(f"ground/{chunk}")
        return points

    # -- raster ---------------------------------------------------------------------------------------------------

    def create_raster(
        self,
        y: npt.NDArray[np.float64],
        x: npt.NDArray[np.float64],
        block: int,
        crs: dict[str, Any],
        attributes: dict[str, dict[str, Any]],
    ) -> None:
        """Create the ``dtm`` group: one float32 array per key of `attributes`, blocks of `block` pixels as shards.

        Parameters
        ----------
        y, x : ndarray of float64
            Pixel-centre coordinates in the CRS's units; their lengths are multiples of `block`.
        block : int
            Pixels of a shard's edge: the unit of work and of writing.
        crs : dict
            Attributes of the ``spatial_ref`` grid-mapping variable.
        attributes : dict
            Variable name to its attributes (units, long_name).
        """
        self._put_group("dtm", {"Conventions": "CF-1.10"})
        for name, values in (("y", y), ("x", x)):
            meta = {"standard_name": f"projection_{name}_coordinate", "axis": name.upper()}
            self._write(f"dtm/{name}", values, None, float("nan"), meta, names=[name])
        self._write("dtm/spatial_ref", np.zeros((), np.int64), None, 0, crs, names=[])
        for name, meta in attributes.items():
            zarr.create_array(
                self._store,
                name=f"dtm/{name}",
                shape=(len(y), len(x)),
                dtype="float32",
                chunks=(block // 2, block // 2),
                shards=(block, block),
                compressors=_POINTS,
                fill_value=float("nan"),
                dimension_names=["y", "x"],
                attributes={"grid_mapping": "spatial_ref", **meta},
                overwrite=True,
            )

    def write_block(self, name: str, row: int, column: int, values: npt.NDArray[np.float32]) -> None:
        """Write one whole shard of a raster, first deleting what is there: a torn shard cannot be overwritten."""
        array = self._array(f"dtm/{name}")
        block = values.shape[0]
        key = f"dtm/{name}/c/{row}/{column}"
        sync(self._store.delete(key))
        if not np.isnan(values).all():
            array[row * block : (row + 1) * block, column * block : (column + 1) * block] = values

    def raster(self, name: str) -> Any:
        """Return the Zarr array of a raster for reading."""
        return self._array(f"dtm/{name}")

    # -- ledger ---------------------------------------------------------------------------------------------------

    def put_record(self, stage: str, ident: str, record: dict[str, Any]) -> None:
        """Publish a record by one atomic put."""
        self._put_group(f"ledger/{stage}/{ident}", record)

    def get_record(self, stage: str, ident: str) -> dict[str, Any] | None:
        """Return a record, or None."""
        return self._get_group(f"ledger/{stage}/{ident}")

    def records(self, stage: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the records of a stage, sorted by id."""
        for ident in self._children(f"ledger/{stage}"):
            record = self.get_record(stage, ident)
            if record is not None:
                yield ident, record

    def drop_record(self, stage: str, ident: str) -> None:
        """Remove a record: its work is to be done again."""
        sync(self._store.delete(f"ledger/{stage}/{ident}/zarr.json"))

    # -- bytes ----------------------------------------------------------------------------------------------------

    def _get(self, key: str) -> bytes | None:
        value = sync(self._store.get(key, default_buffer_prototype()))
        return None if value is None else value.to_bytes()

    def _put_group(self, path: str, attributes: dict[str, Any]) -> None:
        node = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
        value = default_buffer_prototype().buffer.from_bytes(json.dumps(node, sort_keys=True).encode())
        sync(self._store.set(f"{path}/zarr.json".lstrip("/"), value))

    def _get_group(self, path: str) -> dict[str, Any] | None:
        raw = self._get(f"{path}/zarr.json".lstrip("/"))
        if raw is None:
            return None
        try:
            found = json.loads(raw)["attributes"]
        except (ValueError, KeyError, TypeError):
            raise StoreError(f"{path}/zarr.json in {self.url} is torn; delete it and run again") from None
        return dict(found)

    def _children(self, path: str) -> list[str]:
        return sorted(name for name in sync(_collect(self._store, path)) if name != "zarr.json")

    def _array(self, path: str) -> Any:
        try:
            return zarr.open_array(self._store, path=path, mode="r+")
        except FileNotFoundError:
            raise StoreError(
                f"{path} is missing in {self.url}; `ppdf-dask verify` lists what has to be redone"
            ) from None

    def _read(self, path: str) -> Any:
        array = self._array(path)
        if array.nchunks_initialized != array.nchunks:
            raise StoreError(f"{path} in {self.url} has lost data; `ppdf-dask verify` lists what has to be redone")
        try:
            return array[...]
        except (ValueError, RuntimeError) as error:
            raise StoreError(f"{path} in {self.url} is damaged ({error}); delete it and run again") from error

    def _write(
        self,
        path: str,
        values: npt.NDArray[Any],
        compressors: Sequence[Any] | None,
        fill: float,
        attributes: dict[str, Any] | None,
        names: list[str] | None = None,
    ) -> None:
        chunks = (*values.shape[:-1], min(max(values.shape[-1], 1), _CHUNK_POINTS)) if values.shape else ()
        with warnings.catch_warnings():
            # An empty array is legitimate here (a chunk without ground); zarr warns of its chunk being larger.
            warnings.simplefilter("ignore", UserWarning)
            array = zarr.create_array(
                self._store,
                name=path,
                shape=values.shape,
                dtype=values.dtype,
                chunks=chunks or "auto",
                compressors=compressors if compressors is not None else "auto",
                fill_value=fill,
                dimension_names=names,
                attributes=attributes or {},
                overwrite=True,
                # A chunk full of the fill value must be stored all the same: a missing object always means a loss.
                config={"write_empty_chunks": True},
            )
        if values.size or not values.shape:
            array[...] = values


async def _collect(store: Store, path: str) -> list[str]:
    return [name async for name in store.list_dir(path)]


def store_of(run: str | Path) -> RunStore:
    """Return the store of a run's folder."""
    return RunStore(str(Path(run) / "run.zarr"))
