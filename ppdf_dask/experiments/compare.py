"""The comparison of filters on sites with known ground, on a cluster: one future per site, filter and profile.

A worker reads a site, runs one filter, writes its terrain model below the study's folder and returns a small record.
As for a run, the sites and that folder must be visible to all workers.
"""

from __future__ import annotations

import tomllib
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ppdf_dask import filters
from ppdf_dask.errors import ParameterError, SurveyError
from ppdf_dask.events import Event, Listener, ignore
from ppdf_dask.execute import Stage, Work, execute
from ppdf_dask.experiments.labelled import files_in
from ppdf_dask.experiments.tuning import Grid, leave_one_out
from ppdf_dask.experiments.workers import Case, Row, SiteFile, measure, measure_site, search
from ppdf_dask.metrics import Scores
from ppdf_dask.quarantine import Failure
from ppdf_dask.synthetic.sites import SITE_SIZE

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True)
class Comparison:
    """What `compare` found.

    Attributes
    ----------
    sites : tuple of dict
        A record per site: ``site``, ``rect`` (m), ``scored`` and the statistics of `ppdf_dask.sites`.
    rows : tuple of Row
        By case, then by site.
    failures : tuple of Failure
        Cases that could not be done.
    tuned : tuple of Grid
        Grids that were searched.
    """

    sites: tuple[dict[str, Any], ...]
    rows: tuple[Row, ...]
    failures: tuple[Failure, ...] = ()
    tuned: tuple[Grid, ...] = ()

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the cases, in order."""
        return tuple(dict.fromkeys(row.case.name for row in self.rows))

    def of(self, case: str) -> list[Row]:
        """Return the rows of a case, by site."""
        return [row for row in self.rows if row.case.name == case]


def site_files(folder: str | Path, score: str | None = None) -> list[SiteFile]:
    """Return the labelled clouds of a folder, each a site of its own, by name.

    Raises
    ------
    SurveyError
        When there are none, or one has no readable header.
    """
    import laspy

    found = []
    paths = files_in(folder)
    stems = [path.stem for path in paths]
    for path in paths:
        try:
            with laspy.open(path) as reader:
                count = int(reader.header.point_count)
        except (laspy.LaspyException, ValueError, OSError) as error:
            raise SurveyError(f"{path} cannot be read as LAS or LAZ ({error}); remove or re-deliver it") from error
        name = path.stem if stems.count(path.stem) == 1 else path.name
        found.append(SiteFile(name, str(path.resolve()), count, score))
    return found


def write_six_sites(folder: str | Path, size: float = SITE_SIZE) -> Path:
    """Write the six synthetic sites, with their true classes, as LAZ tiles; those that are there already stay.

    Parameters
    ----------
    folder : str or Path
        Where to put the folder of the tiles, which is named after their size.
    size : float
        Edge of each site, m, around its middle; default 300, as in the paper.

    Returns
    -------
    Path
        The folder of the tiles: ``six-sites-300m``.
    """
    from ppdf_dask.synthetic import six_sites
    from ppdf_dask.synthetic.scanner import rect_of
    from ppdf_dask.synthetic.tiles import write_tile

    tiles = Path(folder) / f"six-sites-{size:g}m"
    for made in (site.middle(size) for site in six_sites()):
        path = tiles / f"{made.name}.laz"
        if not path.is_file():
            write_tile(rect_of(made.extent), made.params, [(path, True)], "EPSG:32610")
    return tiles


def cases(names: Sequence[str], profiles: Sequence[str] = ("default", "paper")) -> list[Case]:
    """Return each filter with each profile it has.

    Parameters
    ----------
    names : sequence of str
        Filters; ``all`` stands for all that are installed.
    profiles : sequence of str
        Profiles; ``default`` stands for each filter's first one, ``paper`` for every reading of the paper's Table 2
        (``paper-seeded``, ``paper-smooth``), ``all`` for all. A filter without one of the others is left out there.

    Raises
    ------
    ParameterError
        When a filter is unknown, or a profile that no installed filter has.

    Examples
    --------
    >>> [case.name for case in cases(["ppdf", "smrf", "msf"])]
    ['ppdf robust', 'ppdf paper', 'smrf default', 'msf default', 'msf paper', 'msf paper-seeded']
    """
    everywhere = {p for name in filters.names() for p in filters.get(name).profiles} | {"default", "all"}
    unknown = sorted(set(profiles) - everywhere)
    if unknown:
        raise ParameterError(f"no filter has a profile {', '.join(unknown)}; there are {', '.join(sorted(everywhere))}")
    found: dict[str, Case] = {}
    for name in dict.fromkeys(n for asked in names for n in (filters.names() if asked == "all" else [asked])):
        known = filters.get(name).profiles
        for profile in (each for asked in profiles for each in _meant(asked, list(known))):
            found.setdefault(f"{name} {profile}", Case(name, profile, known[profile]))
    return list(found.values())


def _meant(asked: str, known: Sequence[str]) -> list[str]:
    """Return the profiles of one filter that a word asks for."""
    if asked == "all":
        return list(known)
    if asked == "default":
        return [known[0]]
    return [p for p in known if p == asked or (asked == "paper" and p.startswith("paper-"))]


def configured(path: str | Path) -> list[Case]:
    """Read cases from a TOML file: a table ``[FILTER.NAME]`` per case.

    Parameters
    ----------
    path : str or Path
        Each table holds parameters of the filter; ``profile`` tells whose values the others keep, the default's without
        it. NAME is what the case is called.

    Returns
    -------
    list of Case

    Raises
    ------
    ParameterError
        When the file is no TOML, or a table does not fit.
    """
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise ParameterError(f"{path} is not a readable TOML file: {error}") from error
    found = []
    for name, group in tables.items():
        if not isinstance(group, dict) or not all(isinstance(table, dict) for table in group.values()):
            raise ParameterError(
                f"{path}: {name!r} must be tables [FILTER.NAME], such as [smrf.steep] with slope = 0.3"
            )
        for profile, table in group.items():
            values = dict(table)
            try:
                base = filters.parameters(name, values.pop("profile", None))
                found.append(Case(name, profile, base.replace(**values)))
            except ParameterError as error:
                raise ParameterError(f"{path}, table [{name}.{profile}]: {error}") from error
    return found


def compare(
    client: Client,
    study: Sequence[SiteFile],
    asked: Sequence[Case],
    out: str | Path,
    *,
    grids: Sequence[Grid] = (),
    on_event: Listener = ignore,
) -> Comparison:
    """Run every case on every site.

    Parameters
    ----------
    client : distributed.Client
        Any client; its workers see the sites and `out`.
    study : sequence of SiteFile
        The sites.
    asked : sequence of Case
        The filters with their parameters.
    out : str or Path
        Folder of the study; rasters go to ``rasters/<site>/<case>.tif``.
    grids : sequence of Grid
        Also search these, leave one site out, and run the chosen parameters as cases of their own.
    on_event : callable
        Hears of the progress.

    Returns
    -------
    Comparison

    Raises
    ------
    SurveyError
        When a site cannot be read or has no reference.
    ParameterError
        When there is nothing to do, or too few sites to leave one out.
    """
    if not asked and not grids:
        raise ParameterError("no filter was chosen; name some with --filters")
    if grids and len(study) < 2:
        leave_one_out({site.name: () for site in study})
    folder, token = str(Path(out).resolve()), uuid.uuid4().hex[:8]
    records = measure_sites(client, study, out, on_event=on_event)
    chosen, failures = _searched(client, study, grids, folder, token, on_event)
    jobs = [(site, case) for case in asked for site in study]
    jobs += [(site, choice[site.name]) for choice in chosen for site in study]
    work = [Work(_ident(site, case), site.points, (site, case), "") for site, case in jobs]
    done: dict[str, Row] = {}
    for piece, outcome in _stage(client, Stage("compare", measure, folder, token), work, on_event):
        if isinstance(outcome, Failure):
            failures.append(outcome)
        else:
            done[piece.ident] = _row(outcome, piece.job[1])
    rows = tuple(done[piece.ident] for piece in work if piece.ident in done)
    return Comparison(tuple(records), rows, tuple(failures), tuple(grids))


def measure_sites(
    client: Client, study: Sequence[SiteFile], out: str | Path, *, on_event: Listener = ignore
) -> list[dict[str, Any]]:
    """Measure the sites themselves: a record each, rasters below ``rasters/<site>``.

    Raises
    ------
    SurveyError
        When a site cannot be read or has no reference.
    """
    folder, token = str(Path(out).resolve()), uuid.uuid4().hex[:8]
    work = [Work(site.name, site.points, site, "") for site in study]
    records = {}
    for piece, outcome in _stage(client, Stage("sites", measure_site, folder, token), work, on_event):
        if isinstance(outcome, Failure):
            raise SurveyError(f"site {piece.ident}: {outcome.error}")
        records[piece.ident] = outcome
    return [records[site.name] for site in study]


def _searched(
    client: Client, study: Sequence[SiteFile], grids: Sequence[Grid], out: str, token: str, on_event: Listener
) -> tuple[list[Mapping[str, Case]], list[Failure]]:
    """Search the grids; return the chosen case per site, for each grid that could be searched on all sites."""
    work = [
        Work(f"{site.name}-{grid.filter}-{grid.name}", site.points, (site, grid), "")
        for grid in grids
        for site in study
    ]
    totals: dict[str, list[float]] = {}
    failures = []
    if work:
        for piece, outcome in _stage(client, Stage("tune", search, out, token), work, on_event):
            if isinstance(outcome, Failure):
                failures.append(outcome)
            else:
                totals[piece.ident] = outcome["totals"]
    found: list[Mapping[str, Case]] = []
    for grid in grids:
        mine = {site.name: totals.get(f"{site.name}-{grid.filter}-{grid.name}") for site in study}
        known = {name: errors for name, errors in mine.items() if errors is not None}
        if len(known) == len(study):
            choice = grid.candidates()
            best = leave_one_out(known)
            found.append({name: Case(grid.filter, grid.name, choice[k]) for name, k in best.items()})
    return found, failures


def _stage(
    client: Client, stage: Stage, work: Sequence[Work], on_event: Listener
) -> Iterable[tuple[Work, dict[str, Any] | Failure]]:
    on_event(Event(stage.name, "stage", total=sum(w.points for w in work), record={"tasks": len(work)}))
    # Large sites first, so that none is left alone at the end.
    return execute(client, stage, sorted(work, key=lambda w: -w.points), on_event)


def _ident(site: SiteFile, case: Case) -> str:
    return f"{site.name}-{case.filter}-{case.profile}"


def _row(record: dict[str, Any], case: Case) -> Row:
    values = {k: v for k, v in record.items() if k not in ("counts", "notes")}
    return Row(case=case, scores=Scores(**record["counts"]), notes=tuple(record["notes"]), **values)
