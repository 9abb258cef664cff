"""One CRS and one pair of units for all files of a survey, or a refusal that names them."""

from __future__ import annotations

from collections import defaultdict

from ppdf_dask import crs as crs_module
from ppdf_dask.crs import Frame
from ppdf_dask.errors import SurveyError
from ppdf_dask.lasheader import Header
from ppdf_dask.tiles import Problem, named, shown


def frame_of(header: Header, assumed: Frame | None) -> Frame:
    """Return what a header says of its CRS, or what is assumed where it says nothing that can be understood."""
    frame = crs_module.from_records(header.wkt, header.geo_keys, header.wkt_first)
    if assumed is not None and (frame is crs_module.NOTHING or (frame.fault and frame.fault[0] == "crs-unreadable")):
        return assumed
    return frame


def remedy(code: str) -> str:
    """Return which option helps with a fault of a CRS."""
    if code == "crs-unreadable":
        return "; say what it is with --assume-crs, or only its unit with --assume-units"
    return "; say which unit it is with --assume-units" if code == "units" else ""


def common_frame(frames: dict[str, Frame], units: float | None) -> tuple[Frame, list[Problem]]:
    """Return the one CRS and units of all files, and what had to be assumed.

    Parameters
    ----------
    frames : dict
        Path to what its file says.
    units : float or None
        Metres per unit where the user says so.

    Raises
    ------
    SurveyError
        When files differ, or some say nothing.
    """
    if not frames:
        raise SurveyError("no tile is left to work on; every file has a problem")
    by_frame: dict[Frame, list[str]] = defaultdict(list)
    for path, frame in sorted(frames.items()):
        by_frame[Frame(frame.wkt, frame.unit_xy, frame.unit_z)].append(path)
    missing = [path for frame, group in by_frame.items() if frame.wkt is None for path in group]
    known = [frame for frame in by_frame if frame.wkt is not None]
    notes: list[Problem] = []
    if missing and known:
        raise SurveyError(
            f"{len(missing)} of {len(frames)} tiles have no CRS:\n{named(map(shown, missing))}\n"
            "Say what it is with --assume-crs (assume_crs=), or scan them on their own."
        )
    if not known:
        unit = 1.0 if units is None else units
        said = "taken to be metres" if units is None else f"in {crs_module.unit_name(unit)}, as --assume-units says"
        notes.append(Problem("", "crs-missing", f"no tile has a CRS; coordinates are {said}", False))
        return Frame(None, unit, unit), notes
    reference = _merge_frames(known, by_frame, notes)
    if units is not None:
        return Frame(reference.wkt, units, units), notes
    if reference.unit_z is None:
        name = crs_module.unit_name(reference.unit_xy or 1.0)
        if reference.unit_xy != 1.0:
            message = f"the CRS says nothing of heights; they are taken to be in its horizontal unit, {name}"
            notes.append(Problem("", "height-unit", message, False))
        return Frame(reference.wkt, reference.unit_xy, reference.unit_xy), notes
    return reference, notes


def _merge_frames(known: list[Frame], by_frame: dict[Frame, list[str]], notes: list[Problem]) -> Frame:
    """Return the most complete of equivalent frames; refuse a true mix."""
    groups: list[list[Frame]] = []
    for frame in known:
        home = next((g for g in groups if crs_module.compare(g[0].wkt or "", frame.wkt or "") != "different"), None)
        if home is None:
            groups.append([frame])
        else:
            home.append(frame)
    if len(groups) > 1:
        parts = []
        for group in groups:
            paths = sorted(path for frame in group for path in by_frame[frame])
            parts.append(f"{crs_module.crs_name(group[0].wkt)}, {len(paths)} tiles:\n{named(map(shown, paths))}")
        raise SurveyError(
            "the tiles have different coordinate reference systems:\n"
            + "\n".join(parts)
            + "\nReproject them to one, or run each group on its own."
        )
    group = groups[0]
    full = [f for f in group if f.unit_z is not None] or group
    bare = [path for f in group if f.unit_z is None for path in by_frame[f]]
    heights = {f.unit_z for f in full}
    unlike = any(crs_module.compare(full[0].wkt or "", f.wkt or "") == "different" for f in full)
    if len(heights) > 1 or unlike or (bare and full is not group and heights != {full[0].unit_xy}):
        lines = [f"{crs_module.crs_name(f.wkt)}: {shown(by_frame[f][0])} ..." for f in group]
        raise SurveyError(
            f"the tiles agree in the plane but not in height:\n{named(lines)}\n"
            "Bring them to one height system, or say the unit of all with --assume-units."
        )
    if bare and full is not group:
        message = f"{len(bare)} tiles say nothing of their heights; they are taken to be like the others"
        notes.append(Problem("", "height-missing", message, False))
    return full[0]
