"""A link as simple as can be, without clock or sockets: replies queue up and arrive piece by piece."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

PIECE = 1448


@dataclass
class Fifo:
    """Serve requests in order at `rate` bytes/s after half of `rtt`, with `header` bytes before each body."""

    rate: float
    rtt: float
    header: int = 300
    now: float = 0.0
    _free_at: float = 0.0
    _events: list[tuple[float, int, Callable[[], None]]] = field(default_factory=list)
    _count: int = 0

    def at(self, time: float, act: Callable[[], None]) -> None:
        self._count += 1
        heapq.heappush(self._events, (time, self._count, act))

    def request(self, nbytes: int, piece: Callable[[int, bool], None]) -> None:
        """Ask for a body; `piece(n, last)` is called as its bytes arrive."""

        def serve() -> None:
            self._free_at = max(self._free_at, self.now) + self.header / self.rate
            left = nbytes
            while left > 0:
                size = min(PIECE, left)
                left -= size
                self._free_at += size / self.rate
                self.at(self._free_at + self.rtt / 2, lambda n=size, last=left == 0: piece(n, last))

        self.at(self.now + self.rtt / 2, serve)

    def run(self, until: float) -> None:
        while self._events and self._events[0][0] <= until:
            self.now, _, act = heapq.heappop(self._events)
            act()
        self.now = until
