"""Pictures with matplotlib: maps of a survey and a plan, hillshades, sections coloured by class, planes of the paper.

Every function draws into given axes or new ones and returns them; nothing is shown or saved. The colours are those of
Okabe and Ito or run from dark to light, so that people with any colour vision tell them apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ppdf_dask.errors import ParameterError
from ppdf_dask.grid import MM, ChunkGrid, Rect
from ppdf_dask.maps import PALETTE
from ppdf_dask.plotdata import Line, read_raster, section_points, unit_metres

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ppdf_dask.filters.ppdf.paper.params import PaperParams
    from ppdf_dask.plan import Plan
    from ppdf_dask.result import Result
    from ppdf_dask.survey import Survey

CLASSES = {
    2: ("ground", PALETTE["red"]),
    1: ("not ground", PALETTE["green"]),
    6: ("building", "#000000"),
    7: ("noise", PALETTE["pink"]),
    9: ("water", PALETTE["blue"]),
}
"""Name and colour of a class in a section; 3 to 5 are drawn as 1, 0 too, 18 as 7, any other class in light blue."""

_SAME = {0: 1, 3: 1, 4: 1, 5: 1, 18: 7}
_OTHER = ("other classes", PALETTE["sky"])


def survey_map(survey: Survey, ax: Axes | None = None) -> Axes:
    """Draw the tiles of a survey, those that overlap others in another colour.

    Parameters
    ----------
    survey : Survey
        From `scan`.
    ax : matplotlib.axes.Axes, optional
        Where to draw; default a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        In metres.
    """
    bad = {o.first for o in survey.overlaps} | {o.second for o in survey.overlaps}
    tiles = [t for t in survey.tiles if t.point_count]
    ax = _axes(ax)
    plain = [t.bounds for t in tiles if t.path not in bad]
    _rectangles(ax, plain, PALETTE["sky"], f"{len(plain)} tiles")
    doubled = [t.bounds for t in tiles if t.path in bad]
    if doubled:
        _rectangles(ax, doubled, PALETTE["orange"], f"{len(doubled)} tiles overlap others")
    return _map_frame(ax, "m", f"{survey.point_count:,} points, {survey.crs_name}")


def plan_map(plan: Plan, ax: Axes | None = None) -> Axes:
    """Draw the chunks of a plan, shaded by the points a worker will load, over the outlines of the tiles.

    Parameters
    ----------
    plan : Plan
        From `plan`.
    ax : matplotlib.axes.Axes, optional
        Where to draw; default a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        In metres, with a colour bar.
    """
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    ax = _axes(ax)
    squares = PatchCollection([_rectangle(c.core, Rectangle) for c in plan.chunks], cmap="cividis", edgecolor="white")
    squares.set_array(np.array([c.loaded for c in plan.chunks]) / 1e6)
    squares.set_clim(vmin=0)
    ax.add_collection(squares)
    _figure(ax).colorbar(squares, ax=ax, label="million points loaded, with buffer")
    tiles = [t.bounds for t in plan.survey.tiles if t.point_count]
    _rectangles(ax, tiles, PALETTE["orange"], f"{len(tiles)} tiles", fill=False)
    facts = f"{len(plan.chunks)} chunks of {plan.grid.size / MM:g} m, buffer {plan.buffer / MM:g} m at first"
    return _map_frame(ax, "m", facts)


class ResultPlots:
    """The pictures of a finished run: ``result.plot.hillshade()`` and so on.

    Parameters
    ----------
    result : Result
        The run.
    """

    def __init__(self, result: Result) -> None:
        self._result = result

    def hillshade(
        self,
        area: tuple[float, float, float, float] | None = None,
        *,
        azimuth: float = 315.0,
        altitude: float = 45.0,
        exaggeration: float = 1.0,
        ax: Axes | None = None,
    ) -> Axes:
        """Draw the terrain model lit by a low sun, tinted by height.

        Parameters
        ----------
        area : tuple of float, optional
            ``(x0, y0, x1, y1)`` in the CRS's units; default the whole raster. A large one is read from the file's
            overviews, at most 1500 pixels along an edge, so memory does not grow with the survey.
        azimuth, altitude, exaggeration : float
            As in `products.hillshade`, degrees and a factor.
        ax : matplotlib.axes.Axes, optional
            Where to draw; default a new figure.

        Returns
        -------
        matplotlib.axes.Axes
            In the CRS's units; white where there is no height.

        Raises
        ------
        ParameterError
            If the area does not meet the raster.
        """
        height, extent, pixel, unit = read_raster(self._result.out / "dtm.tif", area)
        metres = self._result.summary["plan"]["params"]["dtm"]["resolution"] * pixel
        ax = draw_hillshade(
            height, extent, metres / unit_metres(unit), _axes(ax), sun=(azimuth, altitude), exaggeration=exaggeration
        )
        _figure(ax).colorbar(ax.images[0], ax=ax, label=f"height, {unit}")
        return _map_frame(ax)

    def section(self, line: Line, width: float = 2.0, *, ax: Axes | None = None) -> Axes:
        """Draw a cross section through the classified tiles, coloured by class.

        Parameters
        ----------
        line : sequence of two (x, y)
            From where to where, in the CRS's units.
        width : float
            Full width of the strip whose points are drawn, in the CRS's units; 2 shows single trees.
        ax : matplotlib.axes.Axes, optional
            Where to draw; default a new figure.

        Returns
        -------
        matplotlib.axes.Axes
            Distance along the line against height, ground on top.

        Raises
        ------
        ParameterError
            If the line has no length, the width is not positive, or no point lies in the strip.
        """
        along, z, classes = section_points(self._result.tiles, line, width)
        if len(z) == 0:
            raise ParameterError(f"no point lies within {width / 2:g} of the line {line}; is it inside the survey?")
        return draw_section(along, z, classes, _axes(ax, (9, 3.5)))

    def planes(self, chunk: str | None = None, *, params: PaperParams | None = None, ax: Axes | None = None) -> Axes:
        """Draw the planes that the published method finds in one chunk, by the size of their squares.

        Parameters
        ----------
        chunk : str, optional
            One of `Result.chunks`; default the first.
        params : PaperParams, optional
            Default: the run's own if it ran the paper profile, else the published values.
        ax : matplotlib.axes.Axes, optional
            Where to draw; default a new figure.

        Returns
        -------
        matplotlib.axes.Axes
            In metres. Places of the chunk's eligible points without a plane stay as grey dots.
        """
        from ppdf_dask.filters.cloud import cloud_from_xyz
        from ppdf_dask.filters.ppdf.paper.classify import stages

        points = self._result.open_points(chunk or self._result.chunks[0])
        xyz = np.column_stack([points[name].values for name in "xyz"])
        found = stages(cloud_from_xyz(xyz), params or self._params())
        return draw_planes(xyz, found.planes, _axes(ax))

    def map(self, ax: Axes | None = None) -> Axes:
        """Draw the chunks of the run that hold points.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw; default a new figure.

        Returns
        -------
        matplotlib.axes.Axes
            In metres.
        """
        grid = ChunkGrid.from_metres(self._result.summary["plan"]["chunk_size_m"])
        ax = _axes(ax)
        chunks = [grid.parse(name).core for name in self._result.chunks]
        _rectangles(ax, chunks, PALETTE["green"], f"{len(chunks)} classified chunks")
        return _map_frame(ax, "m")

    def _params(self) -> PaperParams:
        from ppdf_dask.filters.ppdf.paper.params import PaperParams

        used = self._result.summary["filter"]
        return PaperParams.from_dict(used) if used["kind"] == "PaperParams" else PaperParams()


# -- from arrays ------------------------------------------------------------------------------------------------------


def draw_hillshade(
    height: NDArray[Any],
    extent: tuple[float, float, float, float],
    resolution: float,
    ax: Axes,
    *,
    sun: tuple[float, float] = (315.0, 45.0),
    exaggeration: float = 1.0,
) -> Axes:
    """Draw a raster of heights, tinted and shaded.

    Parameters
    ----------
    height : ndarray, (rows, columns)
        North up, NaN where unknown.
    extent : tuple of float
        ``(x0, x1, y0, y1)`` of its outer edges.
    resolution : float
        Pixel size in the unit of the heights.
    ax : matplotlib.axes.Axes
        Where to draw.
    sun : tuple of float
        Azimuth and altitude, degrees.
    exaggeration : float
        Factor on the heights for the shading.

    Returns
    -------
    matplotlib.axes.Axes
        `ax`, with the tint as its first image.
    """
    from ppdf_dask.products import hillshade

    azimuth, altitude = sun
    shade = hillshade(height, resolution, azimuth=azimuth, altitude=altitude, exaggeration=exaggeration)
    ax.imshow(height, extent=extent, cmap="cividis", interpolation="nearest")
    ax.imshow(shade, extent=extent, cmap="gray", vmin=0.0, vmax=1.0, alpha=0.65, interpolation="nearest")
    rows, columns = (np.flatnonzero(np.isfinite(shade).any(axis=axis)) for axis in (1, 0))
    if len(rows):
        (x0, x1, y0, y1), (n, m) = extent, height.shape
        dx, dy = (x1 - x0) / m, (y1 - y0) / n
        ax.set_xlim(x0 + columns[0] * dx, x0 + (columns[-1] + 1) * dx)
        ax.set_ylim(y1 - (rows[-1] + 1) * dy, y1 - rows[0] * dy)
    return ax


def draw_section(along: NDArray[Any], z: NDArray[Any], classes: NDArray[Any], ax: Axes, *, size: float = 2.0) -> Axes:
    """Draw points of a section, one colour per class, ground last.

    Parameters
    ----------
    along, z : ndarray, shape (n,)
        Distance and height.
    classes : ndarray of int, shape (n,)
        ASPRS classes.
    ax : matplotlib.axes.Axes
        Where to draw.
    size : float
        Area of a dot, points squared.

    Returns
    -------
    matplotlib.axes.Axes
        `ax`, with a legend of the classes that are there.
    """
    shown = np.array([_SAME.get(c, c if c in CLASSES else 255) for c in range(256)])[np.asarray(classes, np.uint8)]
    for kind in sorted(np.unique(shown), key=lambda c: (c == 2, c)):
        name, colour = CLASSES.get(int(kind), _OTHER)
        here = shown == kind
        ax.scatter(along[here], z[here], s=size, c=colour, linewidths=0, label=f"{name}, {here.sum():,}")
    ax.set(xlabel="distance along the line", ylabel="height")
    # Above the axes: terrain may rise anywhere inside.
    ax.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=5,
        fontsize="small",
        markerscale=4,
        frameon=False,
        borderpad=0,
    )
    return ax


def draw_planes(xyz: NDArray[Any], planes: Any, ax: Axes) -> Axes:
    """Draw the squares of accepted planes over the points they were sought in.

    Parameters
    ----------
    xyz : ndarray, shape (n, 3)
        The points, metres.
    planes : ppdf_dask.filters.ppdf.paper.planes.Planes
        The planes.
    ax : matplotlib.axes.Axes
        Where to draw.

    Returns
    -------
    matplotlib.axes.Axes
        `ax`, with one colour and one legend entry per size of square.
    """
    import matplotlib as mpl

    ax.scatter(xyz[:, 0], xyz[:, 1], s=0.3, c=PALETTE["grey"], linewidths=0)
    sizes = sorted(set(planes.size.tolist()), reverse=True)
    colours = mpl.colormaps["cividis"](np.linspace(0, 1, max(len(sizes), 2)))
    for size, colour in zip(sizes, colours, strict=False):
        corners = np.rint(planes.corner[planes.size == size] * MM).astype(int).tolist()
        edge = round(size * MM)
        squares = [Rect(x, y, x + edge, y + edge) for x, y in corners]
        _rectangles(ax, squares, tuple(colour), f"{size:g} m: {len(squares)} planes")
    return _map_frame(ax, "m")


def _axes(ax: Axes | None, size: tuple[float, float] = (7, 6)) -> Axes:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=size, layout="constrained")[1]


def _figure(ax: Axes) -> Any:
    return ax.get_figure(root=True)


def _rectangle(rect: Rect, make: Any) -> Any:
    x0, y0, x1, y1 = rect.metres()
    return make((x0, y0), x1 - x0, y1 - y0)


def _rectangles(ax: Axes, rects: Sequence[Rect], colour: Any, label: str, *, fill: bool = True) -> None:
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    face, edge = (colour, "#333333") if fill else ("none", colour)
    line = 0.8 if len(rects) < 100 else 0.3
    shapes = [_rectangle(r, Rectangle) for r in rects]
    ax.add_collection(PatchCollection(shapes, facecolor=face, edgecolor=edge, linewidth=line))
    # A collection gives no legend entry of its own.
    ax.plot([], [], "s", markersize=9, markerfacecolor=face, markeredgecolor=edge, label=label)


def _map_frame(ax: Axes, unit: str = "", title: str = "") -> Axes:
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set(xlabel=f"x, {unit}" if unit else "x", ylabel=f"y, {unit}" if unit else "y")
    ax.ticklabel_format(useOffset=False, style="plain")
    for tick in ax.get_xticklabels():
        tick.set_rotation(30)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(title=title, loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=3, frameon=False, alignment="left")
    return ax
