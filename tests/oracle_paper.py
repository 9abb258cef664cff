"""PPDF as published in plain Python: the readable twin of `filters/ppdf/paper`, with the same order of operations.

Every test of a float against a limit notes how near it came (`Close`), so that a differing mask can be told from a
rounding at a threshold. Works on absolute integer millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

M64 = 2**64 - 1
GOLDEN = 0x9E3779B97F4A7C15


def mix(v):
    v = (v ^ (v >> 30)) * 0xBF58476D1CE4E5B9 & M64
    v = (v ^ (v >> 27)) * 0x94D049BB133111EB & M64
    return v ^ (v >> 31)


def seed_of(ix, iy, size):
    seed = mix((size + GOLDEN) & M64)
    seed = mix(seed ^ (ix & M64))
    return mix((seed + GOLDEN & M64) ^ (iy & M64))


def draw(seed, k, n):
    return (mix((seed + (k + 1) * GOLDEN) & M64) >> 32) * n >> 32


@dataclass
class Close:
    """How many comparisons fell within 1e-9 (relative) of their limit."""

    count: int = 0
    limits: list = field(default_factory=list)

    def below(self, value, limit):
        if abs(value - limit) <= 1e-9 * max(1.0, abs(limit)):
            self.count += 1
        return value < limit


def canopy(points, cell, height):
    lowest = {}
    for x, y, z in points:
        key = x // cell, y // cell
        lowest[key] = min(z, lowest.get(key, z))
    return [z - lowest[x // cell, y // cell] < height for x, y, z in points]


def triple(seed, trial, n):
    i, j, k = draw(seed, 3 * trial, n), draw(seed, 3 * trial + 1, n - 1), draw(seed, 3 * trial + 2, n - 2)
    left = [m for m in range(n) if m != i]
    j = left[j]
    left.remove(j)
    return i, j, left[k]


def signed(plane, p):
    (a, b, c), base, off = plane
    dx, dy, dz = ((p[k] - base[k]) - off[k] for k in range(3))
    return a * dx + b * dy + c * dz


def trials(support, n):
    w = support / n
    q = 1.0 - w * w * w
    left, k = q, 1
    while left > 0.01 and k < 1000:
        left, k = left * q, k + 1
    return max(50, k)


def ransac(points, seed, limit, close):
    n = len(points)
    most = min(1000, math.comb(n, 3))
    best = (0, 0.0, None)
    trial, planned = 0, most
    while trial < planned:
        p, q, r = (points[m] for m in triple(seed, trial, n))
        trial += 1
        ax, ay, az = (float(q[k] - p[k]) for k in range(3))
        bx, by, bz = (float(r[k] - p[k]) for k in range(3))
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
        if norm == 0 or close.below(abs(nz), 0.087 * norm):
            continue
        norm = -norm if nz < 0 else norm
        plane = (nx / norm, ny / norm, nz / norm), p, (0.0, 0.0, 0.0)
        near = [s for s in (abs(signed(plane, t)) for t in points) if close.below(s, limit)]
        misfit = 0.0
        for s in near:
            misfit += s
        if len(near) > best[0]:
            planned = min(most, trials(len(near), n))
            best = len(near), misfit, plane
        elif len(near) == best[0] and misfit < best[1]:
            best = len(near), misfit, plane
    return best[0], best[2]


def refit(points, support, limit, plane, close):
    inliers = [p for p in points if close.below(abs(signed(plane, p)), limit)]
    base = plane[1]
    mean = tuple(sum(p[k] - base[k] for p in inliers) / support for k in range(3))
    d = [tuple((p[k] - base[k]) - mean[k] for k in range(3)) for p in inliers]
    sxx, sxy, syy, sxz, syz = (ordered(v[i] * v[j] for v in d) for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2)))
    det = sxx * syy - sxy * sxy
    if det <= 1e-6 * (sxx + syy) * (sxx + syy):
        return support, plane
    p, q = (sxz * syy - syz * sxy) / det, (syz * sxx - sxz * sxy) / det
    norm = math.sqrt(1.0 + p * p + q * q)
    if close.below(1.0, 0.087 * norm):
        return support, plane
    fitted = (-p / norm, -q / norm, 1.0 / norm), base, mean
    count = sum(close.below(abs(signed(fitted, t)), limit) for t in points)
    return (count, fitted) if count >= support else (support, plane)


def ordered(values):
    total = 0.0
    for v in values:
        total += v
    return total


def planes(points, under, params, close):
    """Return the seeds and, per plane, (column, row, level, support); points in canonical order."""
    edge = round(params.plane_size * 1000)
    t_in, t_div, t_seed = (1000 * v for v in (params.inlier_distance, params.division_distance, params.seed_distance))
    seeds, found = [False] * len(points), []

    def cell(level, column, row, members):
        candidates = [points[i] for i in members if under[i]]
        if len(candidates) < max(3, params.min_inliers):
            return
        support, plane = ransac(candidates, seed_of(column, row, (64 * edge) >> level), t_in, close)
        if support:
            support, plane = refit(candidates, support, t_in, plane, close)
        if support < max(3, params.min_inliers):
            return
        if close.below(max([0.0, *(-signed(plane, p) for p in candidates)]), t_div):
            found.append((column, row, level, support))
            for i in members:
                seeds[i] |= close.below(abs(signed(plane, points[i])), t_seed)
        elif level < 6:
            split(level + 1, members)

    def split(level, members):
        parts = {}
        for i in members:
            x, y, _ = points[i]
            parts.setdefault(((x << level) // edge, (y << level) // edge), []).append(i)
        for (column, row), part in parts.items():
            cell(level, column, row, part)

    split(0, range(len(points)))
    return seeds, sorted(found)


def lowest(points, edge):
    best = {}
    for x, y, z in points:
        key = x // edge, y // edge
        best[key] = min(best.get(key, (z, x, y)), (z, x, y))
    return [best[x // edge, y // edge] == (z, x, y) for x, y, z in points]


def quadrant(dx, dy):
    tests = (dx > 0 and dy >= 0, dx <= 0 and dy > 0, dx < 0 and dy <= 0, dx >= 0 and dy < 0)
    return tests.index(True)


def neighbours(o, ground, reach, nearest):
    """Return the ground points that carry the plane at o."""
    ranked = []
    for p in ground:
        dx, dy = p[0] - o[0], p[1] - o[1]
        d = dx * dx + dy * dy
        if 0 < d <= reach * reach:
            ranked.append((d, p[2], p[0], p[1]))
    ranked.sort()
    if nearest:
        return ranked[:4]
    first = {}
    for item in ranked:
        first.setdefault(quadrant(item[2] - o[0], item[3] - o[1]), item)
    return [first[q] for q in sorted(first)]


def misfit(o, found):
    weights = [1.0 / math.sqrt(d) for d, *_ in found]
    level = abs(ordered(w * (z - o[2]) for w, (_, z, _, _) in zip(weights, found, strict=True)) / ordered(weights))
    n = len(found)
    if n < 3:
        return level
    diffs = [(x - o[0], y - o[1], z - o[2]) for _, z, x, y in found]
    mx, my, mz = (ordered(float(d[k]) for d in diffs) / n for k in range(3))
    d = [(a - mx, b - my, c - mz) for a, b, c in diffs]
    sxx, sxy, syy, sxz, syz = (ordered(v[i] * v[j] for v in d) for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2)))
    det = sxx * syy - sxy * sxy
    largest = 0.5 * (sxx + syy + math.sqrt((sxx - syy) * (sxx - syy) + 4.0 * sxy * sxy))
    if det < 1e-3 * largest * largest:
        return level
    a, b = (sxz * syy - syz * sxy) / det, (syz * sxx - sxz * sxy) / det
    if a * a + b * b > 32.163437477526264:
        return level
    return abs((a * mx + b * my - mz) / math.sqrt(1.0 + (a * a + b * b)))


def grow(points, ground, params, close):
    """Run synchronous passes over all points, each tested anew in each pass."""
    reach, limit = round(params.search_limit * 1000), params.classification_distance * 1000
    ground = list(ground)
    for _ in range(200):
        reference = sorted({p for p, g in zip(points, ground, strict=True) if g})
        added = []
        for i, o in enumerate(points):
            if not ground[i]:
                found = neighbours(o, reference, reach, params.neighbours == "nearest")
                if len(found) >= params.min_neighbours and close.below(misfit(o, found), limit):
                    added.append(i)
        if not added:
            break
        for i in added:
            ground[i] = True
    return ground


def classify(points, params, fixed=None):
    """Return (ground, seeds, under, planes, close) for absolute integer (x, y, z)."""
    points = [tuple(int(v) for v in p) for p in points]
    order = sorted(range(len(points)), key=lambda i: points[i])
    ranked = [points[i] for i in order]
    close = Close()
    under, found = [True] * len(points), []
    if params.seeds == "planes":
        under = canopy(ranked, round(params.canopy_cell * 1000), round(params.canopy_height * 1000))
        seeds, found = planes(ranked, under, params, close)
    else:
        seeds = lowest(ranked, round(params.plane_size * 1000))
    if fixed is not None:
        seeds = [s or bool(fixed[i]) for s, i in zip(seeds, order, strict=True)]
    for k, (p, q) in enumerate(pairwise(ranked)):
        if p == q:
            seeds[k + 1] |= seeds[k]
    for k in range(len(ranked) - 1, 0, -1):
        if ranked[k] == ranked[k - 1]:
            seeds[k - 1] |= seeds[k]
    grown = grow(ranked, seeds, params, close)
    out = [np.zeros(len(points), bool) for _ in range(3)]
    for k, i in enumerate(order):
        out[0][i], out[1][i], out[2][i] = grown[k], seeds[k], under[k]
    return *out, found, close
