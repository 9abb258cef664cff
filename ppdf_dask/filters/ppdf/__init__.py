"""PPDF: progressive plane detection filtering, after Cai, Liang and Yu (Forests 2023, 14(3), 498).

Two profiles: `robust` (the default) works on real clouds, `paper` is the published method. Importing this package
compiles nothing: the kernels are loaded with the first call.
"""

from __future__ import annotations

from ppdf_dask.errors import ParameterError
from ppdf_dask.filters import Filter
from ppdf_dask.filters.cloud import Cloud, Density, Verdict
from ppdf_dask.filters.ppdf.paper.params import PaperParams
from ppdf_dask.filters.ppdf.robust.params import RobustParams
from ppdf_dask.grid import MM
from ppdf_dask.params import Parameters


def _classify(cloud: Cloud, params: Parameters) -> Verdict:
    if isinstance(params, RobustParams):
        from ppdf_dask.filters.ppdf.robust.classify import classify

        return classify(cloud, params)
    if isinstance(params, PaperParams):
        from ppdf_dask.filters.ppdf.paper.classify import classify as classify_as_published

        return classify_as_published(cloud, params)
    raise ParameterError(f"PPDF has no profile of type {type(params).__name__}")


def _required_buffer(params: Parameters) -> float:
    if isinstance(params, RobustParams | PaperParams):
        return params.required_buffer()
    raise ParameterError(f"PPDF has no profile of type {type(params).__name__}")


def _resolve(params: Parameters, density: Density) -> Parameters:
    return params.resolve(density) if isinstance(params, RobustParams) else params


def _bytes_per_point(params: Parameters, density: Density) -> float:
    """Return what was measured: the robust profile has 30 bytes for a point and 50 for a cell, 180 with halved ones."""
    if not isinstance(params, RobustParams):
        return 90.0
    resolved = params.resolve(density)
    points_in_cell = max(density.per_m2, 0.04) * (resolved.cell_mm / MM) ** 2
    return 30.0 + (180.0 if resolved.refinement == 2 else 50.0) / points_in_cell


FILTER = Filter(
    name="ppdf",
    profiles={"robust": RobustParams(), "paper": PaperParams()},
    classify=_classify,
    required_buffer=_required_buffer,
    exact=True,
    resolve=_resolve,
    bytes_per_point=_bytes_per_point,
)
