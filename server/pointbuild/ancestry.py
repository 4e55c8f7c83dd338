"""Clouds of inner nodes as readers will have decoded them, kept for the nodes below (docs/format.md, Context).

Nodes are encoded level by level, so a level is used until that `ANCESTORS` below it is done. What is not here, for it
was never kept, is on its way in another thread or went to another machine, is made again from its rows.
"""

from __future__ import annotations

from threading import Lock
from typing import TYPE_CHECKING, NamedTuple

from lpc.context import ANCESTORS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from lpc.cloud import Cloud

OBJECT_BYTES = 1 << 10
"""Of a cloud besides its samples."""


class Ancestor(NamedTuple):
    """An inner node: its cloud, and the number of the cloud of an older model that it is; -1: none."""

    cloud: Cloud
    old: int


class Ancestry:
    """Inner nodes of the last levels; for any thread.

    Parameters
    ----------
    capacity : int
        Bytes. What comes when they are full is not kept: nodes are used in the order in which they came, so what is
        here will be wanted before what would take its place.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity, self._bytes = capacity, 0
        self._levels: dict[int, dict[int, Ancestor]] = {}
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[Ancestry], tuple[int]]:
        return Ancestry, (0,)

    def find(self, nodes: Iterable[int]) -> dict[int, Ancestor]:
        """Give those of some nodes that are here."""
        with self._lock:
            return {node: level[node] for node in nodes for level in self._levels.values() if node in level}

    def keep(self, found: Mapping[int, Ancestor], depth: NDArray[np.int64], reached: int) -> None:
        """Take in nodes, and let go of levels that have no more descendants to tell.

        Parameters
        ----------
        found : mapping of int to Ancestor
        depth : ndarray, (n,) int64
            Levels of all nodes.
        reached : int
            Nodes of earlier levels have all been given out to be encoded.
        """
        with self._lock:
            for done in [level for level in self._levels if level < reached - ANCESTORS]:
                self._bytes -= sum(map(_size, self._levels.pop(done).values()))
            for node, ancestor in found.items():
                level = self._levels.setdefault(int(depth[node]), {})
                if node not in level and self._bytes + _size(ancestor) <= self._capacity:
                    level[node] = ancestor
                    self._bytes += _size(ancestor)


def _size(ancestor: Ancestor) -> int:
    return ancestor.cloud.nbytes + OBJECT_BYTES
