"""Loaded into the workers of the fault tests: work takes a while, so that it can be hit, or ends its worker.

``FAULTY_SLEEP``: seconds that each piece of work takes longer. ``FAULTY_KILL``: ids, as ``c_0025_0024``, whose work
kills its worker as the kernel does for want of memory. ``FAULTY_SPILL``: points held in memory while a tile is cut.
"""

import os
import signal
import time

from ppdf_dask import raster, tasks, tiler


def _ident(job: object) -> str:
    chunk = getattr(job, "chunk", None)
    return getattr(job, "source", "") if chunk is None else chunk.id


def _slow(room: object, name: str) -> None:
    true = getattr(room, name)

    def slow(*arguments, **named):
        time.sleep(float(os.environ.get("FAULTY_SLEEP", "0")))
        if _ident(arguments[1]) in os.environ.get("FAULTY_KILL", "").split():
            os.kill(os.getpid(), signal.SIGKILL)
        return true(*arguments, **named)

    setattr(room, name, slow)


if "FAULTY_SLEEP" in os.environ:  # not when the test collection merely imports this file
    for each in ("cut", "solve", "write_tile", "export_cog"):
        _slow(tasks, each)
    _slow(raster, "rasterize")
    tiler.SPILL_POINTS = int(os.environ.get("FAULTY_SPILL", tiler.SPILL_POINTS))
