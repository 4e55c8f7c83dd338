"""One build of a model as far as it is here: index, decoded clouds, and what cannot be had.

When the host changes the model, all of this is replaced by a new one in one step, so no frame mixes two builds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lpc.context import ANCESTORS, is_told
from lpc.ranges import ByteRange

from .lineage import ancestors
from .offers import Item
from .residency import Residency

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.cloud import Cloud
    from lpc.errors import Corrupt
    from lpc.index import IndexTree

    from .stores import Store


class Arrived(NamedTuple):
    """A cloud's bytes, and how many of them came ahead of any want."""

    item: Item
    data: bytes
    ahead: int


class Build:
    """State of one build.

    Parameters
    ----------
    index : IndexTree
    capacity : int
        Bytes of decoded clouds.
    store : Store
        Says what of the file is there, and what it holds without asking over a link.

    Attributes
    ----------
    clouds : dict of int to Cloud
        The resident ones.
    absent : ndarray, (nodes,) bool
        Known nodes that cannot be had: cut off, or damaged at every try.
    busy : ndarray, (nodes,) bool
        Arrived and being decoded.
    held : ndarray, (nodes,) bool
        The store has them without asking over a link.
    waiting : dict of int to list
        What arrived and can be decoded after a node that is not here yet, by that node.
    waiting_bytes : int
        Of these.
    tail : (int, bytes)
        The start of an object that the opening cut in two, and where in the file it begins; given out once.
    """

    def __init__(self, index: IndexTree, *, capacity: int, store: Store) -> None:
        self.index, self._store = index, store
        self._sample_bytes = 6 + sum(entry.code_dtype.itemsize * entry.components for entry in index.header.attributes)
        self.residency = Residency(len(index), capacity)
        self.clouds: dict[int, Cloud] = {}
        self.absent: NDArray[np.bool_] = np.zeros(len(index), dtype=bool)
        self.busy: NDArray[np.bool_] = np.zeros(len(index), dtype=bool)
        self.held: NDArray[np.bool_] = np.zeros(len(index), dtype=bool)
        self.length = index.header.bytes if store.length is None else min(index.header.bytes, store.length)
        self.lost_pages: set[int] = set()
        self.waiting: dict[int, list[Arrived]] = {}
        self.waiting_bytes = self._waiting_decoded = 0
        self.tail: tuple[int, bytes] = (0, b"")
        self._failures: dict[int, int] = {}
        for page in np.flatnonzero(index.page_loaded).tolist():
            self.page_came(page)

    def page_came(self, page: int) -> None:
        """Find out which of a page's nodes the store holds, and which of them it can never give."""
        first = page * self.index.header.page_nodes
        rows = slice(first, first + self.index.header.page_nodes)
        stops = self.index.offset[rows] + self.index.size[rows]
        self.held[rows] = self._store.holds(self.index.offset[rows], stops)
        self.absent[rows] = (stops > self.length) | (self._store.partial & ~self.held[rows])
        self._bereave(np.arange(rows.start, min(rows.stop, len(self.index))))

    def take_tail(self, wanted: ByteRange) -> bytes:
        """Give the first bytes of a range, if they came with the opening and others are still to come."""
        start, data = self.tail
        if wanted.start != start or not data or wanted.size <= len(data):
            return b""
        self.tail = (0, b"")
        return data

    def ends_at(self, length: int) -> None:
        """Learn that the file is shorter than thought."""
        if length < self.length:
            self.length = length
            self.absent |= self.index.known & ~self.index.available(length)

    def add(self, node: int, cloud: Cloud, *, ahead: bool = False) -> list[int]:
        """Make a decoded cloud resident, or not if it came ahead of any want and there is no room; return what went."""
        self.clouds[node] = cloud
        return self.drop(self.residency.add(node, cloud.nbytes, ahead=ahead))

    def drop(self, nodes: list[int]) -> list[int]:
        """Let go of evicted clouds; return them."""
        for node in nodes:
            del self.clouds[node]
        return nodes

    def failed(self, key: int, tries: int) -> bool:
        """Count a damaged cloud or page; True if that was the last try and it stays missing."""
        self._store.reject(self.index.page_range(~key) if key < 0 else self.index.cloud_range(key))
        if key >= 0:
            self.held[key] = False
        self._failures[key] = self._failures.get(key, 0) + 1
        if self._failures[key] < tries:
            return False
        if key < 0:
            self.lost_pages.add(~key)
        else:
            self.absent[key] = True
            below = np.array([key])
            while below.size:
                below = self.index.children[below[self.index.known[below]]]
                below = below[below >= 0].astype(np.int64)
                self._bereave(below)
        return True

    def family(self, node: int) -> dict[int, Cloud | Corrupt] | int:
        """Give the clouds that a node's is told from, or the first of them that is not here."""
        line = ancestors(self.index, node)
        for above in line:
            if above not in self.clouds:
                return above
        return {above: self.clouds[above] for above in line}

    def wait(self, came: Arrived, above: int) -> None:
        """Keep what can only be decoded after a node."""
        self.waiting.setdefault(above, []).append(came)
        self.waiting_bytes += len(came.data)
        self._waiting_decoded += self._decoded_bytes(came)

    def release(self, above: int) -> list[Arrived]:
        """Give what waits for a node, and keep it no longer."""
        released = self.waiting.pop(above, [])
        self.waiting_bytes -= sum(len(came.data) for came in released)
        self._waiting_decoded -= sum(map(self._decoded_bytes, released))
        return released

    def forget(self, nodes: list[int]) -> None:
        """Let go of what waits for nodes, and of what waits for that: if it is wanted it is asked for again."""
        while nodes:
            for came in self.release(nodes.pop()):
                self.busy[came.item.key] = False
                nodes.append(came.item.key)

    def roomy(self, flying: list[int]) -> bool:
        """Whether there is room for more ahead of wants, beside what has come and waits and the clouds in flight."""
        flying = [node for node in flying if not (self.busy[node] or self.residency.resident[node])]
        return self.residency.roomy(self._waiting_decoded + int(self.index.samples[flying].sum()) * self._sample_bytes)

    def _decoded_bytes(self, came: Arrived) -> int:
        return int(self.index.samples[came.item.key]) * self._sample_bytes

    def _with_ancestors(self, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Put before nodes those that are not here and without which they cannot be decoded."""
        if not is_told(self.index.header):
            return nodes
        resident, parent = self.residency.resident, self.index.parent
        line, rank = nodes[self.index.linked[nodes]], np.flatnonzero(self.index.linked[nodes])
        left = np.full(len(line), ANCESTORS)
        found, ranks = [nodes], [np.arange(len(nodes))]
        while len(line):
            line = parent[line].astype(np.int64)
            here = resident[line] & (line >= 0)
            left = np.where(here, left - 1, ANCESTORS)  # whoever is not here needs its own, too
            up = (line >= 0) & (left > 0)
            line, rank, left, here = line[up], rank[up], left[up], here[up]
            found.append(line[~here])
            ranks.append(rank[~here])
        keys = np.concatenate(found)
        order = np.lexsort((keys, np.concatenate(ranks)))  # as urgent as the most urgent of its descendants
        keys = keys[order]
        _, first = np.unique(keys, return_index=True)
        return keys[np.sort(first)]

    def _bereave(self, nodes: NDArray[np.int64]) -> None:
        """Mark nodes as absent, in their order, whose parents are: nothing tells their clouds."""
        if not is_told(self.index.header):
            return
        nodes = nodes[self.index.known[nodes] & self.index.linked[nodes] & (nodes > 0)]
        while len(lost := nodes[self.absent[self.index.parent[nodes]] & ~self.absent[nodes]]):
            self.absent[lost] = True

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
        nodes = self._with_ancestors(nodes[~(self.residency.resident[nodes] | self.absent[nodes])])
        pages = self.index.missing_pages(wants[~known]) if not known.all() else np.empty(0, dtype=np.int64)
        here = [page for page in pages.tolist() if page not in self.lost_pages and self.has(self.page_item(page))]
        return np.array(here, dtype=np.int64), nodes

    def page_item(self, page: int) -> Item:
        """Return a page as an object to fetch; its key is ``~page``, those of clouds are their nodes."""
        place = self.index.page_range(page)
        return Item(~page, place.start, place.stop)

    def places(
        self, pages: NDArray[np.int64], nodes: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Keys of pages and clouds, where they start and stop in the file, and which the store holds itself."""
        places = np.array([self.page_item(page) for page in pages.tolist()], dtype=np.int64).reshape(-1, 3)
        start = self.index.offset[nodes]
        keys = np.concatenate([places[:, 0], nodes])
        starts = np.concatenate([places[:, 1], start])
        stops = np.concatenate([places[:, 2], start + self.index.size[nodes]])
        return keys, starts, stops, np.concatenate([self._store.holds(places[:, 1], places[:, 2]), self.held[nodes]])

    def has(self, item: Item) -> bool:
        """Whether the store can give an object."""
        return item.stop <= self.length and (not self._store.partial or self.holds(item))

    def holds(self, item: Item) -> bool:
        """Whether the store can give an object without asking over a link."""
        return bool(self._store.holds(np.array([item.start]), np.array([item.stop]))[0])

    def passed(self, item: Item, data: bytes) -> bool:
        """Note that a cloud's or page's bytes passed their checks; True if they were not held."""
        before = self.holds(item) if item.key < 0 else bool(self.held[item.key])
        kept = not before and self._store.vouch(ByteRange(item.start, item.stop), data)
        if item.key >= 0:
            self.held[item.key] |= kept
        return not before

    def items_before(self, stop: int, nodes: NDArray[np.int64]) -> list[Item]:
        """Clouds of `nodes`, and pages not yet loaded, that start before `stop` and end with the file or before."""
        starts, ends = self.index.offset[nodes], self.index.offset[nodes] + self.index.size[nodes]
        there = (starts < stop) & (ends <= self.length)
        inside = nodes[there & ~self.residency.resident[nodes] & ~self.busy[nodes]]
        items = [
            Item(node, int(self.index.offset[node]), int(self.index.offset[node] + self.index.size[node]))
            for node in inside.tolist()
        ]
        for page in np.flatnonzero(~self.index.page_loaded & (self.index.page_offset > 0)).tolist():
            item = self.page_item(page)
            if item.start < stop and item.stop <= self.length:
                items.append(item)
        return items
