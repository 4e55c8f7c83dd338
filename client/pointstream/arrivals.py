"""The bytes of one request as they come: which objects in it are complete. Pure."""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from .offers import Item


class Assembly:
    """A range that fills up from its start, and the objects expected in it.

    Parameters
    ----------
    start : int
        Where the range starts in the file.

    Attributes
    ----------
    data : bytearray
        What has come.
    used : int
        Where the last object that was given out ends in the file.
    """

    def __init__(self, start: int, items: Iterable[Item] = ()) -> None:
        self.start = start
        self.data = bytearray()
        self.used = start
        self._expected: list[tuple[int, Item]] = []
        self.expect(items)

    def expect(self, items: Iterable[Item]) -> None:
        """Add objects to wait for; those whose bytes are here are given out by the next `complete`."""
        for item in items:
            heapq.heappush(self._expected, (item.stop, item))

    def feed(self, offset: int, chunk: bytes) -> int:
        """Take a piece; one from an earlier offset takes back what came after it.

        Returns
        -------
        int
            By how many bytes more (or less) of the range is here.
        """
        before = len(self.data)
        del self.data[offset - self.start :]
        self.data += chunk
        return len(self.data) - before

    def rest(self) -> tuple[int, bytes]:
        """Give what has come behind the last object given out, the start of the next one, and where it begins."""
        return self.used, bytes(self.data[self.used - self.start :])

    def complete(self) -> Iterator[tuple[Item, bytes]]:
        """Give out the objects that are complete, each once, in order of place, with their bytes."""
        while self._expected and self._expected[0][0] <= self.start + len(self.data):
            stop, item = heapq.heappop(self._expected)
            self.used = max(self.used, stop)
            yield item, bytes(self.data[item.start - self.start : item.stop - self.start])
