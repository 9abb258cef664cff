import subprocess
import sys

import pytest

PINNED = """
import sys
from ppdf_dask.heap import give_back

def resident():
    with open("/proc/self/status") as lines:
        return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) // 1000

pieces = [bytearray(50_000) for _ in range(2000)]
last = pieces.pop()
full = resident()
del pieces
freed = resident()
give_back()
print(full - freed, freed - resident())
"""
"""100 MB below one object that stays, in an arena that does not shrink by itself."""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only glibc keeps what lies below")
def test_what_lies_below_an_object_that_stays_is_given_back():
    environment = {"MALLOC_ARENA_MAX": "1", "MALLOC_MMAP_THRESHOLD_": "8388608"}
    done = subprocess.run([sys.executable, "-c", PINNED], env=environment, capture_output=True, text=True, check=True)
    by_itself, by_us = map(int, done.stdout.split())
    assert by_itself < 5
    # 100 MB but for what shares a page with something that stays.
    assert by_us > 95
