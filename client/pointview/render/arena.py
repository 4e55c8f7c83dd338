"""Which cloud lies in which slot of a backend's memory: equal slots, least recently drawn out first.

Only the bookkeeping, and per slot what every backend needs to place the cloud; the vertices belong to the backend. All
work of a frame is vectorised: a cut whose clouds are all here costs a few numpy calls, whatever its size.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .pack import PackedCloud

Slots = NDArray[np.int64]


class Arena:
    """Slots for the clouds of one model.

    Parameters
    ----------
    nodes : int
        Nodes of the model.
    slots : int
        Clouds that fit.

    Attributes
    ----------
    origin : (slots, 3) float64
        Model space position of the cloud's (0, 0, 0).
    scale : (slots,) float64
        Model units of one step of the cloud's coordinates.
    count : (slots,) int64
        Samples.
    thin : (slots,) bool
        Whether some are in thin parts of the cloud.
    """

    def __init__(self, nodes: int, slots: int) -> None:
        self.slots = slots
        self.origin = np.zeros((slots, 3))
        self.scale = np.zeros(slots)
        self.count = np.zeros(slots, dtype=np.int64)
        self.thin = np.zeros(slots, dtype=bool)
        self._slot_of = np.full(nodes, -1, dtype=np.int32)
        self._node_of = np.full(slots, -1, dtype=np.int64)
        self._drawn = np.zeros(slots, dtype=np.int64)  # number of the last call that used the slot
        self._call = 0

    def place(self, nodes: NDArray[np.int64]) -> tuple[NDArray[np.int64], Slots]:
        """Make room for the nodes of one draw, none of which is evicted for another.

        Returns
        -------
        nodes, slots
            The nodes that were not here and the slots to write them to with `put`.

        Raises
        ------
        ValueError
            For more nodes than slots.
        """
        if len(nodes) > self.slots:
            raise ValueError(f"{len(nodes)} clouds do not fit into {self.slots} slots")
        self._call += 1
        slots = self._slot_of[nodes]
        here = slots >= 0
        self._drawn[slots[here]] = self._call
        absent = nodes[~here]
        if len(absent) == 0:
            return absent, np.empty(0, dtype=np.int64)
        oldest = np.argsort(self._drawn, kind="stable")[: len(absent)]
        evicted = self._node_of[oldest]
        self._slot_of[evicted[evicted >= 0]] = -1
        self._node_of[oldest] = absent
        self._slot_of[absent] = oldest
        self._drawn[oldest] = self._call
        return absent, oldest

    def put(self, slot: int, cloud: PackedCloud) -> None:
        """Note where the cloud in a slot lies."""
        self.origin[slot] = cloud.origin
        self.scale[slot] = cloud.scale
        self.count[slot] = len(cloud.vertex)
        self.thin[slot] = cloud.thin

    def slots_of(self, nodes: NDArray[np.int64]) -> Slots:
        """Slots of nodes that are here; -1 for others."""
        return self._slot_of[nodes].astype(np.int64)

    def forget(self, nodes: NDArray[np.int64]) -> None:
        """Empty the slots of nodes that were placed but could not be filled."""
        slots = self._slot_of[nodes]
        slots = slots[slots >= 0]
        self._slot_of[self._node_of[slots]] = -1
        self._node_of[slots] = -1
        self._drawn[slots] = 0

    def grow(self, slots: int) -> None:
        """Add empty slots; what is here keeps its place."""
        more = slots - self.slots
        self.slots = slots
        self.origin = np.concatenate([self.origin, np.zeros((more, 3))])
        self.scale = np.concatenate([self.scale, np.zeros(more)])
        self.count = np.concatenate([self.count, np.zeros(more, dtype=np.int64)])
        self.thin = np.concatenate([self.thin, np.zeros(more, dtype=bool)])
        self._node_of = np.concatenate([self._node_of, np.full(more, -1, dtype=np.int64)])
        self._drawn = np.concatenate([self._drawn, np.zeros(more, dtype=np.int64)])
