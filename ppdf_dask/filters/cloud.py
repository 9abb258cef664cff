"""What every filter receives and returns: points on the job grid, a mask, and what could not be proven."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ppdf_dask.errors import ParameterError
from ppdf_dask.grid import DENSITY_CELL, MM, Rect

Ints = npt.NDArray[np.int32]
Bools = npt.NDArray[np.bool_]

LIMIT = 2_147_000_000
"""Largest coordinate, mm, relative to the cloud's origin (int32 with room for a cell)."""


@dataclass(frozen=True)
class Cloud:
    """Eligible points on the job grid, core first.

    Attributes
    ----------
    x, y, z : ndarray of int32, shape (n,)
        Millimetres; x and y relative to `origin`, z absolute. Any order within core and buffer: no filter may let an
        index decide anything.
    origin : tuple of int
        Absolute millimetres of x = y = 0.
    n_core : int
        The first `n_core` points are asked for; the others are their surroundings.
    known : Rect or None
        Every eligible point of this absolute rectangle is present and nothing is known of the outside. None: all there
        is to know is present, the outside is empty.
    """

    x: Ints
    y: Ints
    z: Ints
    origin: tuple[int, int]
    n_core: int
    known: Rect | None = None
    fixed: Bools | None = None

    @property
    def n(self) -> int:
        """Number of points, buffer included."""
        return len(self.x)

    def metres(self) -> npt.NDArray[np.float64]:
        """Return float64 (n, 3) metres, x and y relative to `origin`: for filters that think in metres."""
        out = np.empty((self.n, 3))
        for column, values in enumerate((self.x, self.y, self.z)):
            np.divide(values, MM, out=out[:, column])
        return out


@dataclass(frozen=True)
class Verdict:
    """What a filter found out about the core points.

    Attributes
    ----------
    ground : ndarray of bool, shape (n_core,)
        True where the point is ground.
    unproven : ndarray of bool, shape (n_core,)
        True where the answer could change with a wider known area. All False when `Cloud.known` is None.
    """

    ground: Bools
    unproven: Bools


@dataclass(frozen=True)
class Density:
    """Eligible points and occupied absolute 5 m cells, counted in integers so that sums are exact."""

    points: int
    cells: int

    @property
    def per_m2(self) -> float:
        """Points per square metre of occupied cells; 0 where there is nothing."""
        return self.points / (25.0 * self.cells) if self.cells else 0.0

    def __add__(self, other: Density) -> Density:
        return Density(self.points + other.points, self.cells + other.cells)


def cloud_from_xyz(xyz: npt.ArrayLike) -> Cloud:
    """Round metres to the job grid.

    Parameters
    ----------
    xyz : array_like, shape (n, 3)
        Finite x, y, z in metres, z up.

    Returns
    -------
    Cloud
        All points are core, nothing is unknown.

    Raises
    ------
    ParameterError
        When the shape is wrong, a value is not finite, or the extent exceeds about 2000 km.

    Examples
    --------
    >>> cloud = cloud_from_xyz([[500000.001, 5400000.0, 12.3456]])
    >>> cloud.origin, cloud.x.tolist(), cloud.z.tolist()
    ((500000000, 5400000000), [1], [12346])
    """
    a = np.asarray(xyz, dtype=np.float64)
    if a.size == 0:
        a = a.reshape(0, 3)
    if a.ndim != 2 or a.shape[1] != 3:
        raise ParameterError(f"xyz has shape {a.shape}; pass an array of shape (n, 3): x, y, z in metres")
    bad = ~np.isfinite(a).all(axis=1)
    if bad.any():
        raise ParameterError(
            f"{int(bad.sum())} of {len(a)} points have a coordinate that is NaN or infinite, the first at index "
            f"{int(bad.argmax())}; remove them before filtering"
        )
    x, y, z = (to_grid(a[:, k]) for k in range(3))
    return cloud_from_grid(x, y, z)


def to_grid(metres: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Round float64 metres to int64 millimetres, by way of the micrometre.

    A value half-way between two steps (scales finer than 1 mm have them) carries float noise that depends on the file's
    scale and offset; at the micrometre the noise is gone, so equal places get equal integers whatever their file.
    """
    micro = np.rint(metres * 1e6).astype(np.int64)
    micro += 500
    micro //= 1000
    return micro


def cloud_from_grid(
    x: npt.NDArray[np.int64], y: npt.NDArray[np.int64], z: npt.NDArray[np.int64], fixed: Bools | None = None
) -> Cloud:
    """Make a fully known cloud of absolute millimetres."""
    if len(x) == 0:
        empty = np.empty(0, np.int32)
        return Cloud(empty, empty, empty, (0, 0), 0)
    ox, oy = (int(v.min()) // MM * MM for v in (x, y))
    for name, values, origin in (("x", x, ox), ("y", y, oy), ("z", z, 0)):
        far = max(abs(int(values.max()) - origin), abs(int(values.min()) - origin))
        if far > LIMIT:
            raise ParameterError(
                f"{name} reaches {far / MM:.0f} m from the cloud's own origin, more than {LIMIT / MM:.0f} m; "
                "remove the stray points or use a survey run, which isolates them"
            )
    return Cloud(
        (x - ox).astype(np.int32), (y - oy).astype(np.int32), z.astype(np.int32), (ox, oy), len(x), None, fixed
    )


def density(cloud: Cloud) -> Density:
    """Count points and occupied absolute 5 m cells of a fully known cloud."""
    if cloud.n == 0:
        return Density(0, 0)
    ox, oy = cloud.origin
    i = (cloud.x.astype(np.int64) + ox) // DENSITY_CELL
    j = (cloud.y.astype(np.int64) + oy) // DENSITY_CELL
    i -= i.min()
    j -= j.min()
    key = i * (int(j.max()) + 1) + j
    return Density(cloud.n, len(np.unique(key)))
