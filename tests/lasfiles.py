"""Small LAS and LAZ files for the tests, and ways to make them lie."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import laspy
import numpy as np

OFFSET_TO_POINTS, VLR_COUNT, FORMAT, RECORD_LENGTH, LEGACY_COUNT = 96, 100, 104, 105, 107
SCALES, OFFSETS, BOUNDS, EVLR_START, EVLR_COUNT, COUNT = 131, 155, 179, 235, 243, 247


def points(n: int, seed: int = 0) -> np.ndarray:
    """Return n points as integer millimetres, a 100 m square near Grenoble."""
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [
            rng.integers(917_000_000, 917_100_000, n),
            rng.integers(6_450_000_000, 6_450_100_000, n),
            rng.integers(200_000, 240_000, n),
        ]
    )


def write(
    path: Path,
    mm: np.ndarray | None = None,
    *,
    point_format: int = 6,
    version: str = "1.4",
    scale: float = 0.001,
    offset: tuple[float, float, float] = (917_000.0, 6_450_000.0, 0.0),
    crs: Any = None,
    **dims: Any,
) -> Path:
    """Write points given in millimetres; LAZ unless the suffix is .las; `dims` are attributes by their laspy name."""
    import pyproj

    mm = points(1000) if mm is None else mm
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [scale] * 3, list(offset)
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs), keep_compatibility=point_format < 6)
    las = laspy.LasData(header)
    steps = [np.round((mm[:, k] / 1000 - offset[k]) / scale).astype(np.int32) for k in range(3)]
    las.X, las.Y, las.Z = steps
    for name, values in dims.items():
        las[name] = np.broadcast_to(values, len(mm))
    path.parent.mkdir(parents=True, exist_ok=True)
    las.write(path, do_compress=path.suffix.lower() != ".las", laz_backend=laspy.LazBackend.Lazrs)
    return path


def write_copc(path: Path, mm: np.ndarray | None = None, **options: Any) -> Path:
    """Write a true COPC file: a root node and its eight octants, one chunk each, and the hierarchy that says where."""
    import io

    import lazrs

    mm = points(4000) if mm is None else mm
    source = write(path.with_suffix(".las"), mm, **options)
    head = bytearray(source.read_bytes())
    source.unlink()
    start, count = struct.unpack_from("<II", head, OFFSET_TO_POINTS)
    length = struct.unpack_from("<H", head, RECORD_LENGTH)[0]
    rows = np.frombuffer(bytes(head[start : start + len(mm) * length]), np.uint8).reshape(-1, length)
    half = float(np.ptp(mm, axis=0).max()) / 2000 + 0.001
    centre = (mm.min(axis=0) + mm.max(axis=0)) / 2000
    octant = (mm / 1000 >= centre).astype(int)
    octant[::10] = -1  # every tenth point is the root's
    laszip = lazrs.LazVlr.new_for_compression(struct.unpack_from("<B", head, FORMAT)[0], 0, True)
    record = bytes(laszip.record_data())
    records = bytes(head[375:start]) + struct.pack("<H16sHH32s", 0, b"laszip encoded", 22204, len(record), b"") + record
    first = 375 + 54 + 160 + len(records)
    out = io.BytesIO(bytes(first))
    out.seek(first)
    compressor, nodes = lazrs.LasZipCompressor(out, laszip), []
    for key in [(-1, -1, -1), *sorted({tuple(o) for o in octant.tolist()} - {(-1, -1, -1)})]:
        mine = np.flatnonzero((octant == key).all(axis=1))
        before = out.tell() if nodes else first + 8
        compressor.compress_many(rows[mine].reshape(-1))
        compressor.finish_current_chunk()
        name = (0, 0, 0, 0) if key[0] < 0 else (1, *key)
        nodes.append(struct.pack("<4iQii", *name, before, out.tell() - before, len(mine)))
    compressor.done()
    out.seek(0, 2)
    evlr, page = out.tell(), b"".join(nodes)
    out.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(page), b"EPT Hierarchy") + page)
    info = struct.pack("<5dQQ2d", *centre, half, half / 64, evlr + 60, len(page), 0.0, 0.0) + bytes(88)
    entry = struct.pack("<H16sHH32s", 0, b"copc", 1, 160, b"COPC info VLR") + info
    struct.pack_into("<II", head, OFFSET_TO_POINTS, first, count + 2)
    struct.pack_into("<QI", head, EVLR_START, evlr, 1)
    head[FORMAT] |= 0x80
    path.write_bytes(bytes(head[:375]) + entry + records + out.getvalue()[first:])
    return path


def patch(path: Path, position: int, layout: str, *values: Any) -> Path:
    """Overwrite bytes at a position."""
    data = bytearray(path.read_bytes())
    struct.pack_into("<" + layout, data, position, *values)
    path.write_bytes(data)
    return path


def peek(path: Path, position: int, layout: str) -> Any:
    """Read bytes at a position."""
    return struct.unpack_from("<" + layout, path.read_bytes(), position)[0]


def laszip_record(path: Path) -> int:
    """Return the position of the laszip VLR's data."""
    return path.read_bytes().index(b"laszip encoded") - 2 + 54


@contextmanager
def no_more_than(limit: int) -> Iterator[None]:
    """Fail when Python or NumPy hold more than `limit` bytes at any time inside."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < limit
