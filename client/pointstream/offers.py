"""Objects that may be asked for, by place in the file and by rank, and the requests that grow over them. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lpc.ranges import ByteRange

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Keys = NDArray[np.int64]


class Item(NamedTuple):
    """A cloud or a page inside a request."""

    key: int
    start: int
    stop: int


@dataclass(slots=True, eq=False)
class Request:
    """One byte range in flight."""

    range: ByteRange
    items: tuple[Item, ...]
    """In order of place in the file."""
    ahead: bool = False
    """No frame wanted any of it when it was asked for."""
    landed: int = 0
    """Bytes that have arrived."""
    held: int = 0
    """Bytes of its beginning that were here before."""

    @property
    def outstanding(self) -> int:
        """Bytes that have not arrived."""
        return self.range.size - self.landed

    def brings(self, item: Item) -> int:
        """Bytes of an item that were not here before."""
        return item.stop - max(item.start, self.range.start + self.held)


class Offer:
    """What may be asked for.

    Parameters
    ----------
    keys, starts, stops : ndarray, (n,) int64
        Most urgent first, each once, and where it stands in the file.
    alone : frozenset of int
        Keys around which no request grows.
    """

    def __init__(self, keys: Keys, starts: Keys, stops: Keys, *, alone: frozenset[int] = frozenset()) -> None:
        place = np.argsort(starts, kind="stable")
        self._key, self._start, self._stop = keys[place], starts[place], stops[place]
        self._by_rank = np.argsort(place, kind="stable")
        self._turn = np.concatenate([[0], np.cumsum(stops - starts)])[:-1][place]  # bytes more urgent
        self._free = np.ones(len(place), dtype=bool)
        self._alone = alone
        self._cursor = 0

    @classmethod
    def nothing(cls) -> Offer:
        """Return an empty one."""
        empty = np.empty(0, dtype=np.int64)
        return cls(empty, empty, empty)

    @property
    def waiting(self) -> int:
        """Objects that no request has taken."""
        return int(self._free.sum())

    def holds(self, keys: Keys) -> NDArray[np.bool_]:
        """Which of some keys are in it, taken or not."""
        return np.isin(keys, self._key)

    def withdraw(self, keys: Keys) -> None:
        """Take objects out."""
        self._free &= ~np.isin(self._key, keys)

    def next_seed(self) -> int:
        """Place of the most urgent object that is still free, or -1."""
        while self._cursor < len(self._by_rank):
            place = int(self._by_rank[self._cursor])
            if self._free[place]:
                return place
            self._cursor += 1
        return -1

    def grow(self, seed: int, gap: int, longest: int, reach: float = math.inf) -> tuple[int, int]:
        """First and last place of the request around a seed: forward first, then backward.

        Parameters
        ----------
        gap : int
            Bytes between two neighbours, at most.
        longest : int
            Bytes of the request, at most, unless the seed is longer.
        reach : float
            Bytes that are less urgent than the seed and more so than what comes along, at most.
        """
        turn = float(self._turn[seed]) + reach
        first = last = seed
        start, stop = int(self._start[seed]), int(self._stop[seed])
        if self._alone and int(self._key[seed]) in self._alone:
            return first, last
        while last + 1 < len(self._free) and self._free[last + 1]:
            near, far = int(self._start[last + 1]), int(self._stop[last + 1])
            if near - stop > gap or far - start > longest or self._turn[last + 1] > turn:
                break
            last, stop = last + 1, far
        while first > 0 and self._free[first - 1]:
            near, far = int(self._stop[first - 1]), int(self._start[first - 1])
            if start - near > gap or stop - far > longest or self._turn[first - 1] > turn:
                break
            first, start = first - 1, far
        return first, last

    def request(self, first: int, last: int, *, ahead: bool = False) -> Request:
        """Return the request from one place to another."""
        items = tuple(
            Item(int(self._key[place]), int(self._start[place]), int(self._stop[place]))
            for place in range(first, last + 1)
        )
        return Request(ByteRange(items[0].start, items[-1].stop), items, ahead)

    def take(self, first: int, last: int) -> None:
        """Note that a request is made of these places."""
        self._free[first : last + 1] = False
