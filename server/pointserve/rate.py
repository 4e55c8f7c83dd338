"""How fast one address may read: a token bucket each, kept as the moment at which it has paid for what it got. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

BURST_SECONDS = 0.25
"""What an address that was silent may have at once, in seconds of its rate."""


class RateCap:
    """The buckets of all addresses.

    Parameters
    ----------
    rate : float
        Bytes a second for one address, over all its connections.
    clock : callable of float
        Monotonic seconds.
    share : callable of str to float
        Part of the rate that is this worker's to give away, by address.
    """

    def __init__(self, rate: float, *, clock: Callable[[], float], share: Callable[[str], float]) -> None:
        self.rate = rate
        self._clock = clock
        self._share = share
        self._paid: dict[str, float] = {}
        self._tidy_at = 1024

    @property
    def piece(self) -> int:
        """Bytes to ask for at once: a tenth of a second's, so that nobody waits long and then gets much."""
        return max(1024, int(self.rate / 10))

    def delay(self, address: str, size: int) -> float:
        """Seconds to wait before `size` bytes are sent; they are taken to be sent then."""
        now = self._clock()
        start = max(self._paid.get(address, 0.0), now - BURST_SECONDS)
        self._paid[address] = start + size / (self.rate * self._share(address))
        if len(self._paid) > self._tidy_at:
            self._paid = {known: paid for known, paid in self._paid.items() if paid > now - BURST_SECONDS}
            self._tidy_at = max(1024, 2 * len(self._paid))
        return max(0.0, start - now)
