"""Pass 2: every sample to its bucket's region of one file, and the first candidates for the upper tree.

Threads sort blocks by bucket and write them. Places are given out in the order of the blocks, so that of a block's rows
is known from the counts of those before it, and a build that was killed can go on with the next. Nothing else depends
on that place.
"""

from __future__ import annotations

import os
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from .extend import OWNER
from .rows import as_words, fill_rows
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
    """The file of all rows: bucket b is the rows ``first[b]`` to ``first[b + 1]``.

    Parameters
    ----------
    path : Path
        Is created if it is not there; removing it is the owner's part.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.dtype: np.dtype[Any] = np.dtype([])
        self.first = np.zeros(1, np.int64)
        self._filled = np.zeros(0, np.int64)
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)

    def lay_out(self, dtype: np.dtype[Any], counts: list[int]) -> None:
        """Say what rows are and how many each bucket will have."""
        self.dtype = dtype
        self.first = np.concatenate([[0], np.cumsum(counts)])
        self._filled = np.zeros(len(counts), np.int64)

    def skip(self, counts: NDArray[np.int64]) -> None:
        """Pass over rows that were appended before."""
        self._filled += counts

    def reserve(self, counts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Give the number of the next free row of each bucket, of which `counts` are taken."""
        places = self.first[:-1] + self._filled
        self.skip(counts)
        return places

    def place(self, sorted_rows: NDArray[Any], counts: NDArray[np.int64], places: NDArray[np.int64]) -> None:
        """Write rows that are sorted by bucket, `counts` of each, where `reserve` said."""
        begin = 0
        for bucket in np.flatnonzero(counts):
            end = begin + int(counts[bucket])
            self.write(int(places[bucket]), sorted_rows[begin:end])
            begin = end

    def write(self, row: int, rows: NDArray[Any]) -> None:
        """Overwrite rows from number `row` on."""
        write_all(self._file, rows, row * self.dtype.itemsize)

    @contextmanager
    def rewriting(self, row: int) -> Iterator[int]:
        """Give a file for rows that are to stand from number `row` on; any thread may.

        It stays until `settle` is called or `restore` finds it: no sample is lost if the build is killed meanwhile.
        """
        part, whole = (self.path.with_name(f"{self.path.name}-{row}.{state}") for state in ("part", "whole"))
        file = os.open(part, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        try:
            yield file
            part.rename(whole)
            self._copy(file, row * self.dtype.itemsize)
        finally:
            os.close(file)

    def settle(self, row: int) -> None:
        """Rows that were replaced will not be asked for again as they were."""
        self.path.with_name(f"{self.path.name}-{row}.whole").unlink()

    def restore(self) -> None:
        """Finish what `replace` may have begun when the build was killed: the order of the rows may have changed."""
        for part in self.path.parent.glob(f"{self.path.name}-*.part"):
            part.unlink()
        for whole in self.path.parent.glob(f"{self.path.name}-*.whole"):
            file = os.open(whole, os.O_RDONLY)
            self._copy(file, int(whole.stem.rpartition("-")[2]) * self.dtype.itemsize)
            os.close(file)
            whole.unlink()

    def _copy(self, file: int, offset: int) -> None:
        at = 0
        while piece := os.pread(file, _PIECE, at):
            write_all(self._file, np.frombuffer(piece, np.uint8), offset + at)
            at += len(piece)

    def read(self, row: int, out: NDArray[Any]) -> None:
        """Fill `out` with rows from number `row` on."""
        read_all(self._file, out, row * self.dtype.itemsize)

    def chunks(self, row: int, count: int, most: int) -> Iterator[NDArray[Any]]:
        """Yield `count` rows from number `row` on, at most `most` at a time."""
        for at in range(row, row + count, most):
            out = np.empty(min(most, row + count - at), self.dtype)
            self.read(at, out)
            yield out

    def replaced(self) -> Regions:
        """Give the rows after every bucket was replaced: they are at the same place."""
        return self

    def cut(self, bucket: int) -> None:
        """Give back the room of a bucket and of all after it; they cannot be read again."""
        os.truncate(self._file, int(self.first[bucket]) * self.dtype.itemsize)

    def remove(self) -> None:
        """Remove the file."""
        self.close()
        self.path.unlink()

    def close(self) -> None:
        """Close the file; twice is fine."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


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
    rows = fill_rows(dtype, places, values, schema, seed)
    if len(plan.buckets) == 1:
        return Scattered(rows, np.array([block.samples]), Candidates(np.empty(0, np.uint64), np.empty(0, np.int32)))
    bucket, priority = plan.locate(frame.cells, places), rows["priority"]
    counts = np.bincount(bucket, minlength=len(plan.buckets))
    out = np.empty_like(rows)
    _sort_rows(as_words(rows), bucket, np.cumsum(counts) - counts, as_words(out))
    chosen = priority <= limits[bucket]
    return Scattered(out, counts, Candidates(priority[chosen], bucket[chosen]))


def gather(regions: Regions, limits: NDArray[np.uint64], chunk: int) -> Candidates:
    """Candidates once more from the rows as they were scattered, `chunk` at a time: the limits were too low."""
    priority, bucket = [np.empty(0, np.uint64)], [np.empty(0, np.int32)]
    for number, limit in enumerate(limits):
        for rows in regions.chunks(int(regions.first[number]), int(np.diff(regions.first)[number]), chunk):
            chosen = rows["priority"][rows["priority"] <= limit]
            priority.append(chosen)
            bucket.append(np.full(len(chosen), number, np.int32))
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
