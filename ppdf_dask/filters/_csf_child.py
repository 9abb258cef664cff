"""Run the cloth simulation in a process of its own; a script for `ppdf_dask.filters.csf`, not a module to import.

Reads from standard input the parameters as one line of JSON and the points as float64 (n, 3); writes one byte per point
to standard output. The library prints its progress there: what it writes goes nowhere.
"""

import json
import os
import sys


def main() -> None:
    """Answer one request."""
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

    import CSF
    import numpy as np

    settings = json.loads(sys.stdin.buffer.readline())
    xyz = np.frombuffer(sys.stdin.buffer.read(), np.float64).reshape(-1, 3)
    csf = CSF.CSF()
    for name, value in settings.items():
        setattr(csf.params, name, value)
    csf.setPointCloud(xyz)
    ground, other = CSF.VecInt(), CSF.VecInt()
    csf.do_filtering(ground, other, False)
    mask = np.zeros(len(xyz), np.uint8)
    mask[np.fromiter(ground, np.int64, len(ground))] = 1
    answer.write(mask.tobytes())
    answer.close()


if __name__ == "__main__":
    main()
