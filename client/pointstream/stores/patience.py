"""How long to wait for a reply and how often to ask again. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from lpc.errors import Unavailable

if TYPE_CHECKING:
    import random

    from .replies import Retry


@dataclass(frozen=True, slots=True, kw_only=True)
class PatienceOptions:
    """Waiting and retrying.

    Parameters
    ----------
    connect_seconds : float
        Until the request is on its way.
    grace_seconds : float
        Until the first byte, and what a reply may lag behind in all.
    factor : float
        A reply may be this much slower than the link's estimate.
    slow_rate : float
        Bytes per second: estimates above it are cut to it, so that a link that got slow is waited for.
    tries : int
        Of one range, at most; one more where an idle connection died.
    backoff_seconds, longest_backoff : float
        The wait before try n + 1 is drawn from 0 to ``backoff_seconds * 2 ** n`` ("full jitter"), at most the latter.
    pieces : int
        Requests that one range may take of a host that gives less than asked.
    """

    connect_seconds: float = 10.0
    grace_seconds: float = 5.0
    factor: float = 4.0
    slow_rate: float = 8192.0
    tries: int = 4
    backoff_seconds: float = 0.2
    longest_backoff: float = 10.0
    pieces: int = 16


def overdue(sent: float, received: int, rate: float, options: PatienceOptions) -> float:
    """Return the time at which a reply that has brought `received` bytes is given up if nothing more comes.

    One line rules stalls, drips and slow bodies: after the grace, byte k must be here ``factor * k / rate`` seconds
    after the request went out. For the last byte this is the deadline, ``grace + factor * size / rate``.
    """
    return sent + options.grace_seconds + options.factor * received / min(rate, options.slow_rate)


class Tries:
    """Counts the tries of one range and says how long to wait before the next."""

    def __init__(self, options: PatienceOptions, rng: random.Random, name: str) -> None:
        self._options, self._rng, self._name = options, rng, name
        self._failures = 0
        self._stale = False

    def wait(self, retry: Retry) -> float:
        """Return the seconds to wait after a failure.

        Raises
        ------
        Unavailable
            If that was the last try.
        """
        if retry.stale and not self._stale:  # an idle connection that the host had closed: not the host's failure
            self._stale = True
            return 0.0
        self._failures += 1
        if self._failures >= self._options.tries:
            raise Unavailable(f"{self._name}: gave up after {self._failures} tries ({retry})") from retry
        jitter = self._rng.uniform(0.0, self._options.backoff_seconds * 2.0**self._failures)
        return max(min(jitter, self._options.longest_backoff), retry.after or 0.0)
