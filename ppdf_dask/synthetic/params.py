"""What a synthetic survey looks like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ppdf_dask.params import Parameters, quantity

Water = Literal["none", "void", "returns"]


@dataclass(frozen=True, kw_only=True)
class SyntheticParams(Parameters):
    """Terrain, vegetation, buildings, noise and scanner of a synthetic survey.

    The survey has no edges: these values and a place decide what stands there, so any extent of it can be made alone.
    The defaults give a wooded valley with spurs, terraces, a scarp, a stream, clearings and some houses.

    Parameters
    ----------
    seed : int
        Another seed is another landscape.
    density : float
        Pulses per m2. A pulse gives one to five returns: in open land there are as many points, in forest up to
        twice as many.
    elevation : float
        Height of the valley bottoms, m.
    slope : float
        Slope of the valley sides, degrees; small forms come on top.
    relief_length : float
        Distance from a valley's axis to the next ridge, m.
    valley_floor, crest : float
        Half widths of the flat valley bottoms and hilltops, m.
    rounding : float
        Half width over which the edges between flats and slopes are rounded, m; small values make break lines.
    spurs : float
        Share of the relief that runs across the main ridges: 0 long ridges, 1 single hills.
    meander : float
        How far the valleys swing, as a share of `relief_length`.
    roughness : float
        Height of hummocks some tens of metres wide, m; finer forms are scaled with it.
    terrace_height : float
        Height of the steps where slopes are terraced (about a quarter of the land), m; 0 for none.
    scarp_height : float
        Height of the scarps with sharp edges that cross the land, m; 0 for none.
    water : {"none", "void", "returns"}
        No water; water without returns; water with some returns of class 9.
    stream_width, lake_width : float
        Width of the streams in the valleys, and how much wider they grow in places, m.
    canopy_cover : float
        Share of the land under trees, approximately (measured cover depends on the trees' height).
    canopy_height : float
        Mean height of grown trees, m.
    conifer_share : float
        Share of conifers; the others are broad-leaved.
    penetration : float
        Typical depth a pulse reaches into a crown before it meets a leaf, m.
    shrub_share, grass_share : float
        Share of 3 m cells with a shrub of 0.5 to 3 m, and share of pulses that end in grass 0.1 to 0.5 m high.
    boulder_share, house_share : float
        Share of 9 m cells with a boulder, and of 44 m cells with a house (where it is not too steep).
    height_noise : float
        Standard deviation of measured heights, m; the error is bounded by 2 sqrt(3) times it.
    low_noise, high_noise : float
        Share of pulses that return from 2 to 15 m below ground (class 7), or 40 to 150 m above (class 18).
    low_outliers : float
        As `low_noise`, but delivered as class 1: the filter has to find them.
    """

    seed: int = quantity(1, "1", low=0, high=2**31 - 1)
    density: float = quantity(4.5, "pulses/m2", low=0.05, high=200.0)
    elevation: float = quantity(400.0, "m", low=-1000.0, high=8000.0)
    slope: float = quantity(24.0, "degrees", low=0.0, high=60.0)
    relief_length: float = quantity(150.0, "m", low=20.0, high=5000.0)
    valley_floor: float = quantity(18.0, "m", low=0.0, high=1000.0)
    crest: float = quantity(10.0, "m", low=0.0, high=1000.0)
    rounding: float = quantity(8.0, "m", low=0.01, high=1000.0)
    spurs: float = quantity(0.6, "1", low=0.0, high=1.0)
    meander: float = quantity(0.8, "1", low=0.0, high=3.0)
    roughness: float = quantity(1.2, "m", low=0.0, high=20.0)
    terrace_height: float = quantity(2.0, "m", low=0.0, high=20.0)
    scarp_height: float = quantity(4.0, "m", low=0.0, high=50.0)
    water: Water = "returns"
    stream_width: float = quantity(4.0, "m", low=0.0, high=500.0)
    lake_width: float = quantity(0.0, "m", low=0.0, high=2000.0)
    canopy_cover: float = quantity(0.6, "1", low=0.0, high=1.0)
    canopy_height: float = quantity(18.0, "m", low=3.0, high=50.0)
    conifer_share: float = quantity(0.6, "1", low=0.0, high=1.0)
    penetration: float = quantity(1.8, "m", low=0.05, high=50.0)
    shrub_share: float = quantity(0.12, "1", low=0.0, high=1.0)
    grass_share: float = quantity(0.05, "1", low=0.0, high=1.0)
    boulder_share: float = quantity(0.03, "1", low=0.0, high=1.0)
    house_share: float = quantity(0.2, "1", low=0.0, high=1.0)
    height_noise: float = quantity(0.03, "m", low=0.0, high=1.0)
    low_noise: float = quantity(0.0002, "1", low=0.0, high=0.1)
    high_noise: float = quantity(0.0001, "1", low=0.0, high=0.1)
    low_outliers: float = quantity(0.0, "1", low=0.0, high=0.1)
