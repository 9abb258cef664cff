"""Time one profile of PPDF with or without its proof bit; run by `ppdf_dask.experiments.proof`.

Reads one JSON line: ``params`` and ``profile``, ``points`` (a file of int32 millimetres, (3, n)), ``origin``, and
``bit``. Without the bit, the constants that stand for it are 0 before anything is compiled, so that the compiler leaves
out all that hangs on them. Then each further line is answered by one of the processor seconds of a run; the first two
answers are those of compiling and the checksum of the mask.
"""

from __future__ import annotations

import json
import sys
import time
import zlib
from typing import Any

import numpy as np

BITS = ("UNPROVEN", "MAYBE_DROPPED")


def main() -> None:
    """Answer one request after the other."""
    from ppdf_dask import filters
    from ppdf_dask.filters.cloud import Cloud, density

    asked: dict[str, Any] = json.loads(sys.stdin.readline())
    chosen = filters.get("ppdf")
    params = type(chosen.profiles[asked["profile"]]).from_dict(asked["params"])
    if not asked["bit"]:
        for name, module in list(sys.modules.items()):
            if name.startswith("ppdf_dask.filters.ppdf"):
                for bit in BITS:
                    if hasattr(module, bit):
                        setattr(module, bit, type(getattr(module, bit))(0))
    x, y, z = np.load(asked["points"])
    cloud = Cloud(x, y, z, tuple(asked["origin"]), len(x))
    resolved = chosen.resolve(params, density(cloud))
    ground = chosen.classify(cloud, resolved).ground
    print(zlib.crc32(ground.tobytes()), flush=True)
    for _ in sys.stdin:
        begin = time.process_time()
        chosen.classify(cloud, resolved)
        print(time.process_time() - begin, flush=True)


if __name__ == "__main__":
    main()
