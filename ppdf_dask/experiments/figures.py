"""Figures of the comparison and of the sites, after Figures 3, 4 and 11 to 15 of the PPDF paper."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ppdf_dask.experiments.compare import Comparison
from ppdf_dask.experiments.rasters import read_raster
from ppdf_dask.experiments.reports import RATES
from ppdf_dask.experiments.workers import Row, raster_path
from ppdf_dask.maps import PALETTE
from ppdf_dask.plot import draw_hillshade

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Singles = npt.NDArray[np.float32]

MARKS = tuple(zip("osD^vP", ("blue", "orange", "green", "red", "pink", "sky"), strict=True))
"""A marker and a colour per site; with more sites than these all are drawn as grey dots."""

PIXELS = 500
"""Most pixels along an edge of a small map."""

SHADE = 0.35
"""Opacity of the hillshade: the colours of the heights must stay those of the colour bar."""

LAYERS = {
    "slope": ("slope of the ground, degrees", "viridis", 1.0, "slope_deg", "mean {:.1f} degrees"),
    "cover": ("canopy cover of 10 m cells, %", "YlGn", 100.0, "cover", "mean {:.1f} %"),
    "chm": ("canopy height model, m", "viridis", 1.0, "canopy_height_m", "mean canopy {:.1f} m"),
}
"""Title, colours, factor, number of the site's record and its caption, for each of a site's maps."""


def errors_figure(found: Comparison) -> Figure:
    """Draw mean, standard deviation and each site's value of the five rates per filter (Figure 11).

    Parameters
    ----------
    found : Comparison
        The results.

    Returns
    -------
    matplotlib.figure.Figure
    """
    values = [(heading, _rate(rate)) for rate, heading in RATES.items()]
    return _bars(found, values)


def runtime_figure(found: Comparison) -> Figure:
    """Draw processor and wall time per filter, with each site's value (Figure 15), on logarithmic axes."""

    def cpu(row: Row) -> float:
        return row.cpu

    def wall(row: Row) -> float:
        return row.seconds

    return _bars(found, [("processor time of the filter, s", cpu), ("wall time of the filter, s", wall)], log=True)


def terrain_figure(found: Comparison, out: str | Path, site: str) -> Figure:
    """Draw each filter's terrain model of a site beside the reference's, all in one colour scale (Figures 12 to 14).

    Parameters
    ----------
    found : Comparison
        The results.
    out : str or Path
        Folder of the study.
    site : str
        The site's name.

    Returns
    -------
    matplotlib.figure.Figure
    """
    reference = _read(out, site, "reference")
    low, high = _range([reference])
    rect = next(s["rect"] for s in found.sites if s["site"] == site)
    extent = (rect[0], rect[2], rect[1], rect[3])
    rows = [row for row in found.rows if row.site == site]
    figure, panels, legend = _panels(1 + len(rows), extent)
    names = ["reference", *(row.case.name for row in rows)]
    for axes, name in zip(panels, names, strict=True):
        height = _read(out, site, name)
        draw_hillshade(height, extent, (extent[1] - extent[0]) / height.shape[1], axes)
        axes.images[0].set_clim(low, high)
        axes.images[1].set_alpha(SHADE)
        axes.axis(extent)
        axes.set_title(name, fontsize="medium")
    figure.colorbar(panels[0].images[0], ax=legend, label="height, m", shrink=0.7)
    figure.suptitle(_title(site, rect, "terrain models of 1 m"))
    return figure


def difference_figure(found: Comparison, out: str | Path, site: str) -> Figure:
    """Draw each filter's terrain model less the reference's, all in one colour scale.

    Parameters
    ----------
    found : Comparison
        The results.
    out : str or Path
        Folder of the study.
    site : str
        The site's name.

    Returns
    -------
    matplotlib.figure.Figure
        Red: too high. Blue: too low. Grey: one of the two knows no height. The scale ends at the 98th percentile of the
        absolute differences of the middle filter, at least 0.5 m: what is worse is as dark as that.
    """
    from matplotlib import colormaps

    rect = next(s["rect"] for s in found.sites if s["site"] == site)
    extent = (rect[0], rect[2], rect[1], rect[3])
    rows = [row for row in found.rows if row.site == site]
    reference = read_raster(raster_path(out, site, "reference"))
    errors = [_thin(read_raster(raster_path(out, site, row.case.name)) - reference) for row in rows]
    known = [np.abs(e[np.isfinite(e)]) for e in errors]
    worst = [float(np.percentile(k, 98)) for k in known if k.size]
    limit = max(0.5, float(np.median(worst)) if worst else 0.0)
    figure, panels, legend = _panels(len(rows), extent)
    colours = colormaps["RdBu_r"].with_extremes(bad="#999999")
    for axes, row, error in zip(panels, rows, errors, strict=True):
        axes.imshow(error, extent=extent, cmap=colours, vmin=-limit, vmax=limit, interpolation="nearest")
        axes.set_title(f"{row.case.name}\nRMSE {row.rmse:.2f} m, {row.missing:.1%} missing", fontsize="medium")
    label = "filter less reference, m (grey: no height)"
    figure.colorbar(panels[0].images[0], ax=legend, label=label, shrink=0.7, extend="both")
    figure.suptitle(_title(site, rect, "errors of the terrain models"))
    return figure


def site_figure(sites: Sequence[dict[str, Any]], out: str | Path, layer: str) -> Figure:
    """Draw a map per site in one colour scale: slope (Figure 3), canopy cover or canopy height (Figure 4).

    Parameters
    ----------
    sites : sequence of dict
        Records of the sites.
    out : str or Path
        Folder of the study.
    layer : {"slope", "cover", "chm"}
        What to draw.

    Returns
    -------
    matplotlib.figure.Figure
    """
    from matplotlib import colormaps

    title, colours, factor, number, caption = LAYERS[layer]
    values = [_read(out, s["site"], layer) * factor for s in sites]
    low, high = (0.0, 100.0) if layer == "cover" else (0.0, _range(values)[1])
    first = sites[0]["rect"]
    figure, panels, legend = _panels(len(sites), (first[0], first[2], first[1], first[3]))
    for axes, site, value in zip(panels, sites, values, strict=True):
        rect = site["rect"]
        axes.imshow(
            value,
            extent=(rect[0], rect[2], rect[1], rect[3]),
            cmap=colormaps[colours].with_extremes(bad="#999999"),
            vmin=low,
            vmax=high,
            interpolation="nearest",
        )
        axes.set_title(f"{site['site']}\n{caption.format(site[number] * factor)}", fontsize="medium")
    figure.colorbar(panels[0].images[0], ax=legend, label=title, shrink=0.7)
    return figure


def _bars(found: Comparison, columns: Sequence[tuple[str, Callable[[Row], float]]], *, log: bool = False) -> Figure:
    """Draw a panel per column: each site's value, mean and deviation; the mean alone on a logarithmic axis."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    cases, names = found.cases, [s["site"] for s in found.sites]
    size = (2.0 + (4.0 if log else 2.6) * len(columns), 1.4 + 0.32 * len(cases))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for axes, (heading, value) in zip(panels, columns, strict=True):
        for k, case in enumerate(cases):
            _bar(axes, k, {row.site: value(row) for row in found.of(case)}, names, log)
        axes.set_title(heading, fontsize="medium")
        axes.grid(axis="x", color="#dddddd")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        if log:
            axes.set_xscale("log")
            low, high = axes.get_xlim()
            # Over three decades the labels of 2 and 5 would run into each other.
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 1000 * low else (1,)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter("")
    panels[0].set_yticks(range(len(cases)), cases)
    panels[0].invert_yaxis()
    if len(names) <= len(MARKS):
        for name, (mark, colour) in zip(names, MARKS, strict=False):
            panels[0].plot([], [], mark, color=PALETTE[colour], markeredgewidth=0, label=name)
        columns_of_legend = max(1, int(size[0] * 9 / (6 + max(map(len, names)))))
        figure.legend(loc="outside lower center", ncols=min(len(names), columns_of_legend), frameon=False)
    return figure


def _bar(axes: Axes, k: int, values: dict[str, float], names: Sequence[str], log: bool) -> None:
    finite = np.array([v for v in values.values() if math.isfinite(v)])
    if finite.size:
        mean, std = float(finite.mean()), float(finite.std(ddof=1)) if finite.size > 1 else 0.0
        if log:
            axes.plot([mean, mean], [k - 0.35, k + 0.35], color="black", linewidth=2, zorder=2)
        else:
            axes.barh(k, mean, 0.7, color="#d0d0d0", zorder=1)
            axes.errorbar(mean, k, xerr=std, color="black", capsize=3, linewidth=1, zorder=2)
    for name, x in values.items():
        mark, colour = MARKS[names.index(name)] if len(names) <= len(MARKS) else (".", "grey")
        axes.plot(x, k, mark, color=PALETTE[colour], markersize=5, markeredgewidth=0, zorder=3)


def _rate(name: str) -> Callable[[Row], float]:
    return lambda row: 100 * float(getattr(row.scores, name))


def _panels(count: int, extent: tuple[float, float, float, float]) -> tuple[Figure, list[Axes], list[Axes]]:
    """Return a figure of small maps, those in use, and all of them for the colour bar."""
    from matplotlib.figure import Figure

    columns = min(count, max(1, math.ceil(math.sqrt(count * 1.3))))
    rows = -(-count // columns)
    shape = min(2.0, max(0.5, (extent[3] - extent[2]) / (extent[1] - extent[0])))
    figure = Figure(figsize=(1.2 + 2.3 * columns, 0.6 + (2.3 * shape + 0.45) * rows), layout="constrained")
    every = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in every:
        axes.set_xticks([])
        axes.set_yticks([])
    for axes in every[count:]:
        axes.set_visible(False)
    return figure, every[:count], every


def _read(out: str | Path, site: str, layer: str) -> Singles:
    return _thin(read_raster(raster_path(out, site, layer)))


def _thin(values: Singles) -> Singles:
    step = -(-max(values.shape) // PIXELS)
    return values[::step, ::step]


def _range(values: Sequence[Singles]) -> tuple[float, float]:
    """Return the range that holds all but the extremes of the known values."""
    known = np.concatenate([v[np.isfinite(v)] for v in values])
    if known.size == 0:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(known, [0.5, 99.5]))
    return low, max(high, low + 1e-3)


def _title(site: str, rect: Sequence[float], what: str) -> str:
    return f"{site}, {rect[2] - rect[0]:g} x {rect[3] - rect[1]:g} m: {what}"
