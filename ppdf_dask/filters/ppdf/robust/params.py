"""Parameters of PPDF's robust profile."""

from __future__ import annotations

from dataclasses import dataclass

from ppdf_dask.filters.cloud import Density
from ppdf_dask.grid import MM
from ppdf_dask.params import Parameters, quantity


@dataclass(frozen=True, kw_only=True)
class RobustParams(Parameters):
    """The robust profile (the default)."""

    cell_size: float | None = quantity(None, "m", low=0.25, high=50.0)
    tolerance: float = quantity(0.4, "m", low=0.01, high=5.0)
    largest_building: float = quantity(250.0, "m", low=0.0, high=2000.0)
    refits: int = quantity(0, "refits", low=0, high=5)
    trials: int = quantity(30, "trials", low=1, high=1000)
    inlier_distance: float = quantity(0.3, "m", low=0.01, high=5.0)
    inlier_share: float = quantity(0.5, "1", low=0.0, high=1.0)
    division_distance: float = quantity(1.0, "m", low=0.01, high=100.0)
    search_radius: float = quantity(20.0, "m", low=1.0, high=200.0)
    passes: int = quantity(5, "passes", low=0, high=100)
    peel: float = quantity(1.0, "m")
    clean: bool = True

    @property
    def cell_mm(self) -> int:
        """Cell edge on the job grid, mm; `resolve` must have filled it."""
        assert self.cell_size is not None
        return round(self.cell_size * MM)

    def required_buffer(self) -> float:
        """Return the first guess of the buffer, metres: a plane square and two searches."""
        return 16 * (self.cell_size or 4.0) + 2 * self.search_radius

    def resolve(self, density: Density) -> RobustParams:
        """Fill in the cell size from the job-wide density: ``clip(ceil(4 * 1.5 / sqrt(density)) / 4, 1, 4)`` metres.

        Computed in integers, so that no rounding can move it: the smallest k (4 to 16) with k^2 >= 36 / density.
        """
        if self.cell_size is not None:
            return self
        quarters = 4
        while quarters < 16 and quarters * quarters * density.points < 36 * 25 * density.cells:
            quarters += 1
        return self.replace(cell_size=quarters / 4)
