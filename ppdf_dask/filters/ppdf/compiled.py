"""Two decorators for compiled functions: the kernels that Python calls, and the leaves that only kernels call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit
from numba.extending import register_jitable

F = TypeVar("F", bound=Callable[..., object])

# The type stubs leave options out.
_njit: Any = njit
_jitable: Any = register_jitable

# Counting references costs two atomic operations per array argument, call and branch: that was four fifths of the time
# of a neighbour search. Python holds the arrays anyway. Nobody calls the functions from C.
_LEAN = {"_nrt": False, "no_cfunc_wrapper": True}

# A signed index may count from the end, which numba looks at whenever one is used that is not a loop's own counter; the
# hottest kernels use unsigned ones (`np.uintp`).


def kernel(function: F) -> F:
    """Compile a function that Python calls; it creates no array, so a mistake shows at once.

    Parameters
    ----------
    function : callable
        As for ``numba.njit(nogil=True, cache=True)``, on arrays that the caller has made.

    Returns
    -------
    callable
        The dispatcher.

    Examples
    --------
    >>> from ppdf_dask.filters.ppdf.hashing import below, cell_seed
    >>> 0 <= below(cell_seed(0, 0, 1), 5, 7) < 7
    True
    """
    compiled: F = _njit(nogil=True, cache=True, **_LEAN)(function)
    return compiled


def leaf(function: F) -> F:
    """Mark a function as compiled where a kernel calls it; it creates no array, and called from Python it is Python.

    Nothing is compiled for callers it does not have.

    Parameters
    ----------
    function : callable
        As for ``numba.extending.register_jitable``.

    Returns
    -------
    callable
        The function itself.

    Examples
    --------
    >>> from ppdf_dask.filters.ppdf.paper import _growth_kernels
    >>> _growth_kernels._slot(3, -4, False)  # the fourth quadrant
    3
    """
    marked: F = _jitable(error_model="numpy", no_cpython_wrapper=True, **_LEAN)(function)
    return marked
