"""``python -m ppdf_dask``: the command line."""

from ppdf_dask.cli import main

main()
