"""What the last frame wanted and did not have, and for how long anything was wanted. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Wanted:
    """Starts as wanting: the model itself.

    Parameters
    ----------
    now : float
        Seconds.
    """

    def __init__(self, now: float) -> None:
        self._nodes: NDArray[np.bool_] = np.zeros(0, dtype=bool)
        self._pages: set[int] = set()
        self._count = 0
        self._total = 0.0
        self._since: float | None = now

    def begin(self, nodes: int) -> None:
        """Start anew with a model of so many nodes; still wanting until a frame says otherwise."""
        self._nodes = np.zeros(nodes, dtype=bool)
        self._pages, self._count = set(), 0

    def frame(self, now: float, pages: NDArray[np.int64], nodes: NDArray[np.int64]) -> None:
        """Take the wants of a frame that are not here and can be had."""
        self._nodes[:] = False
        self._nodes[nodes] = True
        self._count = len(nodes)
        self._pages = set(pages.tolist())
        self._note(now)

    def came(self, now: float, key: int) -> None:
        """Note that a cloud (or page ``~key``) is here, or never will be."""
        if key < 0:
            self._pages.discard(~key)
        elif self._nodes[key]:
            self._nodes[key] = False
            self._count -= 1
        self._note(now)

    def holds(self, key: int) -> bool:
        """Whether the last frame wanted a cloud (or page ``~key``) that is not here."""
        return ~key in self._pages if key < 0 else bool(self._nodes[key])

    def stop(self, now: float) -> None:
        """Note that nothing can be had any more."""
        self._nodes[:] = False
        self._pages, self._count = set(), 0
        self._note(now)

    @property
    def anything(self) -> bool:
        """Whether anything is wanted that can still come."""
        return self._since is not None

    def seconds(self, now: float) -> float:
        """Sum up the time in which anything was wanted."""
        return self._total + (0.0 if self._since is None else now - self._since)

    def _note(self, now: float) -> None:
        if self._since is not None:
            self._total += now - self._since
        self._since = now if self._count or self._pages else None
