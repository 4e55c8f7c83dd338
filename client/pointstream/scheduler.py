"""What to ask for now: wants in priority order become byte ranges, bounded by what the link can carry.

Theory
------
LPC 4: "the request queue is traversed in order of priority at the end of the frame, issuing only as many requests as
those allowed by the estimated network bandwidth, and forgetting the rest". A link carries bytes, not requests:

1. *Wants are forgotten.* `offer` replaces all wants that are not in flight. Nothing queues here across a turn of the
   camera.
2. *Neighbours travel together.* A request grows from the most urgent want (the seed) along the file, forward first,
   then backward, over wants of any priority, while the gap between them is cheaper than a request. A request costs
   its headers and, only when less than a round trip of bytes is outstanding, the time in which the link would run
   dry: ``gap <= overhead + max(0, rate * rtt - outstanding)``.
3. *A request is short.* At most ``rate * request_seconds`` bytes, but at least one object, so that urgent ones get
   through between two requests and a lost one costs little. Not shorter either: on 1.25 Mbit/s, 0.1 s at a time, the
   heads of a usual server's replies (370 bytes) take 3% of the line.
4. *The queue in the network is short.* A byte asked for now arrives after everything asked before: an urgent cloud
   waits for ``outstanding / rate``. So outstanding bytes stay within the *window*, the bandwidth-delay product, plus
   one look interval (we look once a frame and whenever an object lands), plus one request. Less would leave the link
   idle. A request waits until all of it fits: sending what fits now would end in requests of one cloud each, all
   headers.
5. *A bucket paces it.* It fills at `gain` times the measured goodput and holds at most one window; a request may
   overdraw it. The window keeps the queue short, the bucket keeps a window that was guessed too large from being
   spent twice. `gain` above 1 lets the estimate grow when the link does.
6. *Slow start.* Before the first measurement there is no bucket, and the window grows by every byte that lands: it
   doubles each round trip from one that suits the prior. Requests grow with it, since only so many fly at a time.
7. *A local file has no link*: a constant window bounds what is in flight, and the layer stops asking while too much
   waits to be decoded.

Everything is an argument: wants, time, and the state of the link. `offer` and `issue` return and do no I/O.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lpc.ranges import ByteRange

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SchedulerOptions:
    """Constants of the schedule.

    Parameters
    ----------
    request_seconds : float
        Length of a request, seconds of the link.
    smallest_request, largest_request : int
        Bounds of that length in bytes.
    overhead : int
        Bytes that a request and its reply cost besides the body.
    look_seconds : float
        Longest time between two looks at the link: a frame.
    gain : float
        Bytes that the bucket gets per byte of measured goodput.
    most_requests : int
        Requests in flight, at most (one connection each).
    most_window : int
        Bytes outstanding, at most, in slow start.
    local_window, local_gap : int
        Bytes in flight, and the widest gap in a merged read, where there is no link.
    most_wants : int
        Wants that are looked at; the rest comes with a later frame.
    """

    request_seconds: float = 0.1
    smallest_request: int = 8192
    largest_request: int = 1 << 19
    overhead: int = 400
    look_seconds: float = 1 / 30
    gain: float = 1.25
    most_requests: int = 8
    most_window: int = 4 << 20
    local_window: int = 1 << 20
    local_gap: int = 4096
    most_wants: int = 2048


class LinkState(NamedTuple):
    """What `Goodput` says at the moment."""

    rate: float
    """Bytes per second that may be spent."""
    rtt: float
    """Seconds."""
    measured: bool
    """False: `rate` is a prior."""


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
    landed: int = 0
    """Bytes that have arrived."""


class Scheduler:
    """Wants in, requests out; see the module's text for the rules.

    States of a key: *wanted* (in the last offer), *in flight* (in a request), forgotten. A key is in flight in at
    most one request.
    """

    def __init__(self, options: SchedulerOptions | None = None) -> None:
        self.options = options or SchedulerOptions()
        self._flying: list[Request] = []
        self._keys: dict[int, Request] = {}
        self._tokens = float("inf")  # a bucket starts full
        self._filled: float | None = None
        self._grown = 0
        self._start: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self._stop = self._key = self._by_rank = self._start
        self._free: NDArray[np.bool_] = np.empty(0, dtype=bool)
        self._cursor = 0

    def __repr__(self) -> str:
        return f"<Scheduler {self.in_flight} requests, {self.outstanding} bytes outstanding, {self.waiting} wants>"

    @property
    def outstanding(self) -> int:
        """Bytes asked for and not here."""
        return sum(request.range.size - request.landed for request in self._flying)

    @property
    def in_flight(self) -> int:
        """Requests in flight."""
        return len(self._flying)

    @property
    def waiting(self) -> int:
        """Wants of the last offer that are not in flight."""
        return int(self._free.sum())

    def flies(self, key: int) -> bool:
        """Whether a key is in flight."""
        return key in self._keys

    def offer(self, keys: NDArray[np.int64], starts: NDArray[np.int64], stops: NDArray[np.int64]) -> None:
        """Replace the wants.

        Parameters
        ----------
        keys, starts, stops : ndarray, (n,) int64
            What is wanted, most urgent first, each once, and where it stands in the file. Keys in flight are skipped.
        """
        flying = np.fromiter(self._keys, dtype=np.int64, count=len(self._keys))
        new = np.flatnonzero(~np.isin(keys, flying))[: self.options.most_wants]
        keys, starts, stops = keys[new], starts[new], stops[new]
        place = np.argsort(starts, kind="stable")
        self._key, self._start, self._stop = keys[place], starts[place], stops[place]
        self._by_rank = np.argsort(place, kind="stable")
        self._free = np.ones(len(place), dtype=bool)
        self._cursor = 0

    def issue(self, now: float, link: LinkState | None) -> list[Request]:
        """Take as many of the wants as may be asked for now.

        Parameters
        ----------
        now : float
            Seconds.
        link : LinkState or None
            None for a local file.
        """
        self._fill_bucket(now, link)
        window, longest = self.window(link), self.longest(link)
        issued: list[Request] = []
        outstanding = self.outstanding
        while len(self._flying) < self.options.most_requests:
            seed = self._next_seed()
            if seed < 0:
                break
            first, last = self._grow(seed, self._widest_gap(link, outstanding), longest)
            request = self._request(first, last)
            if outstanding > 0 and outstanding + request.range.size > window:
                break
            if link is not None and link.measured:
                if self._tokens <= 0:
                    break
                self._tokens -= request.range.size
            self._free[first : last + 1] = False
            self.adopt(request)
            issued.append(request)
            outstanding += request.range.size
        return issued

    def adopt(self, request: Request) -> None:
        """Count a request as in flight (also one that was made elsewhere: the opening probe)."""
        self._flying.append(request)
        for item in request.items:
            self._keys[item.key] = request

    def claim(self, request: Request, items: tuple[Item, ...]) -> None:
        """Name what a request in flight carries, where that is only learned on its way (the opening probe)."""
        request.items += items
        for item in items:
            self._keys[item.key] = request

    def landed(self, request: Request, nbytes: int) -> None:
        """Note that more of a request has arrived (or, below 0, that a reply started again)."""
        request.landed = min(request.range.size, max(0, request.landed + nbytes))
        self._grown += max(0, nbytes)

    def ended(self, request: Request) -> None:
        """Note that a request is over, whole or not; what it did not deliver may be wanted again."""
        self._flying.remove(request)
        for item in request.items:
            if self._keys.get(item.key) is request:
                del self._keys[item.key]

    def longest(self, link: LinkState | None) -> int:
        """Bytes of a request, at most, unless one object is longer."""
        if link is None:
            return self.options.local_window // 4
        length = int(link.rate * self.options.request_seconds)
        if not link.measured:
            length += self._grown // self.options.most_requests
        return min(max(length, self.options.smallest_request), self.options.largest_request)

    def window(self, link: LinkState | None) -> int:
        """Bytes outstanding, at most."""
        if link is None:
            return self.options.local_window
        flight = int(link.rate * (link.rtt + self.options.look_seconds))
        if link.measured:
            return flight + self.longest(link)
        return min(flight + self._grown, self.options.most_window) + self.longest(link)

    def _widest_gap(self, link: LinkState | None, outstanding: int) -> int:
        if link is None:
            return self.options.local_gap
        return self.options.overhead + max(0, int(link.rate * link.rtt) - outstanding)

    def _fill_bucket(self, now: float, link: LinkState | None) -> None:
        passed = 0.0 if self._filled is None else max(0.0, now - self._filled)
        self._filled = now
        if link is not None:
            capacity = float(self.window(link))
            self._tokens = min(capacity, self._tokens + passed * link.rate * self.options.gain)

    def _next_seed(self) -> int:
        """Place of the most urgent want that is still free, or -1."""
        while self._cursor < len(self._by_rank):
            place = int(self._by_rank[self._cursor])
            if self._free[place]:
                return place
            self._cursor += 1
        return -1

    def _grow(self, seed: int, gap: int, longest: int) -> tuple[int, int]:
        """First and last place of the request around a seed (rules 2 and 3)."""
        first = last = seed
        start, stop = int(self._start[seed]), int(self._stop[seed])
        while last + 1 < len(self._free) and self._free[last + 1]:
            near, far = int(self._start[last + 1]), int(self._stop[last + 1])
            if near - stop > gap or far - start > longest:
                break
            last, stop = last + 1, far
        while first > 0 and self._free[first - 1]:
            near, far = int(self._stop[first - 1]), int(self._start[first - 1])
            if start - near > gap or stop - far > longest:
                break
            first, start = first - 1, far
        return first, last

    def _request(self, first: int, last: int) -> Request:
        items = tuple(
            Item(int(self._key[place]), int(self._start[place]), int(self._stop[place]))
            for place in range(first, last + 1)
        )
        return Request(ByteRange(items[0].start, items[-1].stop), items)
