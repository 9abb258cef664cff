"""Ground classification of airborne LiDAR surveys of any size, exact across tile seams, on Dask."""

__version__ = "0.1.0"
