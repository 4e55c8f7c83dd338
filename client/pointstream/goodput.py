"""What the link really carries: bytes per busy second, and the round-trip time, measured from the replies.

Theory
------
A reply on a shared link is slow because its neighbours are fast. Averages over single replies therefore read
1 / (replies in flight) of the truth. So nothing here is measured per reply: one counter belongs to the whole link.

1. *Busy time.* A bin opens at the first body byte that arrives and counts the bytes after it, whichever reply they
   belong to, against the seconds since. (The first piece itself travelled before the bin was open.) It closes every
   250 ms, and when nothing is outstanding. A bin that is shorter than 50 ms or holds less than 8 KiB says nothing and
   is dropped; on a link so slow that 250 ms bring less, it stays open longer.
2. *Bubbles are not the link's fault.* When the last body ends and every request outstanding was sent less than one
   round trip ago, no byte of theirs can be on its way yet: the bin pauses until the next first byte.
3. *Two memories.* Bins enter two exponential averages, weighted by their busy seconds, with half-lives of 2.5 s and
   10 s. `rate` is the fast one; `admission`, what a scheduler may spend, is the smaller of both once they are warm.
   Two successive bins far on the same side of the fast average mean that the link itself changed: both start anew.
4. *Silence is forgetting.* After 30 s without a byte the estimate drifts (in log scale) towards the prior.
5. *Round trips apart.* The time to the first byte is a round trip only if our own queue was shorter than it: bytes
   asked before drain while the new request travels. Other samples are bounds and are dropped; of the rest a low
   quantile.

What comes from a cache never passes here. Time is an argument everywhere (seconds, any monotonic origin).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True, kw_only=True)
class GoodputOptions:
    """Constants of the estimate.

    Parameters
    ----------
    prior : float
        Bytes per second believed before the first measurement and after long silence.
    prior_rtt : float
        Seconds, likewise.
    bin_seconds, least_seconds : float
        Busy time at which a bin closes, and below which it is dropped.
    least_bytes : int
        Bytes below which a bin is dropped.
    longest_bin : float
        Busy seconds after which a bin without `least_bytes` is dropped.
    fast, slow : float
        Half-lives of the two averages, busy seconds.
    warm_up : float
        Busy seconds after which `admission` heeds the slow average.
    jump : float
        Ratio to the fast average beyond which two successive bins restart the averages.
    idle : float
        Seconds of silence after which the estimate starts to halve its distance (in log scale) to the prior.
    rtt_samples : int
        Round trips remembered.
    rtt_quantile : float
        The quantile of them that counts.
    """

    prior: float = 131_072.0
    prior_rtt: float = 0.1
    bin_seconds: float = 0.25
    least_seconds: float = 0.05
    least_bytes: int = 8192
    longest_bin: float = 8.0
    fast: float = 2.5
    slow: float = 10.0
    warm_up: float = 1.0
    jump: float = 1.6
    idle: float = 30.0
    rtt_samples: int = 32
    rtt_quantile: float = 0.1

    def __post_init__(self) -> None:
        if self.prior <= 0 or self.prior_rtt < 0:
            raise ValueError(
                f"prior {self.prior} bytes/s, {self.prior_rtt} s: a rate above and a time from zero are needed"
            )


@dataclass(slots=True, eq=False)
class Transfer:
    """One request and its reply, as the meter knows it."""

    sent: float
    remaining: int
    ahead: int
    started: bool = False


@dataclass(slots=True)
class _Average:
    """Exponential average weighted by seconds, without the bias of its empty start."""

    half_life: float
    total: float = 0.0
    weight: float = 0.0

    def add(self, value: float, seconds: float) -> None:
        keep = 0.5 ** (seconds / self.half_life)
        self.total = self.total * keep + value * (1.0 - keep)
        self.weight = self.weight * keep + (1.0 - keep)

    @property
    def value(self) -> float:
        return self.total / self.weight


@dataclass(slots=True, eq=False)
class Goodput:
    """The meter of one link; see the module's text for what it counts."""

    options: GoodputOptions = field(default_factory=GoodputOptions)
    received_bytes: int = 0
    """Body bytes since the start, useful or not."""
    requests: int = 0
    """Requests since the start, retries included."""
    busy_seconds: float = 0.0
    """Busy seconds that entered the averages."""
    _transfers: list[Transfer] = field(default_factory=list)
    _open: bool = False
    _since: float = 0.0
    _busy: float = 0.0
    _bytes: int = 0
    _fast: _Average | None = None
    _slow: _Average | None = None
    _odd: tuple[float, float] | None = None
    _last_byte: float = 0.0
    _rtts: deque[float] = field(default_factory=deque)

    def begin(self, now: float, expected: int) -> Transfer:
        """Note that a request for `expected` body bytes was made."""
        transfer = Transfer(sent=now, remaining=expected, ahead=self.outstanding)
        self._transfers.append(transfer)
        self.requests += 1
        return transfer

    def sent(self, transfer: Transfer, now: float) -> None:
        """Note that the request went out only now (it waited for its connection)."""
        transfer.sent = now
        transfer.ahead = self.outstanding - transfer.remaining

    def received(self, transfer: Transfer, now: float, nbytes: int) -> None:
        """Count body bytes that just arrived."""
        if not transfer.started:
            transfer.started = True
            self._round_trip(now - transfer.sent, transfer.ahead / self.rate(now))
        transfer.remaining = max(0, transfer.remaining - nbytes)
        self.received_bytes += nbytes
        self._last_byte = now
        if not self._open:
            self._open, self._since = True, now
            return
        self._busy += now - self._since
        self._since = now
        self._bytes += nbytes
        if self._busy >= self.options.bin_seconds and self._bytes >= self.options.least_bytes:
            self._close_bin()
        elif self._busy >= self.options.longest_bin:
            self._busy, self._bytes = 0.0, 0

    def end(self, transfer: Transfer, now: float) -> None:
        """Note that a reply is complete, or that it failed."""
        self._transfers.remove(transfer)
        if not self._transfers:
            if self._busy >= self.options.least_seconds and self._bytes >= self.options.least_bytes:
                self._close_bin()
            self._open, self._busy, self._bytes = False, 0.0, 0
        elif not any(other.started or now - other.sent >= self.rtt for other in self._transfers):
            self._open = False  # a bubble (2): nothing can be on its way

    @property
    def outstanding(self) -> int:
        """Body bytes asked for and not here."""
        return sum(transfer.remaining for transfer in self._transfers)

    @property
    def in_flight(self) -> int:
        """Requests whose reply has not ended."""
        return len(self._transfers)

    @property
    def measured(self) -> bool:
        """Whether a bin has closed, so that `rate` is more than the prior."""
        return self._fast is not None

    @property
    def rtt(self) -> float:
        """Round-trip time of the link without our own queue, seconds."""
        if not self._rtts:
            return self.options.prior_rtt
        return sorted(self._rtts)[int(self.options.rtt_quantile * len(self._rtts))]

    def rate(self, now: float) -> float:
        """Best estimate of what the link carries, bytes per second."""
        return self.options.prior if self._fast is None else self._aged(self._fast.value, now)

    def admission(self, now: float) -> float:
        """Bytes per second that may be spent: careful for some seconds after every improvement."""
        if self._fast is None or self._slow is None:
            return self.options.prior
        cautious = self.busy_seconds >= self.options.warm_up
        return self._aged(min(self._fast.value, self._slow.value) if cautious else self._fast.value, now)

    def _aged(self, value: float, now: float) -> float:
        silent = now - self._last_byte - self.options.idle
        if silent <= 0:
            return value
        keep = 0.5 ** (silent / self.options.idle)
        return float(self.options.prior * (value / self.options.prior) ** keep)

    def _close_bin(self) -> None:
        rate, seconds = self._bytes / self._busy, self._busy
        self._busy, self._bytes = 0.0, 0
        self.busy_seconds += seconds
        if self._fast is None or self._slow is None:
            self._restart((rate, seconds))
            return
        ratio = rate / self._fast.value
        odd = max(ratio, 1.0 / ratio) > self.options.jump
        if odd and self._odd is not None and (self._odd[0] > self._fast.value) == (rate > self._fast.value):
            self._restart(self._odd, (rate, seconds))
            return
        self._odd = (rate, seconds) if odd else None
        self._fast.add(rate, seconds)
        self._slow.add(rate, seconds)

    def _restart(self, *bins: tuple[float, float]) -> None:
        self._fast, self._slow, self._odd = _Average(self.options.fast), _Average(self.options.slow), None
        for rate, seconds in bins:
            self._fast.add(rate, seconds)
            self._slow.add(rate, seconds)

    def _round_trip(self, first_byte: float, own_queue: float) -> None:
        if own_queue <= 0.5 * first_byte:
            self._rtts.append(first_byte)
            if len(self._rtts) > self.options.rtt_samples:
                self._rtts.popleft()
