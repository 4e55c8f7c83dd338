"""One build of a model as far as it is here: index, decoded clouds, and what cannot be had.

When the host changes the model, all of this is replaced by a new one in one step, so no frame mixes two builds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .residency import Residency
from .scheduler import Item

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.cloud import Cloud
    from lpc.index import IndexTree


class Build:
    """State of one build.

    Parameters
    ----------
    index : IndexTree
    capacity : int
        Bytes of decoded clouds.
    length : int
        Bytes of the file; less than the header says if it was cut short.

    Attributes
    ----------
    clouds : dict of int to Cloud
        The resident ones.
    absent : ndarray, (nodes,) bool
        Known nodes that cannot be had: cut off, or damaged at every try.
    busy : ndarray, (nodes,) bool
        Arrived and being decoded.
    """

    def __init__(self, index: IndexTree, *, capacity: int, length: int) -> None:
        self.index = index
        self.residency = Residency(len(index), capacity)
        self.clouds: dict[int, Cloud] = {}
        self.absent: NDArray[np.bool_] = np.zeros(len(index), dtype=bool)
        self.busy: NDArray[np.bool_] = np.zeros(len(index), dtype=bool)
        self.length = length
        self.lost_pages: set[int] = set()
        self._failures: dict[int, int] = {}
        self.page_came()

    def page_came(self) -> None:
        """Find out which of the known nodes are cut off."""
        if self.length < self.index.header.bytes:
            self.absent |= self.index.known & ~self.index.available(self.length)

    def ends_at(self, length: int) -> None:
        """Learn that the file is shorter than thought."""
        if length < self.length:
            self.length = length
            self.page_came()

    def add(self, node: int, cloud: Cloud) -> None:
        """Make a decoded cloud resident."""
        self.clouds[node] = cloud
        self.drop(self.residency.add(node, cloud.nbytes))

    def drop(self, nodes: list[int]) -> None:
        """Let go of evicted clouds."""
        for node in nodes:
            del self.clouds[node]

    def failed(self, key: int, tries: int) -> bool:
        """Count a damaged cloud or page; True if that was the last try and it stays missing."""
        self._failures[key] = self._failures.get(key, 0) + 1
        if self._failures[key] < tries:
            return False
        if key < 0:
            self.lost_pages.add(~key)
        else:
            self.absent[key] = True
        return True

    def missing(self, wants: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Split wants into what can be had and is not here.

        Returns
        -------
        pages : ndarray of int64
            To be loaded before some of the wants are known.
        nodes : ndarray of int64
            In the order of `wants`; those that are being decoded are still missing.
        """
        known = self.index.known[wants]
        nodes = wants[known]
        nodes = nodes[~(self.residency.resident[nodes] | self.absent[nodes])]
        pages = self.index.missing_pages(wants[~known]) if not known.all() else np.empty(0, dtype=np.int64)
        here = [page for page in pages.tolist() if page not in self.lost_pages and self.has(self.page_item(page))]
        return np.array(here, dtype=np.int64), nodes

    def page_item(self, page: int) -> Item:
        """Return a page as an object to fetch; its key is ``~page``, those of clouds are their nodes."""
        place = self.index.page_range(page)
        return Item(~page, place.start, place.stop)

    def has(self, item: Item) -> bool:
        """Whether the file reaches to the end of an object."""
        return item.stop <= self.length

    def items_within(self, stop: int, nodes: NDArray[np.int64]) -> list[Item]:
        """Clouds of `nodes`, and pages not yet loaded, that end at or before `stop`."""
        ends = self.index.offset[nodes] + self.index.size[nodes]
        inside = nodes[(ends <= min(stop, self.length)) & ~self.residency.resident[nodes] & ~self.busy[nodes]]
        items = [
            Item(node, int(self.index.offset[node]), int(self.index.offset[node] + self.index.size[node]))
            for node in inside.tolist()
        ]
        for page in np.flatnonzero(~self.index.page_loaded & (self.index.page_offset > 0)).tolist():
            item = self.page_item(page)
            if item.stop <= min(stop, self.length):
                items.append(item)
        return items
