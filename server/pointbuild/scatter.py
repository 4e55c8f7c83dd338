"""Pass 2: every sample to its bucket's region of one file, and the first candidates for the upper tree.

Threads sort blocks by bucket and write them. Places are given out in the order of the blocks, so that of a block's rows
is known from the counts of those before it, and a build that was killed can go on with the next. Nothing else depends
on that place.
"""

from __future__ import annotations

import os
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from .extend import OWNER
from .rows import as_words, fill_rows, in_chunks, priorities_of
from .spool import Block, Spool, read_all, write_all

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from lpc.attributes import Schema

    from .frame import Frame
    from .plan import Plan


_PIECE = 1 << 20


@dataclass(frozen=True, slots=True)
class Candidates:
    """Samples that may belong to the upper tree: their priorities and buckets, one entry a sample."""

    priority: NDArray[np.uint64]
    bucket: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Scattered:
    """A block's rows sorted by bucket, how many each bucket gets, and its candidates."""

    rows: NDArray[Any]
    counts: NDArray[np.int64]
    candidates: Candidates


class Regions:
    """All rows: bucket b is the rows ``first[b]`` to ``first[b + 1]``.

    As they are scattered they stand in one file, the last bucket first; as they are sorted in another, the first bucket
    first. So one is cut off at its end while the other grows.

    Parameters
    ----------
    path : Path
        Of the first file; both are created if they are not there. Removing them is the owner's part.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.dtype: np.dtype[Any] = np.dtype([])
        self.first = np.zeros(1, np.int64)
        self._places = self._filled = np.zeros(0, np.int64)
        self._file, self._sorted = (
            os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600) for file in (path, self._path_of_sorted)
        )

    @property
    def _path_of_sorted(self) -> Path:
        return self.path.with_name(f"{self.path.name}-sorted")

    def lay_out(self, dtype: np.dtype[Any], counts: list[int]) -> None:
        """Say what rows are and how many each bucket will have."""
        self.dtype = dtype
        self.first = np.concatenate([[0], np.cumsum(counts)])
        self._places = self.first[-1] - self.first[1:]
        self._filled = np.zeros(len(counts), np.int64)

    def skip(self, counts: NDArray[np.int64]) -> None:
        """Pass over rows that were appended before."""
        self._filled += counts

    def reserve(self, counts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Give the next free place in the file of each bucket, where `counts` rows go."""
        places = self._places + self._filled
        self.skip(counts)
        return places

    def place(self, sorted_rows: NDArray[Any], counts: NDArray[np.int64], places: NDArray[np.int64]) -> None:
        """Write rows that are sorted by bucket, `counts` of each, where `reserve` said."""
        begin = 0
        for bucket in np.flatnonzero(counts):
            end = begin + int(counts[bucket])
            write_all(self._file, sorted_rows[begin:end], int(places[bucket]) * self.dtype.itemsize)
            begin = end

    def replace(self, row: int, rows: NDArray[Any]) -> None:
        """Put all rows of a bucket, which begins at number `row`, in another order; any thread may."""
        write_all(self._sorted, rows, row * self.dtype.itemsize)

    @contextmanager
    def rewriting(self, row: int) -> Iterator[int]:
        """Do so with a file that they are to be written to."""
        with tempfile.TemporaryFile(dir=self.path.parent) as file:
            yield file.fileno()
            at = 0
            while piece := os.pread(file.fileno(), _PIECE, at):
                write_all(self._sorted, np.frombuffer(piece, np.uint8), row * self.dtype.itemsize + at)
                at += len(piece)

    def settle(self, bucket: int) -> None:
        """Give back the room of the scattered rows of buckets up to this one; they cannot be read again."""
        os.truncate(self._file, int(self._places[bucket]) * self.dtype.itemsize)

    def read(self, row: int, out: NDArray[Any]) -> None:
        """Fill `out` with rows from number `row` on, all of one bucket, as they were scattered."""
        bucket = int(np.searchsorted(self.first, row, side="right")) - 1
        read_all(self._file, out, int(self._places[bucket] + row - self.first[bucket]) * self.dtype.itemsize)

    def chunks(self, row: int, count: int, most: int) -> Iterator[NDArray[Any]]:
        """Yield `count` rows from number `row` on, all of one bucket, at most `most` at a time."""
        return in_chunks(self, row, count, most)

    def replaced(self) -> SortedRegions:
        """Give the rows as they were replaced."""
        return SortedRegions(self, self._sorted)

    def remove(self) -> None:
        """Remove the files."""
        self.close()
        self.path.unlink()
        self._path_of_sorted.unlink()

    def close(self) -> None:
        """Close the files; twice is fine."""
        if self._file >= 0:
            os.close(self._file)
            os.close(self._sorted)
            self._file = -1


class SortedRegions:
    """Rows of `regions` as they were replaced, in the file `sorted_file`."""

    def __init__(self, regions: Regions, sorted_file: int) -> None:
        self.dtype, self.first = regions.dtype, regions.first
        self.replace, self.rewriting, self.settle = regions.replace, regions.rewriting, regions.settle
        self.remove = regions.remove
        self._file = sorted_file

    def read(self, row: int, out: NDArray[Any]) -> None:
        """Fill `out` with rows from number `row` on."""
        read_all(self._file, out, row * self.dtype.itemsize)

    def chunks(self, row: int, count: int, most: int) -> Iterator[NDArray[Any]]:
        """Yield `count` rows from number `row` on, at most `most` at a time."""
        return in_chunks(self, row, count, most)

    def replaced(self) -> SortedRegions:
        """They are."""
        return self


def scatter(
    block: Block,
    spool: Spool,
    frame: Frame,
    plan: Plan,
    limits: NDArray[np.uint64],
    seed: int,
    schema: Schema,
    dtype: np.dtype[Any],
) -> Scattered:
    """Sort one block by bucket.

    Parameters
    ----------
    block, spool
        What to read.
    frame, plan
        Where samples belong.
    limits : ndarray, (buckets,) uint64
        Priorities up to these are candidates.
    seed : int
        Of the priorities.
    schema, dtype
        What rows hold and look like.
    """
    values = spool.read(block, ("xyz", OWNER, *(attribute.name for attribute in schema)))
    places = frame.places(values["xyz"])
    rows = fill_rows(dtype, places, values, schema)
    if len(plan.buckets) == 1:
        return Scattered(rows, np.array([block.samples]), Candidates(np.empty(0, np.uint64), np.empty(0, np.int32)))
    bucket, priority = plan.locate(frame.cells, places), priorities_of(rows, seed)
    counts = np.bincount(bucket, minlength=len(plan.buckets))
    out = np.empty_like(rows)
    _sort_rows(as_words(rows), bucket, np.cumsum(counts) - counts, as_words(out))
    chosen = priority <= limits[bucket]
    return Scattered(out, counts, Candidates(priority[chosen], bucket[chosen]))


def gather(regions: Regions, limits: NDArray[np.uint64], seed: int, chunk: int) -> Candidates:
    """Candidates once more from the rows as they were scattered, `chunk` at a time: the limits were too low."""
    priority, bucket = [np.empty(0, np.uint64)], [np.empty(0, np.int32)]
    for number, limit in enumerate(limits):
        for rows in regions.chunks(int(regions.first[number]), int(np.diff(regions.first)[number]), chunk):
            found = priorities_of(rows, seed)
            priority.append(found[found <= limit])
            bucket.append(np.full(len(priority[-1]), number, np.int32))
    return Candidates(np.concatenate(priority), np.concatenate(bucket))


@njit(cache=True, nogil=True)
def _sort_rows(rows: Any, bucket: Any, place: Any, out: Any) -> None:
    """Sort by counting: `place` is where each bucket's rows begin in `out`, and is used up."""
    words = rows.shape[1]
    for i in range(len(rows)):
        at = place[bucket[i]]
        place[bucket[i]] = at + 1
        for word in range(words):
            out[at, word] = rows[i, word]
