"""PPDF's robust profile in plain Python: dictionaries of cells and no search structure. Everything is known here.

Same order of floating-point operations as the kernels, so that the labels are equal, not merely close.
"""

from itertools import product
from math import ceil, inf, sqrt

import numpy as np

from ppdf_dask.filters.ppdf.hashing import below, cell_seed


def classify(points, params):
    """Labels of a list of (x, y, z) integer millimetres."""
    c = params.cell_mm
    steps = params.steps
    low, removed = lows(points, c, "outliers" in steps)
    radius = round(params.search_radius * 1000)
    refs, soft, roofs, high = set(), set(), set(), set()
    if "planes" in steps:
        refs, soft, roofs = seeds(low, c, params)
    if "growth" in steps:
        rule = (params.growth_base, params.growth_spread, params.growth_slope, params.growth_step, 1.5)
        for _ in range(params.passes):
            new, high = grow(low, refs, soft, roofs, c, radius, rule, lambda cell: 0.0)
            refs = refs | new
    refs, residual = clean(low, refs, c, radius, "cleaning" in steps)
    rough = {cell: roughness(cell, residual) for cell in {(x // c, y // c) for x, y, _ in points}}
    coarse_low, size = low, c
    if params.refinement == 2 and "refinement" in steps:
        size, radius = c // 2, radius // 2
        fine = {}
        for p in points:
            if (p[0] // c, p[1] // c) in low and p not in removed:
                keep_lowest(fine, (p[0] // size, p[1] // size), p)
        coarse = lambda cell: (cell[0] // 2, cell[1] // 2)  # noqa: E731
        is_low = {cell: low[coarse(cell)] == p for cell, p in fine.items()}
        refs = {cell for cell in fine if is_low[cell] and coarse(cell) in refs}
        soft = {cell for cell in fine if coarse(cell) in soft}
        roofs = {cell for cell in fine if coarse(cell) in roofs}
        high = {cell for cell in fine if coarse(cell) in high}
        low = fine
        rule = (params.fine_base, params.fine_spread, params.fine_slope, params.fine_step, 2.0)
        for _ in range(params.fine_passes):
            slack = lambda cell: params.fine_roughness * (rough[coarse(cell)] * 1e-3)  # noqa: E731
            new, more = grow(low, refs, soft, roofs | high, size, radius, rule, slack)
            refs, high = refs | new, high | more
    blocks = {}
    for i, j in refs:
        blocks.setdefault((i // 4, j // 4), []).append(low[i, j][2])
    return [
        (p[0] // c, p[1] // c) in coarse_low
        and p not in removed
        and label(
            p,
            points_low=low,
            refs=refs,
            high=high - refs,
            blocks=blocks,
            c=size,
            radius=radius,
            params=params,
            rough=rough[p[0] // c, p[1] // c],
        )
        for p in points
    ]


def keep_lowest(cells, cell, p):
    if cell not in cells or (p[2], p[0], p[1]) < (cells[cell][2], cells[cell][0], cells[cell][1]):
        cells[cell] = p


def lows(points, c, outliers):
    low, removed = {}, set()
    for p in points:
        keep_lowest(low, (p[0] // c, p[1] // c), p)
    for _ in range(2 if outliers else 0):
        floor = {}
        for (i, j), p in low.items():
            near = sorted(low[n][2] for n in around(i, j, 2) if n in low and n != (i, j))
            if len(near) >= 6 and near[2] >= p[2] + 1000:
                floor[i, j] = min(near[2] - 1000, p[2] + 1000)
        for cell in floor:
            del low[cell]
        for p in points:
            cell = p[0] // c, p[1] // c
            if cell in floor:
                if p[2] <= floor[cell]:
                    removed.add(p)
                else:
                    keep_lowest(low, cell, p)
    return low, removed


def around(i, j, reach):
    return product(range(i - reach, i + reach + 1), range(j - reach, j + reach + 1))


def seeds(low, c, params):
    patch, planes = {}, []
    for i, j in sorted({(i // 16 * 16, j // 16 * 16) for i, j in low}, key=lambda s: (s[1], s[0])):
        split_square(low, c, (i, j), (i, j), 16, patch, planes, params)
    if "roofs" not in params.steps:
        return set(patch), set(), set()
    members = {}
    root = link(low, c, patch, planes)
    for cell, p in patch.items():
        members.setdefault(root(p), []).append(cell)
    refs, soft, roofs = set(), set(), set()
    for name, cells in members.items():
        side = max(max(s) - min(s) + 1 for s in zip(*cells, strict=True)) * c
        if len(cells) < params.smallest_patch:
            soft |= set(cells)
        elif side < round(params.largest_building * 1000) and raised(low, c, name, cells, patch, root, planes, params):
            roofs |= set(cells)
        else:
            refs |= set(cells)
    beside = {
        cell
        for cell, p in low.items()
        if cell not in refs
        and cell not in roofs
        and any(n in roofs and abs(height(planes[patch[n]], p, c)) < 1.0 for n in around(*cell, 1))
    }
    return refs, soft, roofs | beside


def split_square(low, c, parent, corner, size, patch, planes, params):
    inside = [(i, j) for j in range(corner[1], corner[1] + size) for i in range(corner[0], corner[0] + size)]
    cells = [cell for cell in inside if cell in low]
    if len(cells) < 4:
        return
    base = low[cells[0]][2]
    pts = [
        ((x - corner[0] * c) * 1e-3, (y - corner[1] * c) * 1e-3, (z - base) * 1e-3) for x, y, z in map(low.get, cells)
    ]
    seed = np.uint64(cell_seed(corner[0] - parent[0], corner[1] - parent[1], size))
    best = ransac(pts, seed, params)
    divide = True
    if best:
        a, b, h = best
        norm = sqrt(1.0 + a * a + b * b)
        off = [(z - (h + a * x + b * y)) / norm for x, y, z in pts]
        inliers = sum(abs(r) <= params.inlier_distance for r in off)
        if inliers >= 4 and inliers >= params.inlier_share * len(pts):
            divide = inliers < 0.9 * len(pts)
            taken = [
                cell
                for cell, r in zip(cells, off, strict=True)
                if cell not in patch and abs(r) <= params.inlier_distance
            ]
            if taken:
                patch.update(dict.fromkeys(taken, len(planes)))
                planes.append((a, b, h, corner, base))
    if divide and size > 2:
        half = size // 2
        for q in (3, 2, 1, 0):
            split_square(
                low, c, parent, (corner[0] + (q & 1) * half, corner[1] + (q >> 1) * half), half, patch, planes, params
            )


def ransac(pts, seed, params):
    best, most = None, -inf
    for t in range(params.trials):
        chosen = [below(seed, 3 * t + k, len(pts)) for k in range(3)]
        if len(set(chosen)) < 3:
            continue
        p, q, r = (pts[k] for k in chosen)
        ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        cross = ux * vy - uy * vx
        if abs(cross) < 1e-3:
            continue
        a = (uz * vy - vz * uy) / cross
        b = (ux * vz - vx * uz) / cross
        if a * a + b * b > 1.0:
            continue
        h = p[2] - a * p[0] - b * p[1]
        limit = params.inlier_distance * sqrt(1.0 + (a * a + b * b))
        off = [z - (h + a * x + b * y) for x, y, z in pts]
        score = sum(-limit <= e <= limit for e in off) - sum(e < -limit for e in off)
        if score > most:
            best, most = (a, b, h), score
    return best


def height(plane, p, c):
    a, b, h, corner, base = plane
    x, y = (p[0] - corner[0] * c) * 1e-3, (p[1] - corner[1] * c) * 1e-3
    return (p[2] - base) * 1e-3 - (h + a * x + b * y)


def link(low, c, patch, planes):
    votes = {}
    for (i, j), p in patch.items():
        for n in around(i, j, 3):
            q = patch.get(n, -1)
            if q > p:
                agree = abs(height(planes[p], low[n], c)) < 1.0 and abs(height(planes[q], low[i, j], c)) < 1.0
                votes.setdefault((p, q), []).append(agree)
    parent = list(range(len(planes)))

    def root(p):
        while parent[p] != p:
            p = parent[p]
        return p

    for (p, q), v in votes.items():
        if 2 * sum(v) >= len(v):
            parent[root(p)] = root(q)
    return root


def raised(low, c, name, cells, patch, root, planes, params):
    borders = drops = 0.0
    for (i, j), (dx, dy) in product(cells, ((1, 0), (-1, 0), (0, 1), (0, -1))):
        plane = planes[patch[i, j]]
        tilt = sqrt(plane[0] ** 2 + plane[1] ** 2)
        falls = steps = False
        last, level, steepest = low[i, j], 0.0, 0.0
        for far in range(1, 13):
            n = i + far * dx, j + far * dy
            if n in patch and root(patch[n]) == name:
                break
            if n in low and far * c <= round(params.border_reach * 1000) and not falls:
                above = height(plane, low[n], c)
                falls = above < -(params.border_drop + 0.5 * tilt * far * (c * 1e-3))
                steps |= not falls and above < -0.5
                along, across = (low[n][0] - last[0]) * 1e-3, (low[n][1] - last[1]) * 1e-3
                steepest = max(steepest, (level - above) / sqrt(along * along + across * across))
                last, level = low[n], above
        else:
            slowly = steepest < 0.7 or (steps and steepest < 2.0)
            borders += 1
            drops += falls * (params.border_gentle if slowly else 1.0)
    return drops > params.border_share * borders


def quadrants(p, low, refs, c, radius, own=None):
    """Squared distance, z, x, y of the nearest reference in each quadrant."""
    found = {}
    reach = ceil(radius / c) + 1
    for n in around(p[0] // c, p[1] // c, reach):
        if n in refs and n != own:
            x, y, z = low[n]
            dx, dy = x - p[0], y - p[1]
            if 0 < dx * dx + dy * dy <= radius * radius:
                if dx > 0 and dy >= 0:
                    quadrant = 3
                elif dx <= 0 and dy > 0:
                    quadrant = 2
                elif dx < 0 and dy <= 0:
                    quadrant = 0
                else:
                    quadrant = 1
                key = dx * dx + dy * dy, z, x, y
                found[quadrant] = min(found.get(quadrant, key), key)
    return found


def surface(p, found, c):
    """Number of references, height above their surface, slope, distance and height above the nearest."""
    if not found:
        return 0, 0.0, 0.0, 0.0, 0.0
    d2, z, _, _ = min(found.values())
    d, step = sqrt(d2 * 1e-6), (p[2] - z) * 1e-3
    few = len(found) < 3
    soft = 0.1 * (c * 1e-3) ** 2
    near = []
    for q in sorted(found):
        _, z, x, y = found[q]
        dx, dy, dz = (x - p[0]) * 1e-3, (y - p[1]) * 1e-3, (z - p[2]) * 1e-3
        near.append((dx, dy, dz, dx * dx + dy * dy + (1e-4 if few else soft)))
    total = xm = ym = zm = 0.0
    for dx, dy, dz, e in near:
        w = 1.0 / e
        total += w
        xm += w * dx
        ym += w * dy
        zm += w * dz
    xm, ym, zm = xm / total, ym / total, zm / total
    if few:
        return len(near), -zm, 0.0, d, step
    scale = len(near) / total
    sxx = syy = soft
    sxy = sxz = syz = 0.0
    for dx, dy, dz, e in near:
        w = scale / e
        u, v, h = dx - xm, dy - ym, dz - zm
        sxx += w * u * u
        sxy += w * u * v
        syy += w * v * v
        sxz += w * u * h
        syz += w * v * h
    det = sxx * syy - sxy * sxy
    a, b = (sxz * syy - syz * sxy) / det, (syz * sxx - sxz * sxy) / det
    slope = sqrt(a * a + b * b)
    if slope > 3.0:
        a, b, slope = a * (3.0 / slope), b * (3.0 / slope), 3.0
    return len(near), a * xm + b * ym - zm, slope, d, step


def grow(low, refs, soft, passed_over, c, radius, rule, slack):
    """New references, and the cells whose low point is far above the others."""
    base, spread, factor, near, highest = rule
    new, high = set(), set()
    for cell in low.keys() - refs - passed_over:
        n, r, slope, d, step = surface(low[cell], quadrants(low[cell], low, refs, c, radius, cell), c)
        rise = base + (spread + factor * slope) * d
        by_plane = -(8.0 + 0.15 * d) < r < min(highest, rise + slack(cell))
        by_step = r > 0.0 and step < near + spread * d and cell not in soft
        if n and (by_plane or by_step):
            new.add(cell)
        elif n >= 3 and r > 4.0 + slope * (c * 1e-3):
            high.add(cell)
    return new, high


def clean(low, refs, c, radius, drop):
    kept, residual = set(), {}
    for cell in refs:
        n, r, slope, d, _ = surface(low[cell], quadrants(low[cell], low, refs, c, radius, cell), c)
        if n >= 3 and drop and r > 0.3 + (0.2 + 1.2 * slope) * d:
            continue
        kept.add(cell)
        if n >= 3:
            residual[cell] = round(min(max(r, -1.0e3), 1.0e3) * 1000.0)
    return kept, residual


def roughness(cell, residual):
    below_it = [min(-residual[n], 1000) for n in around(*cell, 5) if residual.get(n, 0) < 0]
    return sum(below_it) // len(below_it) if below_it else 0


def label(p, points_low, refs, high, blocks, c, radius, params, rough):
    i, j = cell = p[0] // c, p[1] // c
    if points_low[cell] == p and cell in refs:
        return True
    only_cliff = points_low[cell] == p or p[2] - points_low[cell][2] >= 5000 or cell in high
    near = [z for n in around(i // 4, j // 4, 1) for z in blocks.get(n, [])]
    if only_cliff and not (near and max(near) - min(near) > 5000 and p[2] <= max(near)):
        return False
    found = quadrants(p, points_low, refs, c, radius)
    n, r, slope, d, _ = surface(p, found, c)
    if n == 0:
        return False
    levels = [z for _, z, _, _ in found.values()]
    deepest = 3.0 + slope * d
    if slope > 1.0 and max(levels) - min(levels) > 5000 and min(levels) - 1.0e3 * deepest < p[2] <= max(levels):
        return True
    if r <= -deepest:
        return False
    tolerance = min(4.0 * params.tolerance, params.tolerance + params.roughness * rough * 1e-3)
    return not only_cliff and r < tolerance + (params.label_spread + params.label_slope * slope) * d
