"""One direction of a link, pure: which bytes arrive when. No clock, no sockets, no event loop.

Senders stand in front of a bottleneck with a bounded first-in first-out queue, as in front of a modem::

    flow a: bytes waiting ─┐ one piece each, in turn
    flow b: bytes waiting ─┼──▶ queue, at most `queue` bytes ──▶ rate ──▶ delay ──▶ arrival
    flow c: bytes waiting ─┘

A piece is at most one TCP segment of payload. It leaves the bottleneck at ``finish = max(finish before it, now) + size
/ rate`` and arrives at ``finish + delay``: no token bucket and so no burst, no drift. Flows with bytes waiting enter
the queue in turn, so none starves; what is in the queue already stays in front of whoever comes later, so an urgent
byte waits ``queue / rate``.

The caller says what time it is. Calling late changes nothing: pieces enter when there was room, not when somebody
looked.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from typing import Generic, NamedTuple, TypeVar

F = TypeVar("F", bound=Hashable)

SEGMENT = 1448
"""TCP payload bytes of a full Ethernet frame (1500 less 40 of headers and 12 of time stamps)."""

SHORTEST_PIECE = 1e-4
"""Seconds. Above 116 Mbit/s a piece is this much of the link, as network cards offload segments in batches."""

UNLIMITED_PIECE = 64 * 1024
"""Bytes of a piece where there is no rate."""


class Piece(NamedTuple, Generic[F]):
    """Bytes of one flow that have entered the queue.

    Attributes
    ----------
    flow
        Whose bytes.
    size
        How many.
    arrival
        When the last of them reaches the other end, seconds.
    """

    flow: F
    size: int
    arrival: float


class Link(Generic[F]):
    """One direction of a link, shared by all its flows.

    Parameters
    ----------
    rate
        Bits per second of payload; None: no limit.
    delay
        Seconds from leaving the bottleneck to arriving.
    queue
        Bytes that may stand before the bottleneck; a single piece always may.

    Attributes
    ----------
    carried
        Payload bytes that have entered so far.
    windows
        Times ``(start, stop)`` in which the bottleneck carried bytes, merged where they touch; empty for a link without
        limit.
    piece
        The largest piece in bytes.
    """

    def __init__(self, *, rate: float | None, delay: float, queue: int) -> None:
        self.rate = rate
        self.delay = delay
        self.queue = queue
        self.piece = UNLIMITED_PIECE if rate is None else max(SEGMENT, round(rate / 8.0 * SHORTEST_PIECE))
        self.carried = 0
        self.windows: list[tuple[float, float]] = []
        self._seconds_per_byte = 0.0 if rate is None else 8.0 / rate
        self._finish = 0.0
        self._clock = 0.0
        self._waiting: dict[F, int] = {}
        self._turns: deque[F] = deque()
        self._queue: deque[tuple[float, int]] = deque()
        self._queued = 0

    def offer(self, now: float, flow: F, size: int) -> list[Piece[F]]:
        """Let ``size`` more bytes of a flow wait; return the pieces that have entered the queue up to ``now``."""
        pieces = self.advance(now)
        if size > 0:
            if flow not in self._waiting:
                self._turns.append(flow)
            self._waiting[flow] = self._waiting.get(flow, 0) + size
            pieces += self.advance(now)
        return pieces

    def advance(self, now: float) -> list[Piece[F]]:
        """Let time pass; return the pieces that have entered the queue since the last call, in order of arrival."""
        pieces: list[Piece[F]] = []
        while self._turns:
            flow = self._turns[0]
            size = min(self.piece, self._waiting[flow])
            while self._queue and self._queue[0][0] <= self._clock:
                self._queued -= self._queue.popleft()[1]
            if self._queue and self._queued + size > self.queue:
                room = self._queue[0][0]
                if room > now:
                    break
                self._clock = room
                continue
            self._turns.popleft()
            if size < self._waiting[flow]:
                self._waiting[flow] -= size
                self._turns.append(flow)
            else:
                del self._waiting[flow]
            pieces.append(Piece(flow, size, self._enter(size)))
        self._clock = max(self._clock, now)
        return pieces

    def signal(self, now: float) -> float:
        """Return when a packet without payload (SYN, FIN, RST) that enters now arrives: it queues like any other."""
        return max(self._finish, self._clock, now) + self.delay

    def withdraw(self, flow: F) -> int:
        """Take back the bytes of a flow that have not entered the queue; return how many."""
        if flow not in self._waiting:
            return 0
        self._turns.remove(flow)
        return self._waiting.pop(flow)

    @property
    def next_room(self) -> float | None:
        """When a waiting piece may next enter, seconds; None while nothing waits."""
        return self._queue[0][0] if self._turns and self._queue else None

    def busy(self, start: float, stop: float) -> float:
        """Return the seconds between two times in which the bottleneck carried bytes: ``rate / 8`` of them a second."""
        return sum(max(0.0, min(stop, b) - max(start, a)) for a, b in self.windows)

    def _enter(self, size: int) -> float:
        start = max(self._finish, self._clock)
        self._finish = start + size * self._seconds_per_byte
        self._queue.append((self._finish, size))
        self._queued += size
        self.carried += size
        if self.rate is not None:
            if self.windows and self.windows[-1][1] == start:
                start = self.windows.pop()[0]
            self.windows.append((start, self._finish))
        return self._finish + self.delay
