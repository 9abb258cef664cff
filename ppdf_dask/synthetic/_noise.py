"""Numbers from places: integer hashing and gradient noise, the same wherever and in whatever order they are asked.

Only integer arithmetic, the four operations and square roots are used, so that every machine gives the same survey.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_A = np.uint64(0x9E3779B97F4A7C15)
_B = np.uint64(0xC2B2AE3D27D4EB4F)
_C = np.uint64(0xBF58476D1CE4E5B9)
_D = np.uint64(0x94D049BB133111EB)
_LOW = np.uint64(0xFFFFFFFF)
_UNIT = 1.0 / 9007199254740992.0
_HALF_UNIT = 1.0 / 4294967296.0


@njit(nogil=True, cache=True)
def mixed(h: np.uint64) -> np.uint64:
    """Return the bits of `h` scrambled (the finaliser of SplitMix64, Steele et al. 2014)."""
    h = (h ^ (h >> np.uint64(30))) * _C
    h = (h ^ (h >> np.uint64(27))) * _D
    return h ^ (h >> np.uint64(31))


@njit(nogil=True, cache=True)
def cell_hash(ix: int | np.int64, iy: int | np.int64, salt: np.uint64) -> np.uint64:
    """Return 64 bits that depend on a lattice cell and a salt only."""
    return mixed(np.uint64(ix) * _A + np.uint64(iy) * _B + salt)


@njit(nogil=True, cache=True)
def following(h: np.uint64) -> np.uint64:
    """Return the next 64 bits of the sequence that starts at `h`."""
    return mixed(h + _A)


@njit(nogil=True, cache=True)
def unit(h: np.uint64) -> float:
    """Return the hash as a number in [0, 1)."""
    return np.float64(h >> np.uint64(11)) * _UNIT


@njit(nogil=True, cache=True)
def bell(h: np.uint64) -> float:
    """Return a bell-shaped number of mean 0 and standard deviation 1 (four uniform ones added), within +-2 sqrt(3)."""
    g = mixed(h + _B)
    low = np.float64(h & _LOW) + np.float64(h >> np.uint64(32))
    total = low + np.float64(g & _LOW) + np.float64(g >> np.uint64(32))
    return (total * _HALF_UNIT - 2.0) * 1.7320508075688772


@njit(nogil=True, cache=True)
def _corner(ix: int | np.int64, iy: int | np.int64, salt: np.uint64, dx: float, dy: float) -> float:
    h = cell_hash(ix, iy, salt)
    gx = np.float64(h & _LOW) * _HALF_UNIT - 0.5
    gy = np.float64(h >> np.uint64(32)) * _HALF_UNIT - 0.5
    return gx * dx + gy * dy


@njit(nogil=True, cache=True)
def noise(x: float, y: float, salt: np.uint64) -> float:
    """Return gradient noise (Perlin 2002) of unit lattice: mean 0, standard deviation about 0.1, within +-0.5."""
    fx, fy = np.floor(x), np.floor(y)
    ix, iy = np.int64(fx), np.int64(fy)
    dx, dy = x - fx, y - fy
    u = dx * dx * dx * (dx * (dx * 6.0 - 15.0) + 10.0)
    v = dy * dy * dy * (dy * (dy * 6.0 - 15.0) + 10.0)
    n00 = _corner(ix, iy, salt, dx, dy)
    n10 = _corner(ix + 1, iy, salt, dx - 1.0, dy)
    n01 = _corner(ix, iy + 1, salt, dx, dy - 1.0)
    n11 = _corner(ix + 1, iy + 1, salt, dx - 1.0, dy - 1.0)
    low = n00 + u * (n10 - n00)
    return float(low + v * (n01 + u * (n11 - n01) - low))
