"""Whole regions of a model, outside any frame loop: which nodes, and their clouds in file order.

Requests are merged runs of neighbours, a few in flight at a time; each run is decoded in a thread as it arrives, so
memory holds a few runs whatever the size of the model.
"""

from __future__ import annotations

import asyncio
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lpc.errors import Corrupt, ModelChanged
from lpc.page import page_bytes
from lpc.ranges import ByteRange, coalesce

from .decoding import decode_checked
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
    """

    max_gap: int = 4096
    max_bytes: int = 1 << 19
    parallel: int = 4
    threads: int = 2
    tries: int = 3


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
        return nodes[self.reaches(index.offset[nodes], index.offset[nodes] + index.size[nodes])]

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
        index = self.index
        return np.flatnonzero(index.known & self.reaches(index.offset, index.offset + index.size))

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

        Raises
        ------
        StoreError
        """
        nodes = np.sort(nodes)
        ranges = [self.index.cloud_range(node) for node in nodes.tolist()]
        plan = coalesce(ranges, self.options.max_gap, self.options.max_bytes)
        plan.sort(key=lambda run: run[0].start)
        with ThreadPoolExecutor(self.options.threads, thread_name_prefix="decode") as threads:
            going: deque[asyncio.Task[list[tuple[int, Cloud | Corrupt]]]] = deque()
            try:
                for place, members in plan:
                    going.append(asyncio.create_task(self._run(threads, place, nodes[members].tolist())))
                    if len(going) >= self.options.parallel:
                        for pair in await going.popleft():
                            yield pair
                while going:
                    for pair in await going.popleft():
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

    async def _run(
        self, threads: ThreadPoolExecutor, place: ByteRange, nodes: list[int]
    ) -> list[tuple[int, Cloud | Corrupt]]:
        body = await self.read(place)
        loop = asyncio.get_running_loop()
        parts = [bytes(place.within(body, self.index.cloud_range(node))) for node in nodes]
        clouds = await loop.run_in_executor(threads, self._decode, nodes, parts)
        for number, node in enumerate(nodes):
            place = self.index.cloud_range(node)
            for _ in range(self.options.tries - 1):
                if not isinstance(clouds[number], Corrupt):
                    break
                self._reject(place)
                parts[number] = await self.read(place)
                clouds[number : number + 1] = await loop.run_in_executor(threads, self._decode, [node], [parts[number]])
            if not isinstance(clouds[number], Corrupt):
                self.store.vouch(place, parts[number])
        return list(zip(nodes, clouds, strict=True))

    def _decode(self, nodes: list[int], parts: list[bytes]) -> list[Cloud | Corrupt]:
        clouds: list[Cloud | Corrupt] = []
        for node, part in zip(nodes, parts, strict=True):
            try:
                clouds.append(decode_checked(part, node=node, index=self.index))
            except Corrupt as error:
                clouds.append(error)
        return clouds


def _children(index: IndexTree, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    children = index.children[nodes].ravel()
    return children[children >= 0].astype(np.int64)
