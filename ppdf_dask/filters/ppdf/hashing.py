"""Random numbers without a state: a hash of a place, so that they are the same on every worker and in every order.

The generator is SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014): the
k-th number of a seed is the mix of ``seed + k * GOLDEN``, modulo 2**64.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ppdf_dask.filters.ppdf.compiled import kernel

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_M1 = np.uint64(0xBF58476D1CE4E5B9)
_M2 = np.uint64(0x94D049BB133111EB)
_S27, _S30, _S31, _S32 = np.uint64(27), np.uint64(30), np.uint64(31), np.uint64(32)


@kernel
def mix(value: Any) -> Any:
    """Scramble 64 bits (SplitMix64's finalizer).

    Parameters
    ----------
    value : uint64
        Any value.

    Returns
    -------
    uint64
        A bijective scramble of `value`.

    Examples
    --------
    >>> int(mix(np.uint64(0x9E3779B97F4A7C15)))  # the first number of seed 0 in the reference implementation
    16294208416658607535
    """
    v = np.uint64(value)
    v = (v ^ (v >> _S30)) * _M1
    v = (v ^ (v >> _S27)) * _M2
    return v ^ (v >> _S31)


@kernel
def cell_seed(ix: Any, iy: Any, size: Any) -> Any:
    """Return the seed that belongs to a square cell.

    Parameters
    ----------
    ix, iy : int64
        Address of the cell on an absolute grid.
    size : int64
        Its edge, in any unit that is the same for all workers.

    Returns
    -------
    uint64
        Different for different (`ix`, `iy`, `size`), negative addresses included.

    Examples
    --------
    >>> int(cell_seed(3, -7, 10_000)) == int(cell_seed(3, -7, 10_000))
    True
    >>> int(cell_seed(3, -7, 10_000)) == int(cell_seed(-7, 3, 10_000))
    False
    """
    seed = mix(np.uint64(size) + GOLDEN)
    seed = mix(seed ^ np.uint64(ix))
    return mix(seed + GOLDEN ^ np.uint64(iy))


@kernel
def below(seed: Any, k: Any, n: Any) -> Any:
    """Draw the `k`-th number of a seed, an integer from 0 to `n` - 1.

    Parameters
    ----------
    seed : uint64
        From `cell_seed`.
    k : int64
        Which number of the sequence, from 0.
    n : int64
        Exclusive upper bound, below 2**32.

    Returns
    -------
    int64
        Uniform but for a bias below n / 2**32.

    Examples
    --------
    >>> seed = cell_seed(0, 0, 1)
    >>> all(0 <= below(seed, k, 7) < 7 for k in range(100))
    True
    """
    drawn = mix(np.uint64(seed) + (np.uint64(k) + np.uint64(1)) * GOLDEN)
    return np.int64(((drawn >> _S32) * np.uint64(n)) >> _S32)
