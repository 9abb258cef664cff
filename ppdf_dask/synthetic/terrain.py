"""The terrain: a height for every place on Earth, from a seed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ppdf_dask.synthetic._noise import noise
from ppdf_dask.synthetic.params import SyntheticParams


class Relief(NamedTuple):
    """The terrain's constants as the kernels take them: `SyntheticParams` with angles and salts worked out."""

    salt: np.uint64
    east: float
    north: float
    elevation: float
    gradient: float
    length: float
    floor: float
    crest: float
    rounding: float
    spurs: float
    meander: float
    roughness: float
    terrace: float
    scarp: float
    stream: float
    lake: float


def relief(params: SyntheticParams) -> Relief:
    """Work out the kernels' constants; the ridges' direction follows from the seed."""
    # Half the tangent of the direction: cosine and sine without a transcendental function.
    half = ((params.seed * 2654435761) % 1000) / 500.0 - 1.0
    wet = params.water != "none"
    return Relief(
        salt=np.uint64((params.seed + 1) * 0x9E3779B97F4A7C15 % 2**64),
        east=(1.0 - half * half) / (1.0 + half * half),
        north=2.0 * half / (1.0 + half * half),
        elevation=params.elevation,
        gradient=round(math.tan(math.radians(params.slope)), 9),
        length=params.relief_length,
        floor=params.valley_floor,
        crest=params.crest,
        rounding=params.rounding,
        spurs=params.spurs,
        meander=params.meander,
        roughness=params.roughness,
        terrace=params.terrace_height,
        scarp=params.scarp_height,
        stream=params.stream_width / 2 if wet else 0.0,
        lake=params.lake_width if wet else 0.0,
    )


def true_height(x: ArrayLike, y: ArrayLike, params: SyntheticParams) -> NDArray[np.float64]:
    """Return the terrain's exact height; on water, the water's level.

    Parameters
    ----------
    x, y : array_like
        Place in metres, of the same shape.
    params : SyntheticParams
        The survey.

    Returns
    -------
    numpy.ndarray of float64, shape as `x`
        Height in metres.

    Examples
    --------
    >>> params = SyntheticParams(slope=0.0, roughness=0.0, terrace_height=0.0, scarp_height=0.0, water="none")
    >>> true_height([500_000.0, 500_050.0], [5_400_000.0, 5_400_000.0], params)
    array([400., 400.])
    """
    xs, ys = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    flat = _heights(np.ascontiguousarray(xs).ravel(), np.ascontiguousarray(ys).ravel(), relief(params))
    return np.asarray(flat, dtype=np.float64).reshape(xs.shape)


@njit(nogil=True, cache=True)
def _heights(x: NDArray[np.float64], y: NDArray[np.float64], r: Relief) -> NDArray[np.float64]:
    out = np.empty(x.size)
    for i in range(x.size):
        out[i] = height(x[i], y[i], r)[0]
    return out


@njit(nogil=True, cache=True)
def _ramp(u: float, radius: float) -> float:
    """Return max(u, 0) with its corner rounded by a parabola of half width `radius`."""
    if u <= -radius:
        return 0.0
    if u >= radius:
        return u
    return (u + radius) * (u + radius) / (4.0 * radius)


@njit(nogil=True, cache=True)
def _step(u: float) -> float:
    """Return a smooth step from 0 at u <= 0 to 1 at u >= 1."""
    u = min(1.0, max(0.0, u))
    return u * u * (3.0 - 2.0 * u)


@njit(nogil=True, cache=True)
def _from_axis(s: float, length: float) -> float:
    """Return the distance to the nearest valley axis; axes lie at multiples of twice `length`."""
    period = 2.0 * length
    m = s - np.floor(s / period) * period
    return float(min(m, period - m))


@njit(nogil=True, cache=True)
def height(x: float, y: float, r: Relief) -> tuple[float, bool]:
    """Return the terrain's height at a place, and whether it is under water."""
    salt = r.salt
    l1, l2 = r.length, 0.77 * r.length
    along = r.east * x + r.north * y
    across = r.east * y - r.north * x
    # Valleys and ridges: a bent zigzag with flats, so that flanks have one slope and edges are where we want them.
    bend = r.meander * noise(x / (1.9 * l1), y / (1.9 * l1), salt)
    axis = _from_axis(along + 3.0 * l1 * bend, l1)
    rise = _ramp(axis - r.floor, r.rounding) - _ramp(axis - (l1 - r.crest), r.rounding)
    up = _step(axis / l1)
    scale = r.gradient / np.sqrt(1.0 + r.spurs * r.spurs)
    z = scale * rise
    if r.spurs > 0.0:
        side = _from_axis(across + 3.0 * l2 * r.meander * noise(x / l1 + 0.5, y / l1, salt + np.uint64(1)), l2)
        z += scale * r.spurs * up * (_ramp(side - r.floor, r.rounding) - _ramp(side - (l2 - r.crest), r.rounding))
    z += 1.5 * r.gradient * l1 * up * noise(x / (3.7 * l1), y / (3.7 * l1), salt + np.uint64(2))
    if r.terrace > 0.0:
        share = _step(16.0 * (noise(x / (1.1 * l1), y / (1.1 * l1), salt + np.uint64(3)) - 0.06) + 0.5)
        if share > 0.0:
            q = z / r.terrace
            k = np.floor(q)
            z += share * (r.terrace * (k + min(1.0, max(0.0, (q - k - 0.4) / 0.2))) - z)
    if r.scarp > 0.0:
        line = 5.0 * l1 * noise(x / (1.6 * l1), y / (1.6 * l1) + 0.3, salt + np.uint64(4))
        z += r.scarp * min(1.0, max(0.0, 0.5 + line / (0.8 * r.scarp)))
    if r.roughness > 0.0:
        # The absolute value of noise folds the ground into gullies with sharp beds.
        rough = 4.0 * up * abs(noise(x / 41.0, y / 41.0, salt + np.uint64(5)))
        rough += noise(x / 15.0, y / 15.0, salt + np.uint64(6)) + 0.5 * noise(x / 5.3, y / 5.3, salt + np.uint64(7))
        z += r.roughness * rough
    wet = False
    if r.stream > 0.0 or r.lake > 0.0:
        shore = r.stream
        if r.lake > 0.0:
            shore += r.lake * min(1.0, max(0.0, 5.0 * noise(x / (2.0 * l1), y / (2.0 * l1), salt + np.uint64(8))))
        bank = 3.0 + 0.2 * shore
        wet = axis < shore
        z = -1.0 + _step((axis - shore) / bank) * (z + 1.0)
    return r.elevation + z, wet
