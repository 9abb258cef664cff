"""Small random and nasty clouds, and plain-Python rasters, shared by the tests of the classic filters."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from ppdf_dask.filters.cloud import Cloud, cloud_from_grid

INF = float("inf")


def cloud_of(points, n_core=None):
    """A cloud of absolute integer millimetres."""
    a = np.asarray(points, np.int64).reshape(-1, 3)
    cloud = cloud_from_grid(a[:, 0], a[:, 1], a[:, 2])
    n_core = cloud.n if n_core is None else n_core
    return Cloud(cloud.x, cloud.y, cloud.z, cloud.origin, n_core)


@st.composite
def points(draw, most=60, extent=12_000, height=4_000):
    """Lists of (x, y, z) in mm, on steps that make ties, duplicates and gridded coordinates likely."""
    step = draw(st.sampled_from([1, 250, 500, 1000]))
    origin = draw(st.sampled_from([(0, 0), (-3_250, 7_125), (612_345_678, 5_400_000_500)]))
    rise = draw(st.sampled_from([0, 0, 300, -900]))
    rows = draw(
        st.lists(
            st.tuples(
                st.integers(0, extent // step),
                st.integers(0, extent // step),
                st.integers(-height // 100, height // 100),
            ),
            max_size=most,
        )
    )
    out = [(x * step, y * step, z * 100 + rise * (x * step) // 1000) for x, y, z in rows]
    if out and draw(st.booleans()):
        out += out[: draw(st.integers(1, len(out)))]
    return [(x + origin[0], y + origin[1], z) for x, y, z in out]


def nasty():
    """Named clouds that have broken ground filters."""
    rng = np.random.default_rng(3)
    plain = [(int(x), int(y), int(z)) for x, y, z in rng.integers(0, [20_000, 20_000, 500], (300, 3))]
    return {
        "empty": [],
        "one": [(5, 5, 5)],
        "two": [(0, 0, 0), (9_000, 0, 50_000)],
        "identical": [(123_456, 7, 8)] * 40,
        "two places": [(0, 0, 0), (1000, 0, 0)] * 20,
        "one column": [(500, 500, 100 * k) for k in range(50)],
        "line along x": [(700 * k, 250, 10 * k) for k in range(60)],
        "diagonal line": [(333 * k, 333 * k, (k * 37) % 400) for k in range(60)],
        "grid": [(1000 * i, 1000 * j, 0) for i in range(15) for j in range(15)],
        "stray point 2000 km away": [*plain, (2_000_000_000, 3_000, 0)],
        "low outlier": [*plain, (10_000, 10_000, -80_000)],
        "high outlier": [*plain, (10_000, 10_000, 900_000)],
        "negative coordinates": [(x - 1_000_000, y - 7_777_777, z - 5000) for x, y, z in plain],
    }


def cells(points, step):
    """Lowest height per absolute cell, and the cell range: {(column, row): z}, (c0, c1, r0, r1)."""
    low = {}
    for x, y, z in points:
        at = (x // step, y // step)
        low[at] = min(z, low.get(at, INF))
    columns, rows = zip(*low, strict=True)
    return low, (min(columns), max(columns), min(rows), max(rows))


def fill(low, box, wanted):
    """Fill every cell of the box with the mean of its nearest filled cells, ties of the last included."""
    out = {}
    for c in range(box[0], box[1] + 1):
        for r in range(box[2], box[3] + 1):
            if (c, r) in low:
                out[c, r] = float(low[c, r])
                continue
            near = sorted(((cc - c) ** 2 + (rr - r) ** 2, z) for (cc, rr), z in low.items())
            last = near[min(wanted, len(near)) - 1][0]
            heights = [z for d2, z in near if d2 <= last]
            out[c, r] = sum(heights) / len(heights)
    return out


def extreme(surface, radius, shape, pick):
    """The lowest (pick=min) or highest (pick=max) height within a diamond or square around each cell."""
    out = {}
    for c, r in surface:
        out[c, r] = pick(
            surface[c + i, r + j]
            for i in range(-radius, radius + 1)
            for j in range(-radius, radius + 1)
            if (c + i, r + j) in surface and (shape == "square" or abs(i) + abs(j) <= radius)
        )
    return out


def opened(surface, radius, shape="diamond"):
    """The opening: the highest of the lowest."""
    return extreme(extreme(surface, radius, shape, min), radius, shape, max)
