"""Which bytes of a file are here: a set of byte ranges. Pure."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from typing import TYPE_CHECKING

import numpy as np

from lpc.ranges import ByteRange

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


class Presence:
    """Disjoint ranges in order; those that touch are one."""

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._stops: list[int] = []
        self._arrays: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None
        self.total = 0
        """Bytes in all ranges."""

    def __repr__(self) -> str:
        return f"<Presence of {self.total} bytes in {len(self)} ranges>"

    def __len__(self) -> int:
        return len(self._starts)

    def __iter__(self) -> Iterator[ByteRange]:
        return (ByteRange(start, stop) for start, stop in zip(self._starts, self._stops, strict=True))

    def __contains__(self, place: ByteRange) -> bool:
        number = bisect_right(self._starts, place.start) - 1
        return number >= 0 and place.stop <= self._stops[number]

    def add(self, place: ByteRange) -> None:
        """Add a range."""
        first, last = bisect_left(self._stops, place.start), bisect_right(self._starts, place.stop)
        start, stop = place.start, place.stop
        if first < last:
            start, stop = min(start, self._starts[first]), max(stop, self._stops[last - 1])
        self._replace(first, last, [start], [stop])

    def remove(self, place: ByteRange) -> None:
        """Remove a range."""
        first, last = bisect_right(self._stops, place.start), bisect_left(self._starts, place.stop)
        if first >= last:
            return
        left, right = (self._starts[first], place.start), (place.stop, self._stops[last - 1])
        rest = [(start, stop) for start, stop in (left, right) if start < stop]
        self._replace(first, last, [start for start, _ in rest], [stop for _, stop in rest])

    def holds(self, starts: NDArray[np.int64], stops: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of n ranges are wholly here: (n,) bool."""
        if not self._starts:
            return np.zeros(len(starts), dtype=bool)
        if self._arrays is None:
            self._arrays = np.array(self._starts, dtype=np.int64), np.array(self._stops, dtype=np.int64)
        here_starts, here_stops = self._arrays
        number = np.searchsorted(here_starts, starts, side="right") - 1
        return (number >= 0) & (stops <= here_stops[np.maximum(number, 0)])

    def missing(self, place: ByteRange) -> list[ByteRange]:
        """Return the parts of a range that are not here, in order."""
        gaps, offset = [], place.start
        for number in range(bisect_right(self._stops, place.start), bisect_left(self._starts, place.stop)):
            if offset < self._starts[number]:
                gaps.append(ByteRange(offset, self._starts[number]))
            offset = max(offset, self._stops[number])
        if offset < place.stop:
            gaps.append(ByteRange(offset, place.stop))
        return gaps

    def _replace(self, first: int, last: int, starts: list[int], stops: list[int]) -> None:
        before = sum(self._stops[first:last]) - sum(self._starts[first:last])
        self._starts[first:last], self._stops[first:last] = starts, stops
        self.total += sum(stops) - sum(starts) - before
        self._arrays = None
