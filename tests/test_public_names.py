"""The public names: each is there, and none is hidden by the module that holds it."""

from __future__ import annotations

import subprocess
import sys
from types import ModuleType

import ppdf_dask


def test_every_public_name_is_there_and_no_module():
    for name in ppdf_dask.__all__:
        assert not isinstance(getattr(ppdf_dask, name), ModuleType), name


def test_a_function_stays_one_after_its_module_was_imported():
    code = (
        "import ppdf_dask; from ppdf_dask.plan import Plan; from ppdf_dask.evaluate import evaluate as f; "
        "assert callable(ppdf_dask.plan) and callable(ppdf_dask.plan); assert ppdf_dask.evaluate is f; "
        "from ppdf_dask import plan; assert plan is ppdf_dask.plan"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
