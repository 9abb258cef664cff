"""Parameters of PPDF's robust profile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ppdf_dask.errors import ParameterError
from ppdf_dask.filters.cloud import Density
from ppdf_dask.grid import MM
from ppdf_dask.params import Parameters, quantity

STEPS = ("outliers", "planes", "roofs", "growth", "cleaning", "refinement")
"""The steps in their order; lows and labelling are not optional."""


@dataclass(frozen=True, kw_only=True)
class RobustParams(Parameters):
    """The robust profile (the default): one set of values for all clouds, the cell follows the density.

    Users need `tolerance` and `largest_building` at most; the others are the thresholds of the method, there for
    sensitivity studies. Distances are vertical unless said otherwise. A rule of the form "height below b + (k + q s) d"
    has d the distance of the nearest reference, s the slope of the reference plane.

    Parameters
    ----------
    cell_size : float or None
        Edge of the cells whose lowest point may become a reference, m, rounded to 2 mm; None: from the density, 2 m
        at 3 points/m2 and above, 2.5 m at 1, 3 m at 0.3.
    refinement : int or None
        2: a second growth over cells of half the size; 1: none; None: 2 below 2.25 points/m2, where a cell holds too
        few points to follow break lines.
    tolerance : float
        A point is ground up to this height above the references on perfectly smooth ground, m; the local roughness is
        added.
    roughness : float
        How many times the local roughness is added to `tolerance` (at most 1 m of roughness counts, and the sum is at
        most four times `tolerance`).
    largest_building : float
        A raised patch of this extent or more is terrain, m; the side of the largest hall in the survey.
    search_radius : float
        References are sought up to this distance, m; half of it over the finer cells.
    trials : int
        RANSAC trials per square.
    inlier_distance : float
        Perpendicular distance of inliers and seeds from their plane, m.
    inlier_share : float
        A plane needs this share of its square's low points (and at least 4).
    smallest_patch : int
        Patches of fewer seeds are not believed.
    border_drop, border_reach, border_share : float
        A patch is a roof or a crown when along this share of its border a low point within `border_reach` m lies more
        than `border_drop` m (and half the plane's rise over the distance) below its plane.
    border_gentle : float
        What a border counts that falls like an embankment's flank (`patches.HEAPED`, `patches.WALL`), instead of at
        once like a wall.
    passes : int
        Passes of growth. What then stands 4 m above its references (`growth.TOO_HIGH`) is not tried again.
    growth_base, growth_spread, growth_slope : float
        b, k, q of growth over the cells.
    growth_step : float
        A point no more than this (and `growth_spread` d) above its nearest reference is accepted, m.
    fine_passes : int
        Passes of the second growth, over the finer cells.
    fine_base, fine_spread, fine_slope, fine_step : float
        The same for the finer cells.
    fine_roughness : float
        How many times the local roughness is added to `fine_base`.
    label_spread, label_slope : float
        k, q of the final labels. At cliffs (`cliffs.HEIGHT`, `cliffs.STEEP`) all is ground that lies no higher than the
        references around it.
    steps : tuple of str
        The steps to take, a subset of ``STEPS``; for ablations.

    Examples
    --------
    >>> from ppdf_dask.filters.cloud import Density
    >>> RobustParams().resolve(Density(points=1000, cells=200)).cell_size
    3.25
    """

    RETURNS: ClassVar = "last"

    cell_size: float | None = quantity(None, "m", low=0.25, high=50.0)
    refinement: int | None = quantity(None, "1", low=1, high=2)
    tolerance: float = quantity(0.2, "m", low=0.01, high=5.0)
    roughness: float = quantity(0.65, "1", low=0.0, high=10.0)
    largest_building: float = quantity(250.0, "m", low=0.0, high=2000.0)
    search_radius: float = quantity(25.0, "m", low=1.0, high=200.0)
    trials: int = quantity(30, "trials", low=1, high=10_000)
    inlier_distance: float = quantity(0.3, "m", low=0.01, high=5.0)
    inlier_share: float = quantity(0.5, "1", low=0.0, high=1.0)
    smallest_patch: int = quantity(8, "seeds", low=0, high=1000)
    border_drop: float = quantity(1.5, "m", low=0.0, high=100.0)
    border_reach: float = quantity(10.0, "m", low=0.0, high=100.0)
    border_share: float = quantity(0.45, "1", low=0.0, high=1.0)
    border_gentle: float = quantity(0.3, "1", low=0.0, high=1.0)
    passes: int = quantity(8, "passes", low=0, high=100)
    growth_base: float = quantity(0.3, "m", low=0.0, high=10.0)
    growth_spread: float = quantity(0.1, "1", low=0.0, high=10.0)
    growth_slope: float = quantity(0.4, "1", low=0.0, high=10.0)
    growth_step: float = quantity(0.3, "m", low=0.0, high=10.0)
    fine_passes: int = quantity(3, "passes", low=0, high=100)
    fine_base: float = quantity(0.1, "m", low=0.0, high=10.0)
    fine_spread: float = quantity(0.12, "1", low=0.0, high=10.0)
    fine_slope: float = quantity(0.35, "1", low=0.0, high=10.0)
    fine_step: float = quantity(0.15, "m", low=0.0, high=10.0)
    fine_roughness: float = quantity(1.3, "1", low=0.0, high=10.0)
    label_spread: float = quantity(0.1, "1", low=0.0, high=10.0)
    label_slope: float = quantity(0.45, "1", low=0.0, high=10.0)
    steps: tuple[str, ...] = STEPS

    def __post_init__(self) -> None:
        super().__post_init__()
        unknown = [s for s in self.steps if s not in STEPS]
        if unknown:
            raise ParameterError(f"steps has {', '.join(unknown)}; choose from {', '.join(STEPS)}")

    @property
    def cell_mm(self) -> int:
        """Cell edge on the job grid, mm, even so that it can be halved."""
        if self.cell_size is None:
            raise ParameterError("cell_size is not set; call params.resolve(density) first or give cell_size in metres")
        return 2 * round(self.cell_size * MM / 2)

    def required_buffer(self) -> float:
        """Return the first guess of the buffer, metres: a plane square and two searches."""
        return 16 * (self.cell_size or 4.0) + 2 * self.search_radius

    def resolve(self, density: Density) -> RobustParams:
        """Fill in what follows from the job-wide density.

        The cell is ``clip(ceil(4 * 2.4 / density ** (1 / 6)) / 4, 2, 4)`` metres, computed in integers so that no
        rounding can move it: the smallest k (8 to 16) with k^6 >= 9.6^6 / density.
        """
        size, refinement = self.cell_size, self.refinement
        if size is None:
            quarters = 8
            while quarters < 16 and (5 * quarters) ** 6 * density.points < 48**6 * 25 * density.cells:
                quarters += 1
            size = quarters / 4
        if refinement is None:
            refinement = 2 if 4 * density.points < 9 * 25 * density.cells else 1
        return self.replace(cell_size=size, refinement=refinement)
