"""Loaded into the workers of the fault tests: each piece of work takes a while longer, so that it can be hit."""

import os
import time

from ppdf_dask import tasks


def _slow(name: str) -> None:
    true = getattr(tasks, name)

    def slow(*arguments, **named):
        time.sleep(float(os.environ["FAULTY_SLEEP"]))
        return true(*arguments, **named)

    setattr(tasks, name, slow)


if "FAULTY_SLEEP" in os.environ:  # not when the test collection merely imports this file
    for each in ("cut", "solve", "write_tile"):
        _slow(each)
