"""When to ask a host again that failed, and how often to follow a model that changes. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoveryOptions:
    """Bounds.

    Parameters
    ----------
    first_pause, longest_pause : float
        Seconds; pauses double from the one to the other while the host does not answer.
    reloads, reload_seconds : int, float
        Changes of the model that are followed within that time.
    """

    first_pause: float = 1.0
    longest_pause: float = 10.0
    reloads: int = 3
    reload_seconds: float = 60.0


class Recovery:
    """What happened with a host lately."""

    def __init__(self, options: RecoveryOptions) -> None:
        self._options = options
        self._failures = 0
        self._until = -float("inf")
        self._reloads: deque[float] = deque()

    def paused(self, now: float) -> bool:
        """Whether to leave the host alone."""
        return now < self._until

    def failed(self, now: float) -> None:
        """Note that the host did not answer, after all tries; failures during a pause are the same one."""
        if not self.paused(now):
            self._until = now + min(self._options.first_pause * 2.0**self._failures, self._options.longest_pause)
            self._failures += 1

    def answered(self) -> None:
        """Note that the host answered."""
        self._failures = 0

    def may_reload(self, now: float) -> bool:
        """Whether a change of the model is to be followed; counts it if so."""
        while self._reloads and now - self._reloads[0] > self._options.reload_seconds:
            self._reloads.popleft()
        if len(self._reloads) >= self._options.reloads:
            return False
        self._reloads.append(now)
        return True
