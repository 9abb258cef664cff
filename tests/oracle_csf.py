"""The cloth simulation filter in plain Python, as its authors' program works: slow, for a few hundred particles.

Zhang et al., Remote Sensing 8 (2016), 501, and the source of the package cloth-simulation-filter.
"""

from __future__ import annotations

import math
from collections import deque

SINGLE = {1: 0.3, 2: 0.51, 3: 0.657}
DOUBLE = {1: 0.3, 2: 0.42, 3: 0.468}
DAMPING, GRAVITY = 0.01, 0.2
SMOOTH, SMALLEST = 0.3, 50


class Cloth:
    """Particles in rows, their heights, what they may fall onto, and whether they still move."""

    def __init__(self, pts, resolution):
        self.step = resolution
        self.x0, self.y0 = (min(p[axis] for p in pts) - 2 * resolution for axis in (0, 1))
        self.wide, self.high = (
            math.floor((max(p[axis] for p in pts) - min(p[axis] for p in pts)) / resolution) + 4 for axis in (0, 1)
        )
        n = self.wide * self.high
        top = max(-p[2] for p in pts) + 0.05
        self.now, self.before, self.moves = [top] * n, [top] * n, [True] * n
        self.near = [[] for _ in range(n)]
        for reach in (1, 2):
            for i in range(self.wide):
                for j in range(self.high):
                    right, up = i + reach < self.wide, j + reach < self.high
                    pairs = [((i, j), (i + reach, j))] * right + [((i, j), (i, j + reach))] * up
                    if right and up:
                        pairs += [((i, j), (i + reach, j + reach)), ((i + reach, j), (i, j + reach))]
                    for a, b in pairs:
                        self.near[self.at(*a)].append(self.at(*b))
                        self.near[self.at(*b)].append(self.at(*a))
        self.floor = self.floors(pts)

    def at(self, i, j):
        return j * self.wide + i

    def floors(self, pts):
        """The inverted height of the point that is nearest to each particle, or of a particle in the same row."""
        known, nearest = {}, {}
        for x, y, z in pts:
            i, j = int((x - self.x0) / self.step + 0.5), int((y - self.y0) / self.step + 0.5)
            d2 = (x - self.x0 - i * self.step) ** 2 + (y - self.y0 - j * self.step) ** 2
            k = self.at(i, j)
            if d2 < nearest.get(k, math.inf):
                nearest[k], known[k] = d2, -z
        return [known[k] if k in known else self.borrowed(k, known) for k in range(self.wide * self.high)]

    def borrowed(self, k, known):
        i, j = k % self.wide, k // self.wide
        row = [self.at(c, j) for c in (*range(i + 1, self.wide), *range(i - 1, -1, -1))]
        column = [self.at(i, r) for r in (*range(j - 1, -1, -1), *range(j + 1, self.high))]
        for other in row + column:
            if other in known:
                return known[other]
        queue, seen = deque(self.near[k]), set(self.near[k])
        while queue[0] not in known:
            for other in self.near[queue.popleft()]:
                if other not in seen:
                    seen.add(other)
                    queue.append(other)
        return known[queue[0]]

    def fall(self, params):
        force = GRAVITY * params.time_step**2 * params.time_step**2
        single, double = SINGLE[params.rigidness], DOUBLE[params.rigidness]
        now, before, moves = self.now, self.before, self.moves
        for _ in range(params.iterations):
            for k in range(len(now)):
                if moves[k]:
                    last = now[k]
                    now[k] += (last - before[k]) * (1 - DAMPING) - force
                    before[k] = last
            for k in range(len(now)):
                for other in self.near[k]:
                    rise = now[other] - now[k]
                    if moves[k] and moves[other]:
                        now[k] += rise * double
                        now[other] -= rise * double
                    elif moves[k]:
                        now[k] += rise * single
                    elif moves[other]:
                        now[other] -= rise * single
            most = max((abs(before[k] - now[k]) for k in range(len(now)) if moves[k]), default=0.0)
            for k in range(len(now)):
                if now[k] < self.floor[k]:
                    now[k], moves[k] = self.floor[k], False
            if 0 < most < 0.005:
                break

    def beside(self, k):
        i, j = k % self.wide, k // self.wide
        places = ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1))
        return [self.at(a, b) for a, b in places if 0 <= a < self.wide and 0 <= b < self.high]

    def let_down(self):
        """Let the cloth down where it hangs over a slope that it rests beside."""
        seen = set()
        for start in range(len(self.now)):
            if start in seen or not self.moves[start]:
                continue
            part, queue = [], deque([start])
            seen.add(start)
            while queue:
                part.append(k := queue.popleft())
                fresh = [o for o in self.beside(k) if self.moves[o] and o not in seen]
                seen.update(fresh)
                queue.extend(fresh)
            if len(part) <= SMALLEST:
                continue
            rest = deque(k for k in part if self.drop(k))
            while rest:
                k = rest.popleft()
                for other in self.beside(k):
                    if self.moves[other] and abs(self.floor[other] - self.floor[k]) < SMOOTH:
                        self.now[other], self.moves[other] = self.floor[other], False
                        rest.append(other)

    def drop(self, k):
        beside = self.beside(k)
        if any(not self.moves[o] and abs(self.floor[k] - self.floor[o]) < SMOOTH for o in beside):
            self.now[k], self.moves[k] = self.floor[k], False
            return True
        return False

    def height(self, x, y):
        u, v = (x - self.x0) / self.step, (y - self.y0) / self.step
        i, j = int(u), int(v)
        u, v = u - i, v - j
        return (
            self.now[self.at(i, j)] * (1 - u) * (1 - v)
            + self.now[self.at(i, j + 1)] * (1 - u) * v
            + self.now[self.at(i + 1, j + 1)] * u * v
            + self.now[self.at(i + 1, j)] * u * (1 - v)
        )


def margins(pts, params):
    """How far each point (metres) lies within the threshold of the cloth; negative: outside."""
    cloth = Cloth(pts, params.resolution)
    cloth.fall(params)
    if params.slope_smooth:
        cloth.let_down()
    return [params.threshold - abs(cloth.height(x, y) + z) for x, y, z in pts]
