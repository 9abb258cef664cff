"""One decorator for compiled helper functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

F = TypeVar("F", bound=Callable[..., object])

# The type stubs leave the option out.
_njit: Any = njit


def leaf(function: F) -> F:
    """Compile a function that creates no array, without reference counting.

    A helper with several array arguments and a branch costs two atomic operations per argument and call when numba
    counts references: that was four fifths of the time of a neighbour search. The caller holds the arrays anyway. A
    function that creates an array does not compile with this decorator, so a mistake shows at once.

    Parameters
    ----------
    function : callable
        As for ``numba.njit(nogil=True, cache=True)``.

    Returns
    -------
    callable
        The dispatcher.

    Examples
    --------
    >>> from ppdf_dask.filters.ppdf.paper import _growth_kernels
    >>> _growth_kernels._slot(3, -4, False)  # the fourth quadrant
    3
    """
    compiled: F = _njit(nogil=True, cache=True, _nrt=False, error_model="numpy")(function)
    return compiled
