"""The Zarr v3 layout of a run and every read and write of it.

Layout of ``run.zarr`` (each leaf has exactly one writer)::

    chunks/<chunk>/core/<source>     int32 (3, n): x, y, z in mm; x, y from the chunk's lower-left corner
    chunks/<chunk>/buffer/<source>   the same for the surroundings of the chunk
    labels/<source>/<number>         uint8 (5, n): what the merge needs of each point of a file (`ppdf_dask.kept`)
    classification/<chunk>           uint8 (n): 1 ground, 0 not, 255 never written; order of the core fragments
    ground/<chunk>                   int32 (3, n): the ground points, for the terrain model
    dtm/{height,distance,y,x}        float32 blocks of the global raster, one shard each
    ledger/<stage>/<shard>/<id>      what is done: a Zarr group whose attributes are the record (`record_path`)
    ledger/index/<shard>             which fragments chunks consist of, and of how many points (`ppdf_dask.index`)

Every object is written by one atomic put of its final bytes, an array's metadata after its data: no rename is needed of
the store behind it, an array that is there is whole, and a task that runs twice at once does no harm. Every array
carries a checksum (crc32c) per object, its own path and the fingerprint it was made with, so that no other array can
be taken for it; its fill value can never be taken for data.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.storage import MemoryStore

from ppdf_dask.errors import DamagedError, StoreError
from ppdf_dask.objects import LEFTOVER, ObjectStore, node_bytes

FORMAT = 5
"""Version of the layout above; a store of another version is refused."""

# Bit shuffling in LZ4 packs the integers of a fragment into 5 % more bytes than zstd does (level 3), at a quarter of
# the processor time; a delta in front of it gains nothing.
_POINTS = (BloscCodec(typesize=4, cname="lz4", clevel=1, shuffle="bitshuffle"), Crc32cCodec())
_LABELS = (BloscCodec(typesize=1, cname="zstd", clevel=1, shuffle="bitshuffle"), Crc32cCodec())
_BYTES = (BloscCodec(typesize=1, cname="zstd", clevel=3, shuffle="bitshuffle"), Crc32cCodec())

# One object for a fragment up to this many points; a longer one gets more, in proportion to the data.
_CHUNK_POINTS = 8_000_000

GROUPS = ("ledger", "chunks", "labels", "classification", "ground")


class RunStore(ObjectStore):
    """Reads and writes one ``run.zarr``; cheap to make, so each task makes its own.

    Parameters
    ----------
    url : str
        Path of the ``run.zarr`` folder.
    made_by : str
        Fingerprint that arrays written through this object carry.

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

    def __init__(self, url: str, made_by: str = "") -> None:
        super().__init__(url)
        self.made_by = made_by

    def exists(self) -> bool:
        """Tell whether the root of the store has been written."""
        return self.has("")

    def create(self, attributes: dict[str, Any]) -> None:
        """Write the root group; existing content stays."""
        for group in GROUPS:
            self.put_node(group, {})
        self.put_node("", {"ppdf_dask_format": FORMAT, **attributes})

    def attributes(self) -> dict[str, Any]:
        """Return the root attributes.

        Raises
        ------
        StoreError
            When there is no store or it has another layout version.
        """
        found = self.get_node("")
        if found is None:
            raise StoreError(f"{self.url} is not a run's store; give the --out folder of an earlier run")
        if found.get("ppdf_dask_format") != FORMAT:
            raise StoreError(
                f"{self.url} has layout version {found.get('ppdf_dask_format')}, this version reads {FORMAT}; "
                "use the version that wrote it or run anew with --overwrite"
            )
        return found

    def erase(self) -> None:
        """Remove everything but the lock: the ledger first, so that it never claims what is gone, the root last."""
        for group in (*GROUPS, "dtm"):
            self.drop(group)
        self.delete("zarr.json")

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

    def read_points(
        self, chunk: str, part: str, source: str, expected: tuple[int, str] | None = None
    ) -> npt.NDArray[np.int32]:
        """Read one fragment, int32 (rows, n).

        Parameters
        ----------
        chunk, part, source : str
            Its name.
        expected : tuple of int and str, optional
            Points it must have and the fingerprint it must be made with.

        Raises
        ------
        DamagedError
            When it is missing, torn, or not what is expected.
        """
        path = f"chunks/{chunk}/{part}/{source}"
        points: npt.NDArray[np.int32] = self._read(path, expected[1] if expected else None)
        if expected and points.shape[1] != expected[0]:
            raise self.damage(path, f"holds {points.shape[1]} points, the ledger says {expected[0]}", "foreign")
        return points

    def fragment_attributes(self, chunk: str, part: str, source: str) -> dict[str, Any]:
        """Return a fragment's attributes without reading its points."""
        path = f"chunks/{chunk}/{part}/{source}"
        found = self.get_node(path)
        if found is None or found.get("path") != path:
            raise self._absent(path, found)
        return found

    def sources(self, chunk: str, part: str) -> list[str]:
        """Return the sorted ids of the source files that have a fragment in this part of the chunk."""
        return self.children(f"chunks/{chunk}/{part}")

    def chunks(self) -> list[str]:
        """Return the sorted ids of all chunks with fragments."""
        return self.children("chunks")

    def write_labels(self, source: str, number: int, rows: npt.NDArray[np.uint8], chunks: list[str]) -> None:
        """Write a batch of labels of a file; `chunks` names those that own its points."""
        self._write(f"labels/{source}/{number:06d}", rows, _LABELS, 255, {"chunks": chunks})

    def read_labels(self, source: str, number: int, made_by: str) -> tuple[npt.NDArray[np.uint8], list[str]]:
        """Read a batch of labels and the chunks that own its points; raises DamagedError as `read_points`."""
        path = f"labels/{source}/{number:06d}"
        rows: npt.NDArray[np.uint8] = self._read(path, made_by)
        return rows, list((self.get_node(path) or {})["chunks"])

    # -- results --------------------------------------------------------------------------------------------------

    def write_classification(self, chunk: str, ground: npt.NDArray[np.bool_], counts: dict[str, int]) -> None:
        """Write a chunk's mask; `counts` gives the points of each source in the order of the mask."""
        attributes = {"sources": list(counts), "counts": list(counts.values())}
        self._write(f"classification/{chunk}", ground.astype(np.uint8), _BYTES, 255, attributes)

    def read_classification(self, chunk: str, made_by: str | None = None) -> dict[str, npt.NDArray[np.bool_]]:
        """Return the mask of each source of a chunk.

        Raises
        ------
        DamagedError
            When the chunk is not there, torn, or holds a value that is no class.
        """
        path = f"classification/{chunk}"
        attributes = self.get_node(path)
        if attributes is None:
            raise self.damage(path, "is missing", "missing")
        values = self._read(path, made_by)
        if (values > 1).any() or sum(attributes["counts"]) != len(values):
            raise self.damage(path, "is incomplete")
        bounds = np.cumsum([0, *attributes["counts"]])
        return {
            source: values[bounds[k] : bounds[k + 1]].view(np.bool_) for k, source in enumerate(attributes["sources"])
        }

    def classified(self) -> list[str]:
        """Return the sorted ids of all chunks that have a mask."""
        return self.children("classification")

    def write_ground(self, chunk: str, points: npt.NDArray[np.int32]) -> None:
        """Write a chunk's ground points, int32 (3, n), for the terrain model."""
        self._write(f"ground/{chunk}", points, _POINTS, -(2**31), None)

    def read_ground(self, chunk: str) -> npt.NDArray[np.int32]:
        """Read a chunk's ground points."""
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
        """Create the ``dtm`` group, in place of an older one: float32 arrays with blocks of `block` pixels as shards.

        Parameters
        ----------
        y, x : ndarray of float64
            Pixel-centre coordinates in the CRS's units; their lengths are multiples of `block`.
        block : int
            Pixels of a shard's edge: the unit of work and of writing.
        crs : dict
            Attributes of the ``spatial_ref`` grid-mapping variable.
        attributes : dict
            Name of each array to its attributes (units, long_name).
        """
        self.drop("dtm")
        self.put_node("dtm", {"Conventions": "CF-1.10"})
        for name, values in (("y", y), ("x", x)):
            meta = {"standard_name": f"projection_{name}_coordinate", "axis": name.upper()}
            self._write(f"dtm/{name}", values, None, float("nan"), meta, names=[name])
        self._write("dtm/spatial_ref", np.zeros((), np.int64), None, 0, crs, names=[])
        for name, meta in attributes.items():
            objects, _ = _raster(f"dtm/{name}", (len(y), len(x)), block, {"grid_mapping": "spatial_ref", **meta})
            self._put_array(f"dtm/{name}", objects)

    def write_block(self, name: str, row: int, column: int, values: npt.NDArray[np.float32]) -> None:
        """Write one whole shard of a raster as one object; a block without any value has none."""
        key = f"dtm/{name}/c/{row}/{column}"
        if np.isnan(values).all():
            self.delete(key)
            return
        block = values.shape[0]
        objects, array = _raster(f"dtm/{name}", values.shape, block, {})
        array[...] = values
        self.put(key, objects[f"dtm/{name}/c/0/0"].to_bytes())

    def raster(self, name: str) -> tuple[tuple[int, int], dict[str, Any]]:
        """Return shape and attributes of a raster, or of its ``spatial_ref``."""
        array = self._array(f"dtm/{name}")
        return array.shape, dict(array.attrs)

    def read_block(self, name: str, row: int, column: int, size: int) -> npt.NDArray[np.float32]:
        """Read one whole shard of a raster; NaN where none was written.

        Raises
        ------
        DamagedError
            When the shard or the raster's metadata is damaged.
        """
        array = self._array(f"dtm/{name}")
        try:
            found: npt.NDArray[np.float32] = array[row * size : (row + 1) * size, column * size : (column + 1) * size]
        except (ValueError, RuntimeError, IndexError, MemoryError) as error:
            key = f"dtm/{name}/c/{row}/{column}"
            raise self.damage(key, f"is damaged ({error})", "flipped") from error
        return found

    # -- ledger ---------------------------------------------------------------------------------------------------

    def put_record(self, stage: str, ident: str, record: dict[str, Any]) -> None:
        """Publish a record by one atomic put."""
        self.put_node(record_path(stage, ident), record)

    def get_record(self, stage: str, ident: str) -> dict[str, Any] | None:
        """Return a record; None when there is none, or what is there is torn: its work is to be done again."""
        try:
            return self.get_node(record_path(stage, ident))
        except DamagedError:
            return None

    def records(self, stage: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the records of a stage by shard and id."""
        for ident in self.recorded(stage):
            record = self.get_record(stage, ident)
            if record is not None:
                yield ident, record

    def recorded(self, stage: str) -> Iterator[str]:
        """Yield the ids that a stage has records of, by shard and id."""
        for shard in self.children(f"ledger/{stage}"):
            yield from self.children(f"ledger/{stage}/{shard}")

    def indexed(self) -> list[str]:
        """Return the paths of the shards of the index."""
        return [f"ledger/index/{name}" for name in self.children("ledger/index") if name != "_"]

    def drop_record(self, stage: str, ident: str) -> None:
        """Remove a record: its work is to be done again."""
        self.delete(f"{record_path(stage, ident)}/zarr.json")

    # -- lock -----------------------------------------------------------------------------------------------------

    def claim(self, lock: dict[str, Any]) -> bool:
        """Put the lock where there is none, in one atomic step; tell whether it is there now."""
        self.put_new("lock/zarr.json", node_bytes({"lock": lock}))
        return self.lock() == lock

    def lock(self) -> dict[str, Any] | None:
        """Return who holds the lock, or None; a torn lock is one of nobody."""
        try:
            node = self.get_node("lock")
        except DamagedError:
            return {}
        return None if node is None else dict(node.get("lock") or {})

    def renew(self, lock: dict[str, Any]) -> None:
        """Replace the lock one holds."""
        self.put_node("lock", {"lock": lock})

    def unlock(self) -> None:
        """Remove the lock."""
        self.drop("lock")

    # -- arrays ---------------------------------------------------------------------------------------------------

    def _array(self, path: str) -> Any:
        try:
            return zarr.open_array(self._store, path=path, mode="r", zarr_format=3)
        except FileNotFoundError:
            raise self.damage(path, "is missing", "missing") from None
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise self.damage(path, f"has torn metadata ({error})") from error

    def _read(self, path: str, made_by: str | None = None) -> Any:
        array = self._array(path)
        if array.attrs.get("path") != path:
            raise self._absent(path, array.attrs)
        if made_by is not None and array.attrs.get("made_by") != made_by:
            raise self.damage(path, "is of another run or of other settings", "foreign")
        # Stored objects are counted, not promised ones: metadata may claim any size, and nothing is allocated for it.
        stored = sum(1 for key in self.keys(f"{path}/c") if not key.endswith(LEFTOVER))
        if stored != array.nchunks or (array.ndim and array.chunks[-1] > _CHUNK_POINTS):
            raise self.damage(path, "has lost data", "missing")
        try:
            return array[...]
        except (ValueError, RuntimeError, MemoryError) as error:
            raise self.damage(path, f"is damaged ({error})", "flipped") from error

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
        objects: dict[str, Any] = {}
        with warnings.catch_warnings():
            # An empty array is legitimate here (a chunk without ground); zarr warns of its chunk being larger.
            warnings.simplefilter("ignore", UserWarning)
            array = zarr.create_array(
                MemoryStore(objects),
                name=path,
                shape=values.shape,
                dtype=values.dtype,
                chunks=chunks or "auto",
                compressors=compressors if compressors is not None else "auto",
                fill_value=fill,
                dimension_names=names,
                attributes=attributes if path.startswith("dtm/") else self._identity(path) | (attributes or {}),
                # A chunk full of the fill value must be stored all the same: a missing object always means a loss.
                config={"write_empty_chunks": True},
            )
        if values.size or not values.shape:
            array[...] = values
        self._put_array(path, objects)

    def _absent(self, path: str, found: Any) -> DamagedError:
        if found is None:
            return self.damage(path, "is missing", "missing")
        return self.damage(path, f"is really {found.get('path')}", "foreign")

    def _identity(self, path: str) -> dict[str, Any]:
        return {"path": path, "made_by": self.made_by}

    def _put_array(self, path: str, objects: dict[str, Any]) -> None:
        """Put an array's objects, its metadata last: who finds it finds all of it."""
        keys = sorted(key for key in objects if key.startswith(path + "/"))
        for key in sorted(keys, key=lambda key: key.endswith("zarr.json")):
            self.put(key, objects[key].to_bytes())


def _raster(path: str, shape: tuple[int, ...], block: int, attributes: dict[str, Any]) -> tuple[dict[str, Any], Any]:
    """Make a raster in memory; return its objects, which grow as it is written, and the array."""
    objects: dict[str, Any] = {}
    array = zarr.create_array(
        MemoryStore(objects),
        name=path,
        shape=shape,
        dtype="float32",
        chunks=(block // 2, block // 2),
        shards=(block, block),
        compressors=_POINTS,
        fill_value=float("nan"),
        dimension_names=["y", "x"],
        attributes=attributes,
    )
    return objects, array


def record_path(stage: str, ident: str) -> str:
    """Return the path of a record; up to a thousand that differ in their last three characters share a folder.

    Examples
    --------
    >>> record_path("classify", "c_0012_3456"), record_path("index", "key")
    ('ledger/classify/c_0012_3/c_0012_3456', 'ledger/index/_/key')
    """
    return f"ledger/{stage}/{ident[:-3] or '_'}/{ident}"


def index_path(chunk: str) -> str:
    """Return the path of a chunk's shard of the index: one object for up to a hundred chunks of a column.

    Examples
    --------
    >>> index_path("c_0012_3456")
    'ledger/index/c_0012_34'
    """
    return f"ledger/index/{chunk[:-2]}"
