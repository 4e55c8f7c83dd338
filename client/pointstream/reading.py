"""Whole regions of a model, outside any frame loop: which nodes, and their clouds in file order.

Requests are merged runs of neighbours, a few in flight at a time; each run is decoded in a thread as it arrives, so
memory holds a few runs whatever the size of the model.
"""

from __future__ import annotations

import asyncio
from collections import ChainMap, deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import compress
from typing import TYPE_CHECKING

import numpy as np

from lpc.context import is_told
from lpc.errors import Corrupt, ModelChanged
from lpc.page import page_bytes
from lpc.ranges import ByteRange, coalesce

from .decoding import decode_checked
from .lineage import Family, Lineage, Untold, ancestors
from .opening import add_page, open_index

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from numpy.typing import NDArray

    from lpc.cloud import Cloud
    from lpc.index import IndexTree

    from .stores import Store


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadingOptions:
    """Parameters of bulk reading.

    Parameters
    ----------
    max_gap, max_bytes : int
        Of a merged run, bytes.
    parallel : int
        Runs that are on their way or being decoded.
    threads : int
        That decode.
    tries : int
        Fetches of something that fails its checks.
    family_bytes : int
        Decoded clouds to keep, because others are told from them.
    """

    max_gap: int = 4096
    max_bytes: int = 1 << 19
    parallel: int = 4
    threads: int = 2
    tries: int = 3
    family_bytes: int = 1 << 27


@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """What of a model is meant.

    Parameters
    ----------
    bounds : tuple of 6 floats, optional
        x0, y0, z0, x1, y1, z1, model units, both ends included.
    spacing : float, optional
        Detail that is enough, model units: a node is refined while a picture that ends at it is coarser, as refinement
        for the screen has it (`lpc.density`).
    level : int, optional
        Deepest level, 0 for the root.
    """

    bounds: tuple[float, float, float, float, float, float] | None = None
    spacing: float | None = None
    level: int | None = None

    def __post_init__(self) -> None:
        if self.bounds is not None and not all(a <= b for a, b in zip(self.bounds[:3], self.bounds[3:], strict=True)):
            raise ValueError(f"bounds {self.bounds} are not x0,y0,z0,x1,y1,z1 with each first at most its second")
        if self.spacing is not None and not self.spacing > 0:
            raise ValueError(f"a spacing of {self.spacing} is not a positive length")
        if self.level is not None and self.level < 0:
            raise ValueError(f"level {self.level} is below 0")

    def touches(self, index: IndexTree, nodes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which nodes may have samples inside, by their spheres."""
        if self.bounds is None:
            return np.ones(len(nodes), dtype=bool)
        low, high = np.array(self.bounds[:3]), np.array(self.bounds[3:])
        center = index.center[nodes]
        away = np.maximum(low - center, 0) + np.maximum(center - high, 0)
        # A hair more than the sphere: comparing must not lose a sample to rounding.
        return np.asarray((away**2).sum(axis=1) <= (index.radius[nodes] * (1 + 1e-9)) ** 2 + 1e-300)

    def deeper(self, index: IndexTree, nodes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which nodes are too coarse."""
        more = np.ones(len(nodes), dtype=bool)
        if self.spacing is not None:
            more &= index.density.coarseness[nodes] > self.spacing
        if self.level is not None:
            more &= index.level[nodes] < self.level
        return more

    def inside(self, xyz: NDArray[np.float64]) -> NDArray[np.bool_] | slice:
        """Which samples are inside the bounds."""
        if self.bounds is None:
            return slice(None)
        return np.asarray(((xyz >= self.bounds[:3]) & (xyz <= self.bounds[3:])).all(axis=1))


EVERYTHING = Region()


class Reader:
    """Bulk access to one build of a model; belongs to one event loop.

    Parameters
    ----------
    store : Store
    index : IndexTree
        Grows as pages are read.
    options : ReadingOptions, optional
    start : bytes
        The file's first bytes, which are not read again.
    """

    def __init__(
        self, store: Store, index: IndexTree, options: ReadingOptions | None = None, *, start: bytes = b""
    ) -> None:
        self.store, self.index = store, index
        self.options = options or ReadingOptions()
        self._start = start

    @classmethod
    async def open(cls, store: Store, options: ReadingOptions | None = None) -> Reader:
        """Open a model with one request of `HEADER_PROBE` bytes.

        Raises
        ------
        StoreError, FormatError
        """
        index, start = await open_index(store)
        return cls(store, index, options, start=start)

    @property
    def length(self) -> int:
        """Where what is there of the file ends."""
        size = self.index.header.bytes
        return size if self.store.length is None else min(size, self.store.length)

    @property
    def complete(self) -> bool:
        """Whether all of the file is there."""
        size = self.index.header.bytes
        whole = not self.store.partial or bool(self.store.holds(np.array([0]), np.array([size]))[0])
        return whole and self.length >= size

    def reaches(self, starts: NDArray[np.int64], stops: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which ranges are there."""
        here = stops <= self.length
        return np.asarray(here & self.store.holds(starts, stops) if self.store.partial else here)

    async def select(self, region: Region = EVERYTHING, *, most_bytes: int | None = None) -> NDArray[np.int64]:
        """Find the nodes of a region, reading pages as needed; nodes that the file no longer has are left out.

        Parameters
        ----------
        region : Region
        most_bytes : int, optional
            Look no deeper once the nodes of some levels have more bytes than that.

        Raises
        ------
        StoreError, FormatError
        """
        index = self.index
        while True:
            loaded = int(index.page_loaded.sum())
            nodes = await self._descend(region, most_bytes)
            if region.spacing is None or int(index.page_loaded.sum()) == loaded:
                break  # pages of uneven cells tell how coarse the nodes above them are
        nodes = nodes[self._there(nodes)]
        if self.store.partial and is_told(index.header):  # nor what is told from those
            here = np.zeros(len(index), dtype=bool)
            here[nodes] = True
            while not (told := here[index.parent[nodes]] | (nodes == 0)).all():
                here[nodes[~told]] = False
                nodes = nodes[told]
        return nodes

    def _there(self, nodes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which clouds are there."""
        return self.reaches(self.index.offset[nodes], self.index.offset[nodes] + self.index.size[nodes])

    async def _descend(self, region: Region, most_bytes: int | None) -> NDArray[np.int64]:
        """Go down the tree by what its pages say now; return nodes in order."""
        index, found, size = self.index, [], 0
        frontier = np.zeros(1, dtype=np.int64)
        while len(frontier) and (most_bytes is None or size <= most_bytes):
            await self.load_pages(frontier)
            frontier = frontier[index.known[frontier]]
            frontier = frontier[region.touches(index, frontier)]
            found.append(frontier)
            size += int(index.size[frontier].sum())
            if region.spacing is not None:
                await self.load_pages(_children(index, frontier))
            frontier = _children(index, frontier[region.deeper(index, frontier)])
        return np.sort(np.concatenate(found))

    async def present(self) -> NDArray[np.int64]:
        """Find all nodes that are there; those that only a damaged page leads to are not found.

        Raises
        ------
        StoreError
        """
        with suppress(Corrupt):
            await self.select()
        nodes = np.flatnonzero(self.index.known)
        return nodes[self._there(nodes)]

    async def load_pages(self, nodes: NDArray[np.int64]) -> None:
        """Read the pages of these nodes, as far as the file reaches.

        Raises
        ------
        StoreError, FormatError
        """
        pages = self.index.missing_pages(nodes)
        starts = self.index.page_offset[pages]
        sizes = np.array([page_bytes(self.index.header, page) for page in pages.tolist()], dtype=np.int64)
        pages = pages[self.reaches(starts, starts + sizes)].tolist()
        ranges = [self.index.page_range(page) for page in pages]
        plan = coalesce(ranges, self.options.max_gap, self.options.max_bytes)
        for start in range(0, len(plan), self.options.parallel):
            runs = plan[start : start + self.options.parallel]
            bodies = await self._together([place for place, _ in runs])
            for (place, members), body in zip(runs, bodies, strict=True):
                for member in members:
                    await self._add_page(pages[member], bytes(place.within(body, ranges[member])))

    async def clouds(self, nodes: NDArray[np.int64]) -> AsyncIterator[tuple[int, Cloud | Corrupt]]:
        """Give the clouds of nodes in file order, each as soon as its turn comes; one that stays damaged as an error.

        A sound cloud that is told from a damaged one is an `Untold`.

        Raises
        ------
        StoreError
        """
        nodes = np.sort(nodes)
        ranges = [self.index.cloud_range(node) for node in nodes.tolist()]
        plan = coalesce(ranges, self.options.max_gap, self.options.max_bytes)
        plan.sort(key=lambda run: run[0].start)
        lineage = Lineage(self.index, self.options.family_bytes)
        with ThreadPoolExecutor(self.options.threads, thread_name_prefix="decode") as threads:
            going: deque[asyncio.Task[bytes]] = deque()
            try:
                for number, (place, members) in enumerate(plan):
                    for ahead, _ in plan[number + len(going) : number + self.options.parallel]:
                        going.append(asyncio.create_task(self.read(ahead)))
                    body = await going.popleft()
                    for pair in await self._decode_run(threads, lineage, place, body, nodes[members].tolist()):
                        yield pair
            finally:
                for task in going:
                    task.cancel()
                await asyncio.gather(*going, return_exceptions=True)

    async def read(self, wanted: ByteRange) -> bytes:
        """Read a range of this build and of no other.

        Raises
        ------
        StoreError
        """
        here = self._start[wanted.start : wanted.stop]
        if len(here) == wanted.size:
            return here
        return here + await self._read(ByteRange(wanted.start + len(here), wanted.stop))

    async def _read(self, wanted: ByteRange) -> bytes:
        try:
            return await self.store.read(wanted)
        except ModelChanged:
            # Hosts behind several edges give one file several tags: look whether it is another build at all.
            self.store.forget()
            fresh, _ = await open_index(self.store)
            if fresh.header.digest != self.index.header.digest:
                raise
            self.store.forget(distrust_tags=True)
            return await self.store.read(wanted)

    def _reject(self, place: ByteRange) -> None:
        """Note that a range is damaged: neither the store nor what was kept of the opening gives it again."""
        self._start = self._start[: place.start]
        self.store.reject(place)

    async def _together(self, places: list[ByteRange]) -> list[bytes]:
        """Read ranges at the same time; if one fails the others are cut off."""
        tasks = [asyncio.create_task(self.read(place)) for place in places]
        try:
            return await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _add_page(self, page: int, data: bytes) -> None:
        place = self.index.page_range(page)
        for _ in range(self.options.tries - 1):
            try:
                add_page(self.index, page, data)
            except Corrupt:
                self._reject(place)
                data = await self.read(place)
            else:
                break
        else:
            add_page(self.index, page, data)
        self.store.vouch(place, data)

    async def _decode_run(
        self, threads: ThreadPoolExecutor, lineage: Lineage, place: ByteRange, body: bytes, nodes: list[int]
    ) -> list[tuple[int, Cloud | Corrupt]]:
        """Decode the nodes of a run, after those of their ancestors that are not at hand."""
        family, missing = lineage.family(nodes)
        gone = ~self._there(np.array(missing, dtype=np.int64))
        family |= {node: Corrupt(f"cloud {node}: it is not in this copy") for node in compress(missing, gone)}
        missing = [node for node in missing if node not in family]
        order = sorted([*nodes, *missing])
        parts = {node: bytes(place.within(body, self.index.cloud_range(node))) for node in nodes}
        for start in range(0, len(missing), self.options.parallel):
            some = missing[start : start + self.options.parallel]
            bodies = await self._together([self.index.cloud_range(node) for node in some])
            parts |= dict(zip(some, bodies, strict=True))
        loop = asyncio.get_running_loop()
        # Those of one run are as a rule no ancestors of each other.
        apart = not missing and all(int(self.index.parent[node]) < order[0] for node in order)
        cut = len(order) // 2 if apart and self.options.threads > 1 else 0
        halves = [half for half in (order[:cut], order[cut:]) if half]
        for found in await asyncio.gather(
            *(loop.run_in_executor(threads, self._decode, half, parts, family) for half in halves)
        ):
            family |= found
        for node in order:
            place, tries = self.index.cloud_range(node), self.options.tries
            while isinstance(family[node], Corrupt):
                if isinstance(family[node], Untold):
                    above = ancestors(self.index, node)
                    if not above or any(isinstance(family[each], Corrupt) for each in above):
                        break
                else:
                    tries -= 1
                    if tries == 0:
                        break
                    self._reject(place)
                    parts[node] = await self.read(place)
                family |= await loop.run_in_executor(threads, self._decode, [node], parts, family)
            if isinstance(family[node], Untold) or not isinstance(family[node], Corrupt):
                self.store.vouch(place, parts[node])
        lineage.keep(family)
        return [(node, family[node]) for node in nodes]

    def _decode(self, nodes: list[int], parts: dict[int, bytes], family: Family) -> Family:
        """Decode nodes, coarse first; `family` has the ancestors that are not among them."""
        found: Family = {}
        known = ChainMap(found, family)
        for node in nodes:
            try:
                found[node] = decode_checked(parts[node], node=node, index=self.index, family=known)
            except Corrupt as error:
                found[node] = error
        return found


def _children(index: IndexTree, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    children = index.children[nodes].ravel()
    return children[children >= 0].astype(np.int64)
