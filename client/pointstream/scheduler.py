"""What to ask for now: wants in priority order become byte ranges, bounded by what the link can carry.

Theory
------
LPC 4: "the request queue is traversed in order of priority at the end of the frame, issuing only as many requests as
those allowed by the estimated network bandwidth, and forgetting the rest". A link carries bytes, not requests:

1. *Wants are forgotten.* `offer` replaces all wants that are not in flight. Nothing queues here across a turn of the
   camera.
2. *Neighbours travel together.* A request grows from the most urgent want (the seed) along the file, forward first,
   then backward, over wants whose turn would come within `reach_seconds` of the link anyway (neighbours of any
   urgency would turn an order by error into one by place), while the gap between them is cheaper than a request. A
   request costs its headers and, only when less than a round trip of bytes is outstanding, the time in which the link
   would run dry: ``gap <= overhead + max(0, rate * rtt - outstanding)``. Where the most urgent want waits for others,
   since it is decoded after its ancestors, it and they travel alone: with neighbours, each would cost it a whole
   request.
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
8. *What nobody wants yet fills an idle line only.* `offer_ahead` says what a later frame may want. It is asked for
   when every want is in flight and less than a round trip of bytes is outstanding, one request at a time: the line
   stays busy, and what a new want finds before it at the narrow place of the line is one such request at most,
   ``rate * ahead_seconds`` bytes or one object. Window, bucket, slots and slow start of the wants do not count it:
   which wants are asked for, and when, does not depend on it.

Everything is an argument: wants, time, and the state of the link. `offer` and `issue` return and do no I/O.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .offers import Item, Offer, Request

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SchedulerOptions:
    """Constants of the schedule.

    Parameters
    ----------
    request_seconds : float
        Length of a request, seconds of the link.
    reach_seconds : float
        How much less urgent than the seed what comes along may be, seconds of the link.
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
    ahead_seconds : float
        Length of a request for what nobody wants yet, seconds of the link, unless one object is longer.
    ahead_patience : float
        Seconds of the link that such an object may take: longer ones are not fetched before they are wanted.
    most_ahead : int
        Such requests in flight, at most, besides `most_requests`.
    """

    request_seconds: float = 0.1
    reach_seconds: float = 1.5
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
    ahead_seconds: float = 0.05
    ahead_patience: float = 0.25
    most_ahead: int = 4


class LinkState(NamedTuple):
    """What `Goodput` says at the moment."""

    rate: float
    """Bytes per second that may be spent."""
    rtt: float
    """Seconds."""
    measured: bool
    """False: `rate` is a prior."""


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
        self._wants, self._ahead = Offer.nothing(), Offer.nothing()

    def __repr__(self) -> str:
        return f"<Scheduler {self.in_flight} requests, {self.outstanding} bytes outstanding, {self.waiting} wants>"

    @property
    def outstanding(self) -> int:
        """Bytes asked for and not here."""
        return sum(request.outstanding for request in self._flying)

    @property
    def in_flight(self) -> int:
        """Requests in flight."""
        return len(self._flying)

    @property
    def waiting(self) -> int:
        """Wants of the last offer that are not in flight."""
        return self._wants.waiting

    @property
    def ahead(self) -> list[int]:
        """Clouds in flight that nobody wants yet."""
        return [item.key for request in self._flying if request.ahead for item in request.items if item.key >= 0]

    def flies(self, key: int) -> bool:
        """Whether a key is in flight."""
        return key in self._keys

    def offer(
        self,
        keys: NDArray[np.int64],
        starts: NDArray[np.int64],
        stops: NDArray[np.int64],
        *,
        alone: NDArray[np.int64] | None = None,
    ) -> None:
        """Replace the wants.

        Parameters
        ----------
        keys, starts, stops : ndarray, (n,) int64
            What is wanted, most urgent first, each once, and where it stands in the file. Keys in flight are skipped.
        alone : ndarray of int64, optional
            Keys that, as seeds, travel without neighbours.
        """
        self._ahead.withdraw(keys)
        new = self._not_flying(keys)[: self.options.most_wants]
        self._wants = Offer(
            keys[new], starts[new], stops[new], alone=frozenset(() if alone is None else alone.tolist())
        )

    def offer_ahead(self, keys: NDArray[np.int64], starts: NDArray[np.int64], stops: NDArray[np.int64]) -> None:
        """Replace what nobody wants yet and a later frame may want; it stays offered until this is called again.

        Parameters
        ----------
        keys, starts, stops : ndarray, (n,) int64
            As in `offer`. What is wanted already stays wanted.
        """
        new = self._not_flying(keys)[: self.options.most_wants]
        new = new[~self._wants.holds(keys[new])]
        self._ahead = Offer(keys[new], starts[new], stops[new])

    def _not_flying(self, keys: NDArray[np.int64]) -> NDArray[np.intp]:
        flying = np.fromiter(self._keys, dtype=np.int64, count=len(self._keys))
        return np.flatnonzero(~np.isin(keys, flying))

    def issue(self, now: float, link: LinkState | None, *, ahead: bool = True) -> list[Request]:
        """Take as many of the wants as may be asked for now.

        Parameters
        ----------
        now : float
            Seconds.
        link : LinkState or None
            None for a local file.
        ahead : bool
            Whether there is room for what nobody wants yet.
        """
        self._fill_bucket(now, link)
        issued = self._issue_wanted(link)
        if ahead and link is not None and not self.waiting:
            issued += self._issue_ahead(link)
        return issued

    def _issue_wanted(self, link: LinkState | None) -> list[Request]:
        window, longest = self.window(link), self.longest(link)
        issued: list[Request] = []
        flying = [request for request in self._flying if not request.ahead]
        outstanding = sum(request.outstanding for request in flying)
        while len(flying) + len(issued) < self.options.most_requests:
            seed = self._wants.next_seed()
            if seed < 0:
                break
            first, last = self._wants.grow(seed, self._widest_gap(link, outstanding), longest, self._reach(link))
            request = self._wants.request(first, last)
            if outstanding > 0 and outstanding + request.range.size > window:
                break
            if link is not None and link.measured:
                if self._tokens <= 0:
                    break
                self._tokens -= request.range.size
            self._wants.take(first, last)
            self.adopt(request)
            issued.append(request)
            outstanding += request.range.size
        return issued

    def _issue_ahead(self, link: LinkState) -> list[Request]:
        """Rule 8."""
        longest, patience = link.rate * self.options.ahead_seconds, link.rate * self.options.ahead_patience
        issued: list[Request] = []
        flying = sum(request.ahead for request in self._flying)
        outstanding = self.outstanding
        while flying + len(issued) < self.options.most_ahead and (
            outstanding == 0 or outstanding < link.rate * link.rtt
        ):
            seed = self._ahead.next_seed()
            if seed < 0:
                break
            first, last = self._ahead.grow(seed, self.options.overhead, int(longest))
            request = self._ahead.request(first, last, ahead=True)
            self._ahead.take(first, last)
            if request.range.size > patience:
                continue
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
        if not request.ahead:
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

    def _reach(self, link: LinkState | None) -> float:
        return math.inf if link is None else link.rate * self.options.reach_seconds

    def _fill_bucket(self, now: float, link: LinkState | None) -> None:
        passed = 0.0 if self._filled is None else max(0.0, now - self._filled)
        self._filled = now
        if link is not None:
            capacity = float(self.window(link))
            self._tokens = min(capacity, self._tokens + passed * link.rate * self.options.gain)
