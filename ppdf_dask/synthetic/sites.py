"""Six synthetic study sites in the place of the PPDF paper's six, which are not public."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ppdf_dask.synthetic.params import SyntheticParams

SITE_SIZE = 300.0
"""Edge of a site, m, as in the paper."""


@dataclass(frozen=True)
class Site:
    """A study site.

    Parameters
    ----------
    name : str
        Number and kind of terrain.
    points_per_m2 : float
        Density of all returns the site is made for (the paper's Table 1).
    extent : tuple of float
        ``(x0, y0, x1, y1)`` in metres.
    params : SyntheticParams
        The landscape.
    """

    name: str
    points_per_m2: float
    extent: tuple[float, float, float, float]
    params: SyntheticParams

    def middle(self, size: float) -> Site:
        """Return the middle of the site, `size` m wide and high: the same landscape, the same points, fewer of them.

        Examples
        --------
        >>> six_sites()[0].middle(100.0).extent
        (600100.0, 4400100.0, 600200.0, 4400200.0)
        """
        x, y = (self.extent[0] + self.extent[2]) / 2, (self.extent[1] + self.extent[3]) / 2
        return replace(self, extent=(x - size / 2, y - size / 2, x + size / 2, y + size / 2))


def six_sites() -> tuple[Site, ...]:
    """Return six sites with the densities and the ranges of slope, cover and canopy height of the PPDF paper.

    Returns
    -------
    tuple of Site
        300 x 300 m each, of 21.74, 7.90, 7.82, 6.73, 8.10 and 2.16 points/m2 (PPDF paper, Table 1). Mean slopes
        spread over 18.3 to 37.1 degrees, canopy cover over 7 to 85 %, canopy height over 7.8 to 23.6 m (its Figures 3
        and 4). Which site has which terrain, slope and cover is our choice: the paper gives the ranges only.

    Examples
    --------
    >>> [site.name for site in six_sites()]
    ['1-gentle', '2-valleys', '3-ridges', '4-steep', '5-hilltops', '6-breaklines']
    """
    # Slope, cover, tree height and pulse density were found by measuring the finished sites as the paper measured its
    # own (10 nearest ground points, 1 m canopy height model, 10 m cells).
    dry = SyntheticParams(water="none", terrace_height=0.0, scarp_height=0.0, house_share=0.0, boulder_share=0.05)
    gentle = dry.replace(
        seed=101,
        density=11.8,
        slope=24.3,
        relief_length=180.0,
        spurs=0.3,
        roughness=0.8,
        canopy_cover=0.47,
        canopy_height=29.5,
    )
    valleys = dry.replace(
        seed=102,
        density=5.15,
        slope=31.0,
        relief_length=110.0,
        valley_floor=14.0,
        rounding=4.0,
        spurs=0.3,
        meander=1.2,
        canopy_cover=0.352,
        canopy_height=14.1,
    )
    ridges = dry.replace(
        seed=103,
        density=3.62,
        slope=32.1,
        relief_length=70.0,
        valley_floor=4.0,
        crest=0.0,
        rounding=1.5,
        spurs=0.5,
        roughness=1.5,
        canopy_cover=0.677,
        canopy_height=21.2,
    )
    steep = dry.replace(
        seed=104,
        density=6.27,
        slope=28.1,
        relief_length=260.0,
        valley_floor=6.0,
        crest=6.0,
        spurs=0.2,
        roughness=1.0,
        canopy_cover=0.0125,
        canopy_height=13.2,
    )
    hilltops = dry.replace(
        seed=105,
        density=4.0,
        slope=26.5,
        relief_length=90.0,
        valley_floor=12.0,
        crest=12.0,
        rounding=10.0,
        spurs=1.0,
        canopy_cover=0.563,
        canopy_height=25.2,
    )
    break_lines = dry.replace(
        seed=106,
        density=1.54,
        slope=37.7,
        relief_length=120.0,
        rounding=0.5,
        terrace_height=3.0,
        scarp_height=6.0,
        spurs=0.4,
        canopy_cover=0.272,
        canopy_height=18.9,
    )
    return (
        _site("1-gentle", 21.74, 0, gentle),
        _site("2-valleys", 7.90, 1, valleys),
        _site("3-ridges", 7.82, 2, ridges),
        _site("4-steep", 6.73, 3, steep),
        _site("5-hilltops", 8.10, 4, hilltops),
        _site("6-breaklines", 2.16, 5, break_lines),
    )


def _site(name: str, density: float, number: int, params: SyntheticParams) -> Site:
    x, y = 600_000.0 + 10_000.0 * number, 4_400_000.0
    return Site(name, density, (x, y, x + SITE_SIZE, y + SITE_SIZE), params)
