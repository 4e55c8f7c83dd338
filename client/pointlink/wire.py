"""The link model on an event loop, real or virtual: bytes in at one end, the same bytes out at the other, later.

A :class:`Wire` is one direction, shared by all connections; a :class:`Flow` is one connection's bytes in that
direction. One timer a wire and one queue of arrivals keep the bytes in order whatever the loop does with equal
deadlines.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

from pointlink.model import Link, Piece

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from pointlink.profiles import Profile

SMALLEST_WINDOW = 256 * 1024


class End(IntEnum):
    """How a sender stops, the harsher the greater.

    ``HALF`` sends no more and still reads. ``CLOSED`` does not read either; TCP tells the other side so only when it
    sends something, by a reset a moment later, and here the end itself says it. ``RESET`` is no orderly end.
    """

    HALF = 0
    CLOSED = 1
    RESET = 2


class Wire:
    """One direction of a link on a loop's clock.

    Parameters
    ----------
    link
        The model, owned by this wire.
    loop
        Whose ``time()`` and ``call_at()`` are used, and nothing else of it.
    window
        Bytes that one flow may have in the queue, under way and unread by its receiver, as TCP's receive window.
    """

    def __init__(self, link: Link[Flow], loop: asyncio.AbstractEventLoop, *, window: int) -> None:
        self.link = link
        self.window = window
        self._loop = loop
        self._arrivals: deque[tuple[float, Flow | None, bytes, Callable[[], None]]] = deque()
        self._timer: asyncio.TimerHandle | None = None
        self._due = math.inf
        self._now = 0.0

    def offer(self, flow: Flow, size: int) -> None:
        """Let the next ``size`` bytes of a flow's buffer wait for the link."""
        self._enter(self.link.offer(self._time(), flow, size))

    def signal(self, action: Callable[[], None]) -> None:
        """Call ``action`` when a packet without payload that is sent now arrives."""
        now = self._time()
        self._enter(self.link.advance(now))
        self._arrivals.append((self.link.signal(now), None, b"", action))
        self._schedule()

    def _time(self) -> float:
        # A timer may fire a clock tick early, and the model's time never goes back.
        self._now = max(self._now, self._loop.time())
        return self._now

    def _enter(self, pieces: list[Piece[Flow]]) -> None:
        for flow, size, arrival in pieces:
            self._arrivals.append((arrival, flow, flow.leave(size), _nothing))
        for flow in dict.fromkeys(piece.flow for piece in pieces):
            flow.left()
        self._schedule()

    def _schedule(self) -> None:
        room = self.link.next_room
        due = min(self._arrivals[0][0] if self._arrivals else math.inf, math.inf if room is None else room)
        if due == self._due:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._due = due
        self._timer = None if due == math.inf else self._loop.call_at(due, self._run)

    def _run(self) -> None:
        self._now = max(self._now, self._due)
        now = self._time()
        self._timer, self._due = None, math.inf
        self._enter(self.link.advance(now))
        arrivals = self._arrivals
        while arrivals and arrivals[0][0] <= now:
            _, flow, data, action = arrivals.popleft()
            if flow is None:
                action()
                continue
            parts = [data]
            while arrivals and arrivals[0][1] is flow and arrivals[0][0] <= now:
                parts.append(arrivals.popleft()[2])
            flow.arrive(b"".join(parts))
        self._schedule()


def _nothing() -> None:
    return None


class Flow:
    """One connection's bytes in one direction.

    Parameters
    ----------
    wire
        The direction.
    on_data
        Gets the bytes as they arrive at the other end, which says :meth:`consumed` when it has made room for them.
    on_end
        Called after the last byte has arrived, and again if a harsher end follows.
    on_room
        Called when bytes have left the sender's buffer, whose length is :attr:`buffered`.
    """

    def __init__(
        self,
        wire: Wire,
        *,
        on_data: Callable[[bytes], None],
        on_end: Callable[[End], None],
        on_room: Callable[[], None],
    ) -> None:
        self._wire = wire
        self._on_data = on_data
        self._on_end = on_end
        self._on_room = on_room
        self._buffer = bytearray()
        self._offered = 0
        self._unread = 0
        self._ending: End | None = None
        self._ended: End | None = None
        self._dropped = False

    @property
    def buffered(self) -> int:
        """Bytes still on the sender's side of the queue."""
        return len(self._buffer)

    def send(self, data: bytes) -> None:
        """Append bytes to the sender's buffer; none are refused, so look at :attr:`buffered` before sending more."""
        if self._dropped or self._ending is not None:
            return
        self._buffer += data
        self._offer()

    def end(self, how: End) -> None:
        """End the flow after the bytes sent so far; of two ends under way the harsher is the last."""
        if self._ending is None or how > self._ending:
            self._ending = how
            self._end_if_empty()

    def consumed(self, size: int) -> None:
        """Say, at the receiving end, that so many bytes were taken and as many more may come."""
        self._unread -= size
        self._offer()

    def drop(self) -> None:
        """Forget what has not entered the queue and take no more; what is in the queue still takes its time."""
        self._dropped = True
        self._buffer.clear()
        self._offered = 0
        self._wire.link.withdraw(self)
        self._on_room()

    def _offer(self) -> None:
        size = min(len(self._buffer) - self._offered, self._wire.window - self._unread)
        if size > 0:
            self._offered += size
            self._unread += size
            self._wire.offer(self, size)

    def leave(self, size: int) -> bytes:
        """Hand over the next bytes to the wire (called by the wire)."""
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        self._offered -= size
        return data

    def left(self) -> None:
        """Go on after bytes have left the buffer (called by the wire)."""
        self._on_room()
        self._end_if_empty()

    def arrive(self, data: bytes) -> None:
        """Deliver (called by the wire)."""
        self._on_data(data)

    def _end_if_empty(self) -> None:
        how = self._ending
        if how is not None and how is not self._ended and not self._buffer:
            self._ended = how
            self._wire.signal(lambda: self._on_end(how))


@dataclass(frozen=True, slots=True)
class Line:
    """Both directions of a link on one loop."""

    down: Wire
    up: Wire

    @classmethod
    def open(cls, profile: Profile, loop: asyncio.AbstractEventLoop) -> Line:
        """Lay a line of that profile."""
        return cls(*(_wire(rate, profile, loop) for rate in (profile.down_rate, profile.up_rate)))

    def handshake(self, on_syn: Callable[[], None], on_open: Callable[[], None]) -> None:
        """Spend the round trip of a TCP connect: ``on_syn`` at the server, then ``on_open`` at the client."""

        def answer() -> None:
            on_syn()
            self.down.signal(on_open)

        self.up.signal(answer)


def _wire(rate: float | None, profile: Profile, loop: asyncio.AbstractEventLoop) -> Wire:
    under_way = 0 if rate is None else math.ceil(rate / 8.0 * profile.rtt)
    window = max(SMALLEST_WINDOW, 2 * (profile.queue + under_way))
    return Wire(Link(rate=rate, delay=profile.rtt / 2.0, queue=profile.queue), loop, window=window)
