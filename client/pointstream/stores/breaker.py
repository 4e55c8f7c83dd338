"""When a host is left alone: failures in a row open the breaker, and retries have a budget. Pure.

Each file has its tries (`patience`); this is what all requests to one host share. After `trip` failed requests in a row
nothing is asked for a pause, which doubles up to `longest`; then one request at a time tries whether the host is back.
And retries are paid for by requests: each request earns a tenth of one, so that a host that fails at random is asked at
most 10% more, not four times as much.
"""

from __future__ import annotations

from dataclasses import dataclass

from lpc.errors import Unavailable

LOOK_SECONDS = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class BreakerOptions:
    """Bounds.

    Parameters
    ----------
    trip : int
        Failed requests in a row that open the breaker.
    pause, longest : float
        Seconds; the first pause, and the longest.
    earned : float
        Retries that a request earns.
    saved : float
        Retries that can be saved up; there at the start.
    """

    trip: int = 8
    pause: float = 1.0
    longest: float = 10.0
    earned: float = 0.1
    saved: float = 16.0


class Breaker:
    """Of one host; several stores may share it."""

    def __init__(self, host: str, options: BreakerOptions | None = None) -> None:
        self.host = host
        self._options = options or BreakerOptions()
        self._failures = 0
        self._pauses = 0
        self._until = -float("inf")
        self._retries = self._options.saved
        self._trying = False
        self._last = ""

    @property
    def open(self) -> bool:
        """Whether the host has failed so often that only single requests try it."""
        return self._pauses > 0

    def check(self, now: float) -> float:
        """Ask whether a request may go out: 0, or the seconds after which to ask again, while another one tries.

        Raises
        ------
        Unavailable
            If the host is to be left alone.
        """
        if now < self._until:
            if self._trying:
                return min(LOOK_SECONDS, self._until - now)
            raise Unavailable(
                f"{self.host} fails again and again ({self._last}): not asked for {self._until - now:.1f} s"
            )
        if self.open:  # this request tries whether the host is back, others wait for what comes of it
            self._trying, self._until = True, now + self._pause
        self._retries = min(self._retries + self._options.earned, self._options.saved)
        return 0.0

    def may_retry(self) -> bool:
        """Whether the budget pays for a retry; takes it if so."""
        if self._retries < 1.0:
            return False
        self._retries -= 1.0
        return True

    def failed(self, now: float, reason: str) -> None:
        """Note a failed request."""
        self._failures, self._last = self._failures + 1, reason
        if self._trying or (not self.open and self._failures >= self._options.trip):
            self._trying, self._pauses = False, self._pauses + 1
            self._until = now + self._pause

    def abandoned(self, now: float) -> None:
        """Note that a request was cut off by whoever made it: it proved nothing."""
        if self._trying:
            self._trying, self._until = False, now

    def answered(self) -> None:
        """Note a good reply."""
        self._failures, self._pauses, self._trying = 0, 0, False
        self._until = -float("inf")

    @property
    def _pause(self) -> float:
        return min(self._options.pause * 2.0 ** max(0, self._pauses - 1), self._options.longest)
