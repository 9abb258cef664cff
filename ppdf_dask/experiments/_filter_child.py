"""Measure one filter's compilation and peak memory in a process of its own; run by `ppdf_dask.experiments.speed`.

Reads one JSON line: ``filter``, ``profile``, ``params``, ``origin`` and ``points``, the name of a file of int32
millimetres of shape (3, n), or null. Writes one JSON line: ``imports`` (seconds to load all modules, numba's too),
``first`` (seconds of the first call, on a small cloud, compilation included) and ``bytes`` (growth of the resident
size while the whole cloud is classified; null where there is no cloud or the system does not tell).
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from typing import Any

import numpy as np


def _status(name: str) -> int | None:
    """Return a size of this process, bytes: VmRSS, what it holds, or VmHWM, the most it held; Linux only.

    Not from getrusage: there a new process starts with the peak of its parent.
    """
    try:
        with open("/proc/self/status", encoding="ascii", errors="replace") as status:
            return next(int(line.split()[1]) * 1024 for line in status if line.startswith(name))
    except (OSError, StopIteration):
        return None


def main() -> None:
    """Answer one request."""
    from ppdf_dask import filters
    from ppdf_dask.filters.cloud import Cloud, cloud_from_grid, density

    asked: dict[str, Any] = json.loads(sys.stdin.readline())
    chosen = filters.get(asked["filter"])
    params = type(chosen.profiles[asked["profile"]]).from_dict(asked["params"])
    step = np.arange(0, 40_000, 900, dtype=np.int64)
    x, y = (v.ravel() for v in np.meshgrid(step, step))
    small = cloud_from_grid(x, y, (x + 2 * y) // 10 + x * y // 7 % 300)
    resolved, nothing = chosen.resolve(params, density(small)), np.empty(0, np.int64)
    start = time.perf_counter()
    # Without points nothing of the filter is compiled, but its modules come in; numba loads half of its own when it
    # first compiles anything.
    chosen.classify(cloud_from_grid(nothing, nothing, nothing), resolved)
    if "numba" in sys.modules:
        sys.modules["numba"].njit(lambda x: x)(1)
    imported = time.perf_counter()
    chosen.classify(small, resolved)
    answer: dict[str, Any] = {
        "imports": imported - start,
        "first": time.perf_counter() - imported,
        "bytes": None,
    }
    if asked["points"] is not None:
        x, y, z = np.load(asked["points"])
        cloud = Cloud(x, y, z, tuple(asked["origin"]), len(x))
        with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w", encoding="ascii") as reset:
            reset.write("5")
        before = _status("VmRSS")
        chosen.classify(cloud, params)
        peak = _status("VmHWM")
        answer["bytes"] = None if peak is None or before is None else max(0, peak - before)
    print(json.dumps(answer))


if __name__ == "__main__":
    main()
