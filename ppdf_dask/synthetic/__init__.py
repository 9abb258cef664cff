"""Synthetic surveys with known ground: any extent, any density, in bounded memory; same seed, same bytes."""

from ppdf_dask.synthetic.params import SyntheticParams
from ppdf_dask.synthetic.scanner import points
from ppdf_dask.synthetic.sites import Site, six_sites
from ppdf_dask.synthetic.terrain import true_height
from ppdf_dask.synthetic.terrestrial import terrestrial_plot
from ppdf_dask.synthetic.tiles import DEMO, DEMO_EXTENT, write_survey

__all__ = [
    "DEMO",
    "DEMO_EXTENT",
    "Site",
    "SyntheticParams",
    "points",
    "six_sites",
    "terrestrial_plot",
    "true_height",
    "write_survey",
]
