"""The filters: points in, mask out. One registry; nothing here knows of Dask, Zarr or LAS.

A filter is a `Filter` record. The built-in ones and those of other packages are found through the entry-point group
``ppdf_dask.filters``: a package that declares ::

    [project.entry-points."ppdf_dask.filters"]
    flat = "their_package:FILTER"

has added ``--filter flat`` to every command. The parameter class must be the filter's own: it tells whose it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points

import numpy.typing as npt

from ppdf_dask.errors import ParameterError
from ppdf_dask.filters.cloud import Bools, Cloud, Density, Verdict, cloud_from_xyz, density
from ppdf_dask.params import Parameters

GROUP = "ppdf_dask.filters"


@dataclass(frozen=True)
class Filter:
    """A ground filter as the engine sees it.

    Attributes
    ----------
    name : str
        As in ``--filter NAME``.
    profiles : mapping of str to Parameters
        Named parameter sets; the first one is the default.
    classify : callable
        ``classify(cloud, params) -> Verdict``: pure, no clock, no global random state.
    required_buffer : callable
        ``required_buffer(params) -> float``: metres. For an exact filter a first guess, for the others the reach beyond
        which the result does not change noticeably.
    exact : bool
        True when the filter proves its answers (fills `Verdict.unproven`); then no seam can show.
    resolve : callable
        ``resolve(params, density) -> Parameters``: makes what is derived from the job-wide density explicit.
    bytes_per_point : float or callable
        Peak memory per loaded point above the 12 bytes of the points themselves, for the planner; where it depends on
        the profile or the density, ``bytes_per_point(params, density) -> float``.
    """

    name: str
    profiles: Mapping[str, Parameters]
    classify: Callable[[Cloud, Parameters], Verdict]
    required_buffer: Callable[[Parameters], float]
    exact: bool
    resolve: Callable[[Parameters, Density], Parameters]
    bytes_per_point: float | Callable[[Parameters, Density], float]


@cache
def _entries() -> tuple[EntryPoint, ...]:
    """Return the entry points; finding them reads the metadata of all installed packages."""
    return tuple(entry_points(group=GROUP))


def names() -> list[str]:
    """Return the names of all installed filters."""
    return sorted({e.name for e in _entries()})


def get(name: str) -> Filter:
    """Return the filter with this name.

    Raises
    ------
    ParameterError
        When no installed package offers it, two do, or what the package offers cannot be imported or is no filter.
    """
    offered = {e.value: e for e in _entries() if e.name == name}
    if not offered:
        raise ParameterError(f"there is no filter {name!r}; installed: {', '.join(names())}")
    if len(offered) > 1:
        raise ParameterError(
            f"the filter {name!r} is offered by {' and '.join(sorted(offered))}; uninstall one of them"
        )
    ((value, entry),) = offered.items()
    try:
        found = entry.load()
    except (ImportError, AttributeError) as error:
        raise ParameterError(
            f"the filter {name!r} cannot be loaded from {value!r} ({error}); repair or uninstall its package"
        ) from error
    if not isinstance(found, Filter):
        raise ParameterError(f"the entry point {value!r} of filter {name!r} is not a ppdf_dask Filter")
    return found


def of(params: Parameters) -> Filter:
    """Return the filter that a parameter object belongs to.

    Raises
    ------
    ParameterError
        When no installed filter takes such parameters; it names those that could not be loaded. A filter that cannot be
        loaded is in nobody's way otherwise.
    """
    broken = []
    for name in names():
        try:
            candidate = get(name)
        except ParameterError as error:
            broken.append(str(error))
            continue
        if any(type(p) is type(params) for p in candidate.profiles.values()):
            return candidate
    raise ParameterError("; ".join([f"no installed filter takes {type(params).__name__}", *broken]))


def parameters(name: str, profile: str | None = None) -> Parameters:
    """Return the parameter object of a filter's profile; without `profile` its default."""
    profiles = get(name).profiles
    if profile is None:
        return next(iter(profiles.values()))
    if profile not in profiles:
        raise ParameterError(f"filter {name!r} has no profile {profile!r}; it has {', '.join(profiles)}")
    return profiles[profile]


def classify_ground(xyz: npt.ArrayLike, params: Parameters | str | None = None) -> Bools:
    """Tell for each point whether it is ground.

    Parameters
    ----------
    xyz : array_like, shape (n, 3)
        Eligible points (see `ClassRules`): finite x, y, z in metres, z up, any order.
    params : Parameters or str, optional
        A filter's parameter object, or a filter's name for its default profile. Default: PPDF's robust profile.

    Returns
    -------
    ndarray of bool, shape (n,)
        True where ground; the same mask as that of a run over the same points.

    Raises
    ------
    ParameterError
        Wrong shape, a coordinate that is not finite, or an unknown filter.

    Examples
    --------
    >>> import numpy as np
    >>> x, y = np.meshgrid(np.arange(0, 40, 0.7), np.arange(0, 40, 0.7))
    >>> terrain = np.column_stack([x.ravel(), y.ravel(), 0.1 * x.ravel()])
    >>> shrub = np.array([[20.1, 20.1, 9.0]])
    >>> ground = classify_ground(np.vstack([terrain, shrub]))
    >>> bool(ground[:-1].all()), bool(ground[-1])
    (True, False)
    """
    if params is None:
        params = parameters("ppdf")
    elif isinstance(params, str):
        params = parameters(params)
    chosen = of(params)
    cloud = cloud_from_xyz(xyz)
    return chosen.classify(cloud, chosen.resolve(params, density(cloud))).ground
