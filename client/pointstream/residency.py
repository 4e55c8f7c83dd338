"""Which decoded clouds stay in memory: least recently used go first, what is drawn never goes.

A cloud is *touched* when it arrives and in every frame whose cut draws it. When the bytes pass the capacity, clouds
are dropped in the order of their last touch, and among equally old ones the deepest first (the largest node number),
so that what stays is still a tree from the root down. Clouds of the current cut are *pinned*: they are never dropped,
even if they alone pass the capacity; `over` then says by how much. `full` says that the cut leaves no room: asking
for more would only push out what was just fetched, so the access layer then asks for nothing.

A cloud that came *ahead*, before any frame wanted it, counts as older than all that was ever drawn until a frame draws
it: the first to go, and nothing goes for it. `roomy` says whether there is room for more of them.

Dropping goes on until a sixteenth of the capacity is free, so that its pass over the resident nodes is paid once per
many arrivals. Nothing is done per node and frame in Python.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

UNDRAWN = 1 << 62
"""Taken from the time of what no frame has drawn: it is older than everything else, and keeps its order."""


class Residency:
    """The set of resident nodes, with their bytes.

    Parameters
    ----------
    nodes : int
        Nodes of the model; arrays of this length are taken from the system lazily.
    capacity : int
        Bytes of decoded clouds to stay below.
    slack : int
        One part in `slack` of the capacity is freed at a time.
    """

    def __init__(self, nodes: int, capacity: int, *, slack: int = 16) -> None:
        if capacity < 0 or slack < 1:
            raise ValueError(f"capacity {capacity} bytes, slack 1/{slack}: not negative and at least 1 are needed")
        self.capacity = capacity
        self.resident: NDArray[np.bool_] = np.zeros(nodes, dtype=bool)
        self.bytes = 0
        self.evicted = 0
        self._slack = slack
        self._sizes = np.zeros(nodes, dtype=np.int64)
        self._touched = np.zeros(nodes, dtype=np.int64)
        self._pinned: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self._pinned_bytes = 0
        self._tick = 0

    @property
    def over(self) -> int:
        """Bytes above the capacity: what the pinned clouds need beyond it."""
        return max(0, self.bytes - self.capacity)

    @property
    def full(self) -> bool:
        """Whether the pinned clouds alone leave less than the slack."""
        return self._pinned_bytes > self.capacity - self.capacity // self._slack

    def roomy(self, coming: int) -> bool:
        """Whether more finds room ahead after `coming` bytes, pushing nothing out: half of what is freed at a time."""
        return self.bytes + coming <= self.capacity - self.capacity // (2 * self._slack)

    def pin(self, nodes: NDArray[np.int64]) -> list[int]:
        """Make `nodes` the current cut: touched now, not to be dropped until the next call.

        Returns
        -------
        list of int
            Nodes dropped because the previous cut no longer protects them.
        """
        self._tick += 1
        self._pinned = np.asarray(nodes, dtype=np.int64)
        self._touched[self._pinned] = self._tick
        self._pinned_bytes = int(self._sizes[self._pinned[self.resident[self._pinned]]].sum())
        return self._evict(newest=-1)

    def add(self, node: int, size: int, *, ahead: bool = False) -> list[int]:
        """Take in a cloud of `size` bytes; return the nodes dropped for it: never itself, unless it came ahead."""
        if ahead and self.bytes + size > self.capacity:
            self.evicted += 1
            return [node]
        self._tick += 1
        self.bytes += size - (int(self._sizes[node]) if self.resident[node] else 0)
        self.resident[node] = True
        self._sizes[node] = size
        self._touched[node] = self._tick - (UNDRAWN if ahead else 0)
        return self._evict(newest=node)

    def _evict(self, newest: int) -> list[int]:
        if self.bytes <= self.capacity:
            return []
        candidates = np.flatnonzero(self.resident)
        free = np.ones(len(self.resident), dtype=bool)
        free[self._pinned] = False
        if newest >= 0:
            free[newest] = False
        candidates = candidates[free[candidates]]
        order = candidates[np.lexsort((-candidates, self._touched[candidates]))]
        surplus = self.bytes - (self.capacity - self.capacity // self._slack)
        freed = np.cumsum(self._sizes[order])
        drop = order[: int(np.searchsorted(freed, surplus)) + 1]
        self.resident[drop] = False
        self.bytes -= int(self._sizes[drop].sum())
        self.evicted += len(drop)
        return [int(node) for node in drop]
