"""Parameters of PPDF's robust profile."""

from __future__ import annotations

from dataclasses import dataclass

from ppdf_dask.params import Parameters, quantity


@dataclass(frozen=True, kw_only=True)
class RobustParams(Parameters):
    """The robust profile (the default)."""

    cell_size: float | None = quantity(None, "m", low=0.25, high=50.0)
