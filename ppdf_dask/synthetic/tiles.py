"""Write a synthetic survey as LAZ tiles, with its truth beside it; same seed, same bytes."""

from __future__ import annotations

import datetime
import uuid
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ppdf_dask.errors import ParameterError
from ppdf_dask.grid import MM, Rect
from ppdf_dask.synthetic._pulses import Band
from ppdf_dask.synthetic.params import SyntheticParams
from ppdf_dask.synthetic.scanner import bands_of, rect_of

DEMO = SyntheticParams()
"""The demo's landscape: the default."""

DEMO_EXTENT = (500_000.0, 5_400_000.0, 500_400.0, 5_400_400.0)
"""Extent of the demo survey, metres in UTM."""

_KM = 1000 * MM


def write_survey(
    folder: str | Path,
    params: SyntheticParams = DEMO,
    *,
    extent: tuple[float, float, float, float] = DEMO_EXTENT,
    tile_size: int = 200,
    classified: bool = False,
    truth: bool = True,
    crs: str = "EPSG:25832",
) -> list[Path]:
    """Write a survey as LAZ 1.4 tiles of point format 6 into ``folder/tiles``, its truth into ``folder/truth``.

    Parameters
    ----------
    folder : str or Path
        Made when it does not exist; tiles of the same name are replaced.
    params : SyntheticParams
        The landscape and the scanner; the demo's by default.
    extent : tuple of float
        ``(x0, y0, x1, y1)`` in metres, half-open.
    tile_size : int
        Edge of a tile in whole metres; tiles lie at its absolute multiples and are cut at the extent.
    classified : bool
        False (default): the tiles are delivered as class 1, with labelled noise and water as 7, 18 and 9. True: the
        tiles hold the true classes, and there is no second folder.
    truth : bool
        Whether ``folder/truth`` gets the same points in the same order with their true classes, under the same names;
        default True. False saves half the time and disk of a large benchmark.
    crs : str
        Anything pyproj understands, for the headers.

    Returns
    -------
    list of Path
        The written tiles, by row and column from the south-west. A tile without points is not written.

    Raises
    ------
    ParameterError
        When the extent or the tile size is not usable.

    Notes
    -----
    Points go to the tile that contains the point, so that any two tile layouts hold the same set of points, and tiles
    can be made by many workers, each with its tile's extent. Memory is bounded by a band of pulses, whatever the extent
    and the tile size. Headers carry no clock.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     tiles = write_survey(folder, SyntheticParams(density=0.5), extent=(0, 0, 60, 30), tile_size=30)
    ...     print([str(tile.relative_to(folder)) for tile in tiles])
    ['tiles/x000000_y000000.laz', 'tiles/x000030_y000000.laz']
    """
    written = []
    for rect in tile_rects(extent, tile_size):
        size = tile_size * MM
        name = f"x{rect.x0 // size * tile_size:06d}_y{rect.y0 // size * tile_size:06d}.laz"
        targets = [(Path(folder) / "tiles" / name, classified)]
        if truth and not classified:
            targets.append((Path(folder) / "truth" / name, True))
        if write_tile(rect, params, targets, crs):
            written.append(targets[0][0])
    return written


def tile_rects(extent: tuple[float, float, float, float], tile_size: int) -> Iterator[Rect]:
    """Yield the rectangles of the tiles over an extent, row by row from the south-west."""
    if tile_size != int(tile_size) or tile_size < 1:
        raise ParameterError(f"tile_size = {tile_size} m must be a whole number of metres, 1 or more")
    whole, size = rect_of(extent), int(tile_size) * MM
    outer = whole.snap(size)
    for y in range(outer.y0, outer.y1, size):
        for x in range(outer.x0, outer.x1, size):
            yield Rect(max(x, whole.x0), max(y, whole.y0), min(x + size, whole.x1), min(y + size, whole.y1))


def write_tile(rect: Rect, params: SyntheticParams, targets: list[tuple[Path, bool]], crs: str) -> int:
    """Generate a tile once and write it to several files.

    Parameters
    ----------
    rect : Rect
        The tile, half-open, mm.
    params : SyntheticParams
        The survey.
    targets : list of (Path, bool)
        File, and whether it gets the true classes. Each is written under a temporary name and renamed when complete.
    crs : str
        For the header.

    Returns
    -------
    int
        Number of points; without any, no file is left.
    """
    import laspy

    count = 0
    parts = [path.with_name(path.name + ".part") for path, _ in targets]
    with ExitStack() as stack:
        writers = []
        for part in parts:
            part.parent.mkdir(parents=True, exist_ok=True)
            stream = stack.enter_context(part.open("wb"))
            header = _header(rect, params, crs)
            writers.append(
                stack.enter_context(
                    laspy.open(
                        stream,
                        mode="w",
                        header=header,
                        do_compress=True,
                        laz_backend=laspy.LazBackend.Lazrs,
                        closefd=False,
                    )
                )
            )
        for band in bands_of(rect, params):
            record = _record(band, writers[0].header)
            for writer, (_, truth) in zip(writers, targets, strict=True):
                record["classification"] = band.classification if truth else band.delivered
                writer.write_points(record)
            count += len(band.x)
    for part, (path, _) in zip(parts, targets, strict=True):
        if count:
            part.replace(path)
        else:
            part.unlink()
    return count


def _header(rect: Rect, params: SyntheticParams, crs: str) -> Any:
    import laspy
    from pyproj import CRS

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 1.0 / MM)
    header.offsets = np.array([rect.x0 // _KM * 1000.0, rect.y0 // _KM * 1000.0, 0.0])
    header.creation_date = datetime.date(2020, 1, 1)
    header.generating_software = "ppdf_dask synthetic"
    header.system_identifier = "synthetic"
    header.uuid = uuid.uuid5(uuid.NAMESPACE_OID, params.fingerprint())
    # Adjusted standard GPS time and a CRS in WKT, as LAS 1.4 wants them.
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.add_crs(CRS.from_user_input(crs))
    return header


def _record(band: Band, header: Any) -> Any:
    import laspy

    record = laspy.ScaleAwarePointRecord.zeros(len(band.x), header=header)
    record["X"] = band.x - round(header.offsets[0] * MM)
    record["Y"] = band.y - round(header.offsets[1] * MM)
    record["Z"] = band.z
    for name in (
        "return_number",
        "number_of_returns",
        "intensity",
        "gps_time",
        "scan_angle",
        "point_source_id",
    ):
        record[name] = getattr(band, name)
    return record
