"""Pass 2: every sample to its bucket's region of one file, and the first candidates for the upper tree.

The place of a row inside its region depends on which thread came first; nothing later depends on that place.
"""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from .priority import priorities
from .rows import as_words, fill_rows
from .spool import Block, Spool, read_all, write_all

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from lpc.attributes import Schema

    from .cells import Cells
    from .plan import Plan


@dataclass(frozen=True, slots=True)
class Candidates:
    """Samples that may belong to the upper tree: their priorities and buckets, one entry a sample."""

    priority: NDArray[np.uint64]
    bucket: NDArray[np.int32]


class Regions:
    """The file of all rows: bucket b is the rows ``first[b]`` to ``first[b + 1]``.

    Parameters
    ----------
    path : Path
        Is created; removing it is the owner's part.
    """

    def __init__(self, path: Path) -> None:
        self.dtype: np.dtype[Any] = np.dtype([])
        self.first = np.zeros(1, np.int64)
        self._filled = np.zeros(0, np.int64)
        self._lock = threading.Lock()
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)

    def lay_out(self, dtype: np.dtype[Any], counts: list[int]) -> None:
        """Say what rows are and how many each bucket will have; what was appended is forgotten."""
        self.dtype = dtype
        self.first = np.concatenate([[0], np.cumsum(counts)])
        self._filled = np.zeros(len(counts), np.int64)

    def append(self, sorted_rows: NDArray[Any], counts: NDArray[np.int64]) -> None:
        """Add rows that are sorted by bucket, `counts` of each; any thread may."""
        with self._lock:
            at = self.first[:-1] + self._filled
            self._filled += counts
        begin = 0
        for bucket in np.flatnonzero(counts):
            end = begin + int(counts[bucket])
            self.write(int(at[bucket]), sorted_rows[begin:end])
            begin = end

    def write(self, row: int, rows: NDArray[Any]) -> None:
        """Overwrite rows from number `row` on."""
        write_all(self._file, rows, row * self.dtype.itemsize)

    def read(self, row: int, out: NDArray[Any]) -> None:
        """Fill `out` with rows from number `row` on."""
        read_all(self._file, out, row * self.dtype.itemsize)

    def close(self) -> None:
        """Close the file; twice is fine."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def scatter(
    block: Block,
    spool: Spool,
    cells: Cells,
    plan: Plan,
    limits: NDArray[np.uint64],
    seed: int,
    schema: Schema,
    regions: Regions,
) -> Candidates:
    """Move one block to the buckets' regions.

    Parameters
    ----------
    block, spool
        What to read.
    cells, plan
        Where samples belong.
    limits : ndarray, (buckets,) uint64
        Priorities up to these are candidates.
    seed : int
        Of the priorities.
    schema, regions
        What rows look like and where they go.
    """
    values = spool.read(block, ("xyz", *(attribute.name for attribute in schema)))
    priority = priorities(block.first, block.samples, seed)
    rows = fill_rows(regions.dtype, values, priority, schema)
    bucket = plan.locate(cells, values["xyz"])
    if len(plan.buckets) == 1:
        regions.append(rows, np.array([block.samples]))
        return Candidates(np.empty(0, np.uint64), np.empty(0, np.int32))
    counts = np.bincount(bucket, minlength=len(plan.buckets))
    out = np.empty_like(rows)
    _sort_rows(as_words(rows), bucket, np.cumsum(counts) - counts, as_words(out))
    regions.append(out, counts)
    chosen = priority <= limits[bucket]
    return Candidates(priority[chosen], bucket[chosen])


@njit(cache=True, nogil=True)
def _sort_rows(rows: Any, bucket: Any, place: Any, out: Any) -> None:
    """Sort by counting: `place` is where each bucket's rows begin in `out`, and is used up."""
    words = rows.shape[1]
    for i in range(len(rows)):
        at = place[bucket[i]]
        place[bucket[i]] = at + 1
        for word in range(words):
            out[at, word] = rows[i, word]
