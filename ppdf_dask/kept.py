"""What the tiler keeps of each point for the merge, so that a file is decoded once: labels and owners, no places.

Per batch one array of bytes, (5, n): returns, scanner channel, class, and in two bytes the number of the chunk that
owns the point, counted from 1 in the batch's own list; 0 for points the filter does not see. They pack to less than a
byte a point.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from ppdf_dask.reader import Labels
from ppdf_dask.relabel import CHANNEL
from ppdf_dask.store import RunStore

Groups = list[tuple[str, npt.NDArray[np.int64]]]
"""Chunk id to the points it owns, as ascending numbers among the eligible ones of a batch."""

MOST_OWNERS = (1 << 16) - 1


def keep_labels(store: RunStore, source: str, number: int, labels: Labels, groups: Groups) -> bool:
    """Keep a batch; tell whether that is possible: it is not when too many chunks own its points."""
    if len(groups) > MOST_OWNERS:
        return False
    owner = np.zeros(int(labels.eligible.sum()), np.uint16)
    for k, (_, index) in enumerate(groups):
        owner[index] = k + 1
    rows = np.zeros((5, labels.n), np.uint8)
    rows[0], rows[1], rows[2] = labels.returns, labels.flags & CHANNEL, labels.classification
    rows[3, labels.eligible], rows[4, labels.eligible] = owner & 0xFF, owner >> 8
    store.write_labels(source, number, rows, [chunk for chunk, _ in groups])
    return True


def kept_labels(store: RunStore, source: str, count: int, made_by: str) -> Iterator[tuple[Labels, Groups]]:
    """Read what was kept of a file, batch by batch.

    Raises
    ------
    DamagedError
        When a batch is missing or not what it was.
    """
    for number in range(count):
        rows, chunks = store.read_labels(source, number, made_by)
        owner = rows[3].astype(np.uint16) | rows[4].astype(np.uint16) << 8
        eligible = owner > 0
        owner = owner[eligible]
        # NumPy sorts 16-bit keys by counting.
        order = np.argsort(owner, kind="stable")
        cuts = np.searchsorted(owner[order], np.arange(1, len(chunks) + 2))
        groups = [(chunk, order[cuts[k] : cuts[k + 1]]) for k, chunk in enumerate(chunks)]
        yield Labels(rows[0], rows[1], rows[2], eligible), groups
