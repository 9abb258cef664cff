"""Ground classification of airborne LiDAR surveys of any size, exact across tile seams, on Dask.

The public names, loaded when they are first used::

    survey = ppdf_dask.scan("tiles/")
    plan = ppdf_dask.plan(survey, out="RUN")
    result = plan.run(client)  # any distributed.Client
    result.dtm  # lazy xarray.DataArray
    ppdf_dask.classify_ground(xyz)  # without Dask
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ppdf_dask.numbacache import ensure_cache

__version__ = "0.1.0"

ensure_cache()

_WHERE = {
    "scan": "survey",
    "Survey": "survey",
    "plan": "plan",
    "Plan": "plan",
    "Result": "result",
    "classify_ground": "filters",
    "classify_tile": "single",
    "evaluate": "evaluate",
    "Scores": "metrics",
    "RunParams": "params",
    "ClassRules": "params",
    "ChunkParams": "params",
    "DtmParams": "params",
    "RobustParams": "filters.ppdf.robust.params",
    "PaperParams": "filters.ppdf.paper.params",
    "PpdfError": "errors",
    "Submission": "submit",
    "LiveMap": "widget",
    "local_cluster": "cluster",
}

__all__ = [*_WHERE, "__version__"]

if TYPE_CHECKING:
    from ppdf_dask.cluster import local_cluster
    from ppdf_dask.errors import PpdfError
    from ppdf_dask.evaluate import evaluate
    from ppdf_dask.filters import classify_ground
    from ppdf_dask.filters.ppdf.paper.params import PaperParams
    from ppdf_dask.filters.ppdf.robust.params import RobustParams
    from ppdf_dask.metrics import Scores
    from ppdf_dask.params import ChunkParams, ClassRules, DtmParams, RunParams
    from ppdf_dask.plan import Plan, plan
    from ppdf_dask.result import Result
    from ppdf_dask.single import classify_tile
    from ppdf_dask.submit import Submission
    from ppdf_dask.survey import Survey, scan
    from ppdf_dask.widget import LiveMap


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_WHERE[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)


class _Package(ModuleType):
    """Keeps a submodule from hiding the function of its name: `plan` and `evaluate` are functions, whoever imports."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _WHERE and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
