"""What a finished run left behind, opened lazily."""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ppdf_dask.errors import StoreError
from ppdf_dask.grid import MM, ChunkGrid
from ppdf_dask.store import RunStore

if TYPE_CHECKING:
    import xarray as xr

    from ppdf_dask.plot import ResultPlots


class Result:
    """A run's folder, read back.

    Parameters
    ----------
    out : str or Path
        Folder of a finished run.

    Raises
    ------
    StoreError
        When there is no finished run.
    """

    def __init__(self, out: str | Path) -> None:
        self.out = Path(out)
        if not (self.out / "run.json").is_file():
            raise StoreError(
                f"{self.out} holds no finished run; `ppdf-dask run ... --out {self.out}` makes or resumes one"
            )

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Everything in ``run.json``: versions, parameters, inputs, counts, timings, peak memory."""
        found: dict[str, Any] = json.loads((self.out / "run.json").read_text(encoding="utf-8"))
        return found

    @property
    def counts(self) -> dict[str, int]:
        """Points, eligible points, ground points, unproven points, chunks, blocks."""
        found: dict[str, int] = self.summary["counts"]
        return found

    @property
    def tiles(self) -> list[Path]:
        """The classified tiles, in the order of the inputs."""
        return [self.out / "laz" / tile["name"] for tile in self.summary["inputs"]]

    @property
    def dtm(self) -> xr.DataArray:
        """The terrain model as a lazy `xarray.DataArray` with its CRS; NaN where there is no data."""
        from ppdf_dask.mosaic import open_dtm

        return open_dtm(self.out / "run.zarr")

    @property
    def plot(self) -> ResultPlots:
        """Pictures: ``plot.hillshade()``, ``plot.section(line, width)``, ``plot.planes()``, ``plot.map()``."""
        from ppdf_dask.plot import ResultPlots

        return ResultPlots(self)

    def drop_intermediate(self) -> int:
        """Remove the intermediate points, most of ``run.zarr``; return the bytes that are free now.

        All results stay, and the same run finds nothing left to do. A later run with other parameters cuts the tiles
        again; `open_points` and `ppdf-dask seams` need the points.
        """
        from ppdf_dask.dropped import drop_points

        return drop_points(self.out)

    @property
    def chunks(self) -> list[str]:
        """Ids of the chunks that hold points."""
        return RunStore(str(self.out / "run.zarr")).classified()

    def open_points(self, chunk: str) -> xr.Dataset:
        """Open the eligible points of a chunk's core.

        Parameters
        ----------
        chunk : str
            One of `chunks`.

        Returns
        -------
        xarray.Dataset
            Dimension ``point``: x, y, z float64 in metres, ground bool, source (index into ``attrs["sources"]``).

        Raises
        ------
        StoreError
            When the chunk is unknown or the points were dropped.
        """
        import xarray as xr

        store = RunStore(str(self.out / "run.zarr"))
        corner = ChunkGrid.from_metres(self.summary["plan"]["chunk_size_m"]).parse(chunk).core
        masks = store.read_classification(chunk)
        points = [store.read_points(chunk, "core", source)[:3] for source in masks]
        lengths = [p.shape[1] for p in points]
        xyz = np.concatenate(points, axis=1)
        sources = [self.summary["inputs"][int(source[2:])]["name"] for source in masks]
        return xr.Dataset(
            {
                "x": ("point", (xyz[0] + np.int64(corner.x0)) / MM, {"units": "m"}),
                "y": ("point", (xyz[1] + np.int64(corner.y0)) / MM, {"units": "m"}),
                "z": ("point", xyz[2] / MM, {"units": "m"}),
                "ground": ("point", np.concatenate(list(masks.values()))),
                "source": ("point", np.repeat(np.arange(len(lengths), dtype=np.int32), lengths)),
            },
            attrs={"chunk": chunk, "sources": sources, "crs": self.summary["crs"] or ""},
        )

    def __repr__(self) -> str:
        c, stages = self.counts, self.summary["stages"]
        share = c["ground"] / max(c["eligible"], 1)
        return "\n".join(
            (
                f"Result: {self.out}",
                f"  points   {c['points']:,}, {c['eligible']:,} looked at, {c['ground']:,} ground ({share:.1%})",
                f"  chunks   {c['chunks']}, unproven points {c['unproven']}",
                "  tiles    " + f"{len(self.summary['inputs'])} in {self.out / 'laz'}",
                f"  terrain  {self.out / 'dtm.tif'}",
                "  seconds  " + ", ".join(f"{name} {s['seconds']:.1f}" for name, s in stages.items()),
                f"  memory   {max(s['peak_mb'] for s in stages.values()):.0f} MB at most in a worker",
            )
        )

    def _repr_html_(self) -> str:
        from ppdf_dask.maps import result_html

        return result_html(self)
