"""A terrestrial scan of a forest plot with known ground: what a tripod sees, and what it does not."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ppdf_dask.errors import ParameterError
from ppdf_dask.synthetic._noise import noise

Kind = Literal["flat", "slope", "complex"]
THINGS = ("ground", "stem", "stump", "shrub", "outlier")
"""What a point of a plot belongs to; branches count as stem."""

_EYE = 1.6
_STUMP = 3.0
_FULL_DENSITY_RANGE = 5.0
_RANGE_NOISE = 0.004


class _Scene(NamedTuple):
    """Ground form and the things on it; cylinders: x, y, radius, top above ground; shrubs: x, y, z, radius."""

    slope: float
    swell: float
    step: float
    salt: np.uint64
    cylinders: NDArray[np.float64]
    shrubs: NDArray[np.float64]
    stations: NDArray[np.float64]


_FORMS: dict[str, tuple[float, float, float]] = {
    "flat": (0.02, 0.3, 0.0),
    "slope": (0.42, 0.6, 0.0),
    "complex": (0.2, 1.2, 0.6),
}
"""Slope (tangent), height of swells and of terrace steps, m."""


def terrestrial_plot(
    kind: Kind = "flat", seed: int = 1, *, edge: float = 16.0, density: float = 800.0
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return a terrestrial scan and its true ground.

    Parameters
    ----------
    kind : {"flat", "slope", "complex"}
        Nearly level; a slope of 23 degrees; hummocks with terraces of 0.6 m.
    seed : int
        Another seed is another plot.
    edge : float
        Edge of the square plot, m, 5 to 50; default 16, a usual sample plot.
    density : float
        Points per m2 of surface near a tripod, 10 to 5000; it falls with the square of the distance beyond 5 m.

    Returns
    -------
    xyz : numpy.ndarray of float64, shape (N, 3)
        Points in metres, multiples of 1 mm, around (0, 0); in no particular order.
    ground : numpy.ndarray of bool, shape (N,)
        True for points of the ground.

    Raises
    ------
    ParameterError
        When the kind is unknown or a number is out of range.

    Notes
    -----
    Stems to 9 m, stumps, shrubs and branches, outliers below and above the ground; three tripods, the surface points
    hidden from all of them by stems, stumps, shrubs or terrace edges are left out. In the place of the plots of the
    thesis (Li, Stuttgart), which are not public.

    Examples
    --------
    >>> xyz, ground = terrestrial_plot("slope", seed=3, edge=8.0, density=100.0)
    >>> xyz.shape[1], bool(0.1 < ground.mean() < 0.9)
    (3, True)
    """
    xyz, thing = terrestrial_things(kind, seed, edge=edge, density=density)
    return xyz, thing == 0


def terrestrial_things(
    kind: Kind = "flat", seed: int = 1, *, edge: float = 16.0, density: float = 800.0
) -> tuple[NDArray[np.float64], NDArray[np.int8]]:
    """Return the scan of `terrestrial_plot`, and what each point belongs to: its number in `THINGS`, 0 the ground.

    Examples
    --------
    >>> xyz, thing = terrestrial_things("flat", seed=3, edge=8.0, density=100.0)
    >>> [name for k, name in enumerate(THINGS) if (thing == k).any()]
    ['ground', 'stem', 'stump', 'shrub', 'outlier']
    """
    if kind not in get_args(Kind):
        raise ParameterError(f"kind = {kind!r} is unknown; choose 'flat', 'slope' or 'complex'")
    if not (5.0 <= edge <= 50.0 and 10.0 <= density <= 5000.0):
        raise ParameterError(f"edge = {edge} m must be 5 to 50 and density = {density} points/m2 10 to 5000")
    rng = np.random.default_rng(seed)
    scene = _scene(kind, seed, edge, rng)
    terrain = _ground_points(scene, edge, density, rng)
    wood, of_stem = _cylinder_points(scene, density, rng)
    leaves = _shrub_points(scene, density, rng)
    surfaces = [
        (terrain, np.zeros(len(terrain), np.int8)),
        (wood, np.where(of_stem, 1, 2).astype(np.int8)),
        (leaves, np.full(len(leaves), 3, np.int8)),
    ]
    masks = [_visible(points, scene, rng.random(len(points))) for points, _ in surfaces]
    stray = _outliers(scene, edge, int(masks[0].sum()), rng)
    xyz = np.concatenate([*(points[mask] for (points, _), mask in zip(surfaces, masks, strict=True)), stray])
    thing = np.concatenate(
        [*(what[mask] for (_, what), mask in zip(surfaces, masks, strict=True)), np.full(len(stray), 4, np.int8)]
    )
    order = rng.permutation(len(xyz))
    return np.round(xyz[order], 3), thing[order]


def _scene(kind: str, seed: int, edge: float, rng: np.random.Generator) -> _Scene:
    area, half = edge * edge, 0.5 * edge
    stations = np.array([(0.0, 0.0), (-0.4 * edge, 0.35 * edge), (0.35 * edge, -0.4 * edge)])
    stems, stumps, bushes = round(0.09 * area), round(0.05 * area), round(0.06 * area)
    things = np.column_stack(
        [
            rng.uniform(-half, half, (stems + stumps, 2)),
            np.concatenate([rng.uniform(0.08, 0.28, stems), rng.uniform(0.15, 0.38, stumps)]),
            np.concatenate([rng.uniform(6.0, 9.0, stems), rng.uniform(0.15, 0.7, stumps)]),
        ]
    )
    apart = np.linalg.norm(things[:, None, :2] - stations, axis=2).min(axis=1) > 1.0
    shrubs = np.column_stack(
        [rng.uniform(-half, half, (bushes, 2)), np.zeros(bushes), 0.2 + 0.6 * rng.random(bushes) ** 2]
    )
    shrubs = shrubs[np.linalg.norm(shrubs[:, None, :2] - stations, axis=2).min(axis=1) > 1.5]
    slope, swell, step = _FORMS[kind]
    salt = np.uint64(0x7E55 + 977 * seed)
    scene = _Scene(slope, swell, step, salt, things[apart], shrubs, np.column_stack([stations, np.zeros(3)]))
    scene.shrubs[:, 2] = _heights(shrubs[:, :2], scene) + 0.6 * shrubs[:, 3]
    scene.stations[:, 2] = _heights(stations, scene) + _EYE
    return scene


def _ground_points(scene: _Scene, edge: float, density: float, rng: np.random.Generator) -> NDArray[np.float64]:
    xy = rng.uniform(-0.5 * edge, 0.5 * edge, (round(edge * edge * density), 2))
    for x, y, radius, _ in scene.cylinders:
        xy = xy[(xy[:, 0] - x) ** 2 + (xy[:, 1] - y) ** 2 > radius * radius]
    return np.column_stack([xy, _heights(xy, scene) + _jitter(len(xy), rng)])


def _cylinder_points(
    scene: _Scene, density: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return points on the sides and tops of stems and stumps, and which are a stem's.

    Stems taper and carry short dead branches.
    """
    parts, of_stem = [np.empty((0, 3))], [np.empty(0, np.bool_)]
    for x, y, radius, top in scene.cylinders:
        foot = _heights(np.array([[x, y]]), scene)[0]
        n = round(2.0 * np.pi * radius * top * density)
        # Above and below the foot's height: on a slope the stem's lower side starts lower.
        up = rng.uniform(-0.3, top, n)
        angle = rng.uniform(0.0, 2.0 * np.pi, n)
        r = radius * (1.0 - 0.5 * np.maximum(up, 0.0) / 9.0) + _jitter(n, rng)
        side = np.column_stack([x + r * np.cos(angle), y + r * np.sin(angle), foot + up])
        side = side[side[:, 2] > _heights(side[:, :2], scene) + 0.02]
        n = round(np.pi * radius * radius * density)
        angle, r = rng.uniform(0.0, 2.0 * np.pi, n), radius * np.sqrt(rng.random(n))
        cap = np.column_stack([x + r * np.cos(angle), y + r * np.sin(angle), foot + top + _jitter(n, rng)])
        parts += [side, cap]
        of_stem.append(np.full(len(side) + len(cap), top > _STUMP))
        if top > _STUMP:
            n = round(0.15 * density)
            angle, r = np.repeat(rng.uniform(0.0, 2.0 * np.pi, 8), n // 8), rng.uniform(radius, 0.9, n // 8 * 8)
            up = np.repeat(rng.uniform(1.5, top, 8), n // 8) - 0.2 * r
            parts.append(np.column_stack([x + r * np.cos(angle), y + r * np.sin(angle), foot + up]))
            of_stem.append(np.ones(len(up), np.bool_))
    return np.concatenate(parts), np.concatenate(of_stem)


def _shrub_points(scene: _Scene, density: float, rng: np.random.Generator) -> NDArray[np.float64]:
    parts = []
    for x, y, z, radius in scene.shrubs:
        n = round(5.0 * radius * radius * density)
        away = rng.normal(size=(n, 3))
        away *= (radius * rng.random(n) ** 0.5 / np.linalg.norm(away, axis=1))[:, None]
        leaves = away + np.array([x, y, z])
        parts.append(leaves[leaves[:, 2] > _heights(leaves[:, :2], scene) + 0.05])
    return np.concatenate([np.empty((0, 3)), *parts])


def _outliers(scene: _Scene, edge: float, ground: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return stray points, a thousandth of the ground's number: half below it, half above, some in groups of three."""
    n = max(6, ground // 1000)
    xy = rng.uniform(-0.5 * edge, 0.5 * edge, (n, 2))
    xy[1::4] = xy[::4][: len(xy[1::4])] + 0.05
    xy[2::4] = xy[::4][: len(xy[2::4])] - 0.05
    above = np.where(np.arange(n) // 4 % 2 == 0, -1.0, 1.0) * rng.uniform(0.3, 3.0, n)
    return np.column_stack([xy, _heights(xy, scene) + above])


def _jitter(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    return np.clip(rng.normal(0.0, _RANGE_NOISE, n), -3 * _RANGE_NOISE, 3 * _RANGE_NOISE)


def _heights(xy: NDArray[np.float64], scene: _Scene) -> NDArray[np.float64]:
    out = np.empty(len(xy))
    _fill_heights(np.ascontiguousarray(xy), scene, out)
    return out


@njit(nogil=True, cache=True)
def _form(x: float, y: float, s: _Scene) -> float:
    """Return the ground without its fine relief, which hides nothing."""
    z = s.slope * (x + 0.3 * y) + 4.0 * s.swell * noise(x / 7.3, y / 7.3, s.salt)
    if s.step > 0.0:
        q = z / s.step
        k = np.floor(q)
        share = min(1.0, max(0.0, 0.5 + 6.0 * noise(x / 9.1, y / 9.1, s.salt + np.uint64(1))))
        z += share * (s.step * (k + min(1.0, max(0.0, (q - k - 0.42) / 0.16))) - z)
    return float(z)


@njit(nogil=True, cache=True)
def _fill_heights(xy: NDArray[np.float64], s: _Scene, out: NDArray[np.float64]) -> None:
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        fine = 0.25 * noise(x / 1.1, y / 1.1, s.salt + np.uint64(2)) + 0.08 * noise(
            x / 0.3, y / 0.3, s.salt + np.uint64(3)
        )
        out[i] = _form(x, y, s) + fine


@njit(nogil=True, cache=True)
def _visible(points: NDArray[np.float64], s: _Scene, chance: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell for each point whether a beam of at least one tripod reaches it; shrubs let a third of the beams pass."""
    seen = np.zeros(len(points), np.bool_)
    for i in range(len(points)):
        missed = 1.0
        for k in range(len(s.stations)):
            missed *= 1.0 - _reaches(points, i, s, k)
        seen[i] = chance[i] < 1.0 - missed
    return seen


@njit(nogil=True, cache=True)
def _reaches(points: NDArray[np.float64], i: int, s: _Scene, k: int) -> float:
    x0, y0, z0 = s.stations[k, 0], s.stations[k, 1], s.stations[k, 2]
    dx, dy, dz = points[i, 0] - x0, points[i, 1] - y0, points[i, 2] - z0
    flat = dx * dx + dy * dy
    if flat < 0.25:
        # The tripod's own blind spot.
        return 0.0
    share = min(1.0, _FULL_DENSITY_RANGE * _FULL_DENSITY_RANGE / (flat + dz * dz))
    for c in range(len(s.cylinders)):
        t = ((s.cylinders[c, 0] - x0) * dx + (s.cylinders[c, 1] - y0) * dy) / flat
        if t <= 0.0 or t >= 1.0:
            continue
        ax, ay = x0 + t * dx - s.cylinders[c, 0], y0 + t * dy - s.cylinders[c, 1]
        radius = 0.95 * s.cylinders[c, 2]
        if ax * ax + ay * ay < radius * radius:
            foot = _form(s.cylinders[c, 0], s.cylinders[c, 1], s)
            if z0 + t * dz < foot + s.cylinders[c, 3] - 0.02:
                return 0.0
    for b in range(len(s.shrubs)):
        hx, hy, hz = s.shrubs[b, 0] - x0, s.shrubs[b, 1] - y0, s.shrubs[b, 2] - z0
        t = (hx * dx + hy * dy + hz * dz) / (flat + dz * dz)
        if t <= 0.0 or t >= 1.0:
            continue
        ax, ay, az = t * dx - hx, t * dy - hy, t * dz - hz
        if ax * ax + ay * ay + az * az < s.shrubs[b, 3] * s.shrubs[b, 3]:
            share *= 0.35
    for step in range(1, 24):
        t = step / 24.0
        if z0 + t * dz < _form(x0 + t * dx, y0 + t * dy, s) - 0.05:
            return 0.0
    return float(share)
