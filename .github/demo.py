"""Draw `.github/demo.png` from the demo's folder: ``python .github/demo.py demo``."""

from __future__ import annotations

import sys
from pathlib import Path

import laspy
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from ppdf_dask import Result
from ppdf_dask.plot import draw_hillshade

LINE = ((500_010.0, 5_400_320.0), (500_390.0, 5_400_130.0))


def surface(tiles: list[Path], dtm) -> np.ndarray:
    """Return the highest point per pixel of the terrain model, noise left out; NaN where there is none."""
    x0, y1 = float(dtm.x[0]) - 0.5, float(dtm.y[0]) + 0.5
    top = np.full(dtm.shape, -np.inf)
    for path in tiles:
        las = laspy.read(path)
        keep = ~np.isin(las.classification, (7, 18))
        x, y, z = (np.asarray(v)[keep] for v in (las.x, las.y, las.z))
        np.maximum.at(top, ((y1 - y).astype(int), (x - x0).astype(int)), z)
    return np.where(np.isfinite(top), top, np.nan)


def main(folder: Path) -> None:
    """Draw three panels: surface, terrain, section."""
    result = Result(folder / "run")
    dtm = result.dtm.load()
    x, y = dtm.x.values, dtm.y.values
    extent = (x[0] - 0.5, x[-1] + 0.5, y[-1] - 0.5, y[0] + 0.5)
    figure = plt.figure(figsize=(10.5, 7.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(2.2, 1))
    for column, (title, height) in enumerate(
        (("What the scanner saw", surface(result.tiles, dtm)), ("The ground beneath", dtm.values))
    ):
        ax = draw_hillshade(height, extent, 1.0, figure.add_subplot(grid[0, column]))
        ax.plot(*zip(*LINE, strict=True), color="white", linewidth=1.2, linestyle=(0, (4, 3)))
        ax.set_title(title, loc="left")
        ax.set_xlim(500_000, 500_400)
        ax.set_ylim(5_400_000, 5_400_400)
        ax.set_axis_off()
    ax = result.plot.section(LINE, 3.0, ax=figure.add_subplot(grid[1, :]))
    ax.set_title("Section along the dashed line, 3 m wide", loc="left")
    ax.set(xlabel="m", ylabel="m", xlim=(0, np.hypot(380, 190)))
    ax.spines[["top", "right"]].set_visible(False)
    figure.set_dpi(82)
    figure.canvas.draw()
    picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    picture.quantize(128, dither=Image.Dither.NONE).save(Path(__file__).with_name("demo.png"), optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
