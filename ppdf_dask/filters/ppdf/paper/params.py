"""Parameters of PPDF as published."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from ppdf_dask.params import Parameters, Returns, quantity


@dataclass(frozen=True, kw_only=True)
class PaperParams(Parameters):
    """PPDF as published: Cai, Liang, Yu, *Forests* 2023, 14(3), 498, doi 10.3390/f14030498.

    The defaults are the paper's numbers; where its text is silent the default is this project's reading. Lengths are
    rounded to the job grid (1 mm). The 0.5 by which squares are halved and the four subspaces are fixed, as in the
    paper.

    Parameters
    ----------
    canopy_cell : float
        Edge of the cells whose lowest point is taken to lie under the canopy (section 2.3), m.
    canopy_height : float
        A point is under the canopy when it lies less than this above the lowest point of its cell (Eq. 1), m.
    plane_size : float
        Edge of the largest squares in which a plane is sought (section 2.4), m; with ``seeds="local_minimum"`` the edge
        of the windows.
    min_inliers : int
        A plane needs at least this many inliers, and a square at least this many points under the canopy (section 2.4;
        the printed "less than" is read as a misprint). At the default a square of 10 m with fewer than about one point
        under the canopy per 5 m2 can have no plane: for sparse clouds widen `plane_size`.
    division_distance : float
        A plane is kept when no point under the canopy lies this far below it or farther, perpendicularly; otherwise its
        square is cut in four (Eq. 2), m.
    inlier_distance : float
        RANSAC's inlier distance, perpendicular, m. Not given in the paper; equal to `seed_distance` because the paper
        calls the seeds both "interior points of the planes" and "points within buffers of detected planes".
    seed_distance : float
        Every point of a plane's square nearer to the plane than this is a ground seed ("buffer difference", section
        2.5), m.
    classification_distance : float
        A point nearer than this to the plane through its neighbouring ground points, above or below, is ground (section
        2.5), m. Accepted points become neighbours in the next pass, so that the method can climb by this much per pass.
    search_limit : float
        A neighbour is sought up to this horizontal distance, m. Not given in the paper; an unlimited search could never
        be proven across chunks.
    min_neighbours : int
        A point with fewer neighbours stays non-ground. Not given in the paper; 1 gave the smallest mean error on rural
        samples (edge strips), where one and two neighbours give a mean height and three or four a plane.
    seeds : {"planes", "local_minimum"}
        Where the first ground points come from: the published planes, or the lowest point of each `plane_size` window
        (the paper's ablation, Figure 16: "only the second contribution").
    neighbours : {"quadrants", "nearest"}
        Which ground points carry the reference plane: the nearest one of each quadrant, or the four nearest wherever
        they lie (Figure 16: "only the first contribution"; the paper gives no number).

    Examples
    --------
    >>> PaperParams().classification_distance
    1.5
    >>> PaperParams(neighbours="nearest").RETURNS
    'all'
    """

    RETURNS: ClassVar[Returns] = "all"

    canopy_cell: float = quantity(2.0, "m", low=0.1, high=100.0, doc="edge of the under-canopy cells")
    canopy_height: float = quantity(5.0, "m", low=0.01, high=1000.0, doc="height limit of points under the canopy")
    plane_size: float = quantity(10.0, "m", low=0.5, high=1000.0, doc="edge of the largest squares")
    min_inliers: int = quantity(20, "points", low=3, high=1_000_000, doc="fewest inliers of a plane")
    division_distance: float = quantity(1.0, "m", low=0.001, high=1000.0, doc="deepest point below a kept plane")
    inlier_distance: float = quantity(0.5, "m", low=0.001, high=100.0, doc="RANSAC inlier distance")
    seed_distance: float = quantity(0.5, "m", low=0.001, high=100.0, doc="distance of ground seeds from their plane")
    classification_distance: float = quantity(1.5, "m", low=0.001, high=100.0, doc="distance from the local plane")
    search_limit: float = quantity(50.0, "m", low=0.1, high=500.0, doc="farthest neighbouring ground point")
    min_neighbours: int = quantity(1, "points", low=1, high=4, doc="fewest neighbouring ground points")
    seeds: Literal["planes", "local_minimum"] = "planes"
    neighbours: Literal["quadrants", "nearest"] = "quadrants"

    def required_buffer(self) -> float:
        """Return the first guess of the buffer in metres: a plane square and 40 m of growth.

        At 15 points/m2 and more it proves nearly every point; where it does not, the task widens it.
        """
        return self.plane_size + min(40.0, self.search_limit)
