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
