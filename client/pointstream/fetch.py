"""Offline copies: all of a model, or what a region of it needs, checked, resumable at any moment.

The copy is filled as a cache is (stores/cached.py), and all that holds for the cache holds for it: only bytes that
passed their checks are written, a killed process loses at most the last mebibyte, what is there is not fetched again.
"""

from __future__ import annotations

import asyncio
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

import numpy as np

from lpc.errors import Corrupt, FormatError, StoreError, Unavailable
from lpc.header import HEADER_PROBE, Header, compute_digest, parse_header
from lpc.page import PAGE_HEADER
from lpc.ranges import ByteRange

from .lineage import Untold
from .reading import EVERYTHING, Reader, ReadingOptions, Region
from .stores.cached import CachedStore
from .stores.sparse import SparseFile, map_path

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from .stores import Store

RUN = 1 << 16
"""Bytes of a request: what an interruption may cost, a few times."""
WAITING = 1 << 20
"""Bytes on their way to the disk before more are asked for."""
FIRST_PAUSE, LONGEST_PAUSE = 1.0, 10.0
"""Seconds between two tries while the host does not answer; they double."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FetchOptions:
    """What to copy.

    Parameters
    ----------
    region : Region
    most_bytes : int, optional
        Bytes of the model in the copy, at most, whatever brought them; the coarsest come first. A copy that holds more
        already keeps it.
    patience : float
        Seconds to wait for a host that gives nothing.
    """

    region: Region = EVERYTHING
    most_bytes: int | None = None
    patience: float = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FetchReport:
    """What the copy holds now.

    Parameters
    ----------
    path : str
    clouds, clouds_total : int
        In the copy, and in the model.
    bytes, bytes_total : int
        Likewise.
    bytes_fetched : int
        Those of them that came in this run.
    complete : bool
        The copy is the model, byte for byte.
    cut_short : bool
        The model that it was copied from is not all there itself.
    problems : tuple of str
        Clouds that stayed damaged.
    """

    path: str
    clouds: int
    clouds_total: int
    bytes: int
    bytes_total: int
    bytes_fetched: int
    complete: bool
    cut_short: bool = False
    problems: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Give what ``pointstream fetch --json`` prints."""
        return {name: getattr(self, name) for name in self.__slots__} | {"problems": list(self.problems)}


class Copy:
    """The one file that is filled: what a cache is to `CachedStore`."""

    def __init__(self, path: Path, most_bytes: int | None = None) -> None:
        self.path = path
        self._most_bytes = most_bytes
        self._file: SparseFile | None = None
        self.before: int | None = None  # bytes that it held when it was opened

    def __str__(self) -> str:
        return str(self.path)

    def last_build(self, address: str) -> str | None:
        """Build id of what is there already."""
        del address
        header = self._header()
        return None if header is None else header.digest

    def remember(self, address: str, digest: str) -> None:
        """Do nothing: the file itself says what it is."""

    def find(self, address: str, digest: str) -> Path | None:
        """Return the file, if it is there."""
        del address, digest
        return self.path if self.path.is_file() else None

    def open(self, address: str, header: Header) -> SparseFile:
        """Open the file to be filled.

        Raises
        ------
        StoreError
            If something else stands in its place.
        """
        del address
        self.path.parent.mkdir(parents=True, exist_ok=True)
        there = self._header()
        if there is not None and there.digest != header.digest:
            raise StoreError(f"{self.path} holds another build of the model: move it away, or name another folder")
        if there is None and self.path.exists() and not map_path(self.path).is_file():
            raise StoreError(f"{self.path} is something else: move it away, or name another folder")
        self._file = SparseFile(self.path, length=header.bytes, tag=header.tag)
        if self.before is None:
            self.before = self._file.present.total
        return self._file

    def room(self, keep: Path, size: int) -> int:
        """Set no bound but the disk's, and the one that was asked for."""
        del keep, size
        if self._most_bytes is None or self._file is None:
            return 1 << 62
        return max(0, self._most_bytes - self._file.present.total)

    def clear(self, entry: Path) -> bool:
        """Throw nothing of a person's away."""
        del entry
        return False

    def _header(self) -> Header | None:
        try:
            with self.path.open("rb") as file:
                return parse_header(file.read(HEADER_PROBE))
        except (OSError, FormatError):
            return None


def copy_name(target: str) -> str:
    """Return the file name for a copy of a path or address."""
    name = unquote(urlsplit(target).path).replace("\\", "/").rpartition("/")[2].replace("\0", "")
    return name if name not in ("", ".", "..") else "model.lpc"


async def fetch(
    store: Store,
    out: Path,
    options: FetchOptions | None = None,
    *,
    begin: Callable[[int], Callable[[int], None]] = lambda _: lambda _: None,
) -> FetchReport:
    """Copy a model, or go on with a copy that was begun.

    Parameters
    ----------
    store : Store
        Closed here.
    out : Path
        The file.
    options : FetchOptions, optional
    begin : callable
        Called once with the bytes to come; gives what is called with the number of bytes just come.

    Raises
    ------
    StoreError, FormatError
        If the host fails for longer than the patience or the file cannot be written; what came stays.
    """
    options = options or FetchOptions()
    place = Copy(out, options.most_bytes)
    filled = CachedStore(store, place)
    try:
        fetching = _Fetching(filled, place, options)
        return await fetching.run(begin)
    finally:
        await filled.close()


class _Fetching:
    """One run."""

    def __init__(self, store: CachedStore, place: Copy, options: FetchOptions) -> None:
        self.store, self.place, self.out, self.options = store, place, place.path, options
        self.problems: dict[int, str] = {}
        self.reader: Reader

    async def run(self, begin: Callable[[int], Callable[[int], None]]) -> FetchReport:
        self.reader = await Reader.open(self.store, ReadingOptions(max_bytes=RUN))
        self._check_least()
        await self.store.flush()  # what came is on its way to the disk
        self._check_disk()
        if self.reader.index.header.digest != self.store.cache.last_build(self.store.name):
            raise StoreError(f"{self.out} cannot be written: name another folder")
        most = self.options.most_bytes
        nodes = await self._waiting_for_host(lambda: self.reader.select(self.options.region, most_bytes=most))
        await self.store.flush()
        nodes = self._within_budget(nodes)
        missing = self._missing(nodes)
        advance = begin(int(self.reader.index.size[missing].sum()))
        await self._waiting_for_host(lambda: self._bring(nodes, advance))
        await self.store.flush()
        self._check_disk()
        bad = await asyncio.get_running_loop().run_in_executor(None, self._check_copy, nodes)
        if len(bad):  # what the disk damaged comes once more
            await self._bring(nodes, advance)
            await self.store.flush()
            self._check_disk()
        return self._report()

    def _check_least(self) -> None:
        index, most = self.reader.index, self.options.most_bytes
        least = index.page_range(0).stop
        if most is not None and most < least:
            raise StoreError(f"{self.out}: {most:,} bytes hold no copy; header and first page alone take {least:,}")

    def _check_disk(self) -> None:
        if self.store.broken is not None:
            raise StoreError(self.store.broken.replace(": going on without it", ""))

    def _missing(self, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
        index = self.reader.index
        nodes = nodes[~self.store.holds(index.offset[nodes], index.offset[nodes] + index.size[nodes])]
        return nodes[~np.isin(nodes, list(self.problems))]

    def _within_budget(self, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
        if self.options.most_bytes is None:
            return nodes
        index = self.reader.index
        pages = np.unique(nodes // index.header.page_nodes)
        kept = [self.store.holds(*_ends(index.page_range(page)))[0] for page in pages.tolist()]
        nodes = nodes[np.isin(nodes // index.header.page_nodes, pages[kept])]  # of no use without their pages
        cost = np.where(
            self.store.holds(index.offset[nodes], index.offset[nodes] + index.size[nodes]), 0, index.size[nodes]
        )
        return nodes[self.store.held_bytes + np.cumsum(cost) <= self.options.most_bytes]

    async def _bring(self, nodes: NDArray[np.int64], advance: Callable[[int], None]) -> None:
        index = self.reader.index
        async for node, cloud in self.reader.clouds(self._missing(nodes)):
            advance(int(index.size[node]))
            if isinstance(cloud, Corrupt) and not isinstance(cloud, Untold):
                self.problems[node] = str(cloud)
            if self.store.waiting > WAITING:
                await self.store.flush()
            self._check_disk()

    async def _waiting_for_host(self, work: Callable[[], Any]) -> Any:
        """Do something, again after pauses while the host does not answer and nothing has come for too long."""
        clock = asyncio.get_running_loop().time
        pause, since, before = FIRST_PAUSE, clock(), self.store.held_bytes
        while True:
            try:
                return await work()
            except Unavailable as error:
                if self.store.held_bytes > before:
                    pause, since, before = FIRST_PAUSE, clock(), self.store.held_bytes
                if clock() - since > self.options.patience:
                    raise Unavailable(f"{error}; run the same command again to go on") from error
                await asyncio.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE)

    def _check_copy(self, nodes: NDArray[np.int64]) -> list[int]:
        """Read the copy back; what is not on the disk as it should be is dropped from the map."""
        index, bad = self.reader.index, []
        with self.out.open("rb") as file:
            for node in nodes.tolist():
                if node in self.problems:
                    continue
                place = index.cloud_range(node)
                file.seek(place.start)
                if zlib.crc32(file.read(place.size)) != int(index.crc[node]):
                    self.store.reject(place)
                    bad.append(node)
            if index.page_loaded.all():
                self._check_digest(file)
        return bad

    def _check_digest(self, file: Any) -> None:
        """Check that header and records are those of the build id, once all of them are here."""
        index, records = self.reader.index, []
        for page in range(len(index.page_loaded)):
            place = index.page_range(page)
            file.seek(place.start)
            records.append(file.read(place.size)[PAGE_HEADER:])
        if compute_digest(index.header, records) != index.header.digest:
            raise Corrupt(f"{self.store.name}: its index is not that of its build id: ask its publisher for it anew")

    def _report(self) -> FetchReport:
        index = self.reader.index
        known = np.flatnonzero(index.known)
        held = self.store.holds(index.offset[known], index.offset[known] + index.size[known])
        whole = bool(self.store.holds(*_ends(ByteRange(0, index.header.bytes)))[0])
        return FetchReport(
            path=str(self.out),
            clouds=int(held.sum()),
            clouds_total=index.header.nodes,
            bytes=self.store.held_bytes,
            bytes_total=index.header.bytes,
            bytes_fetched=self.store.held_bytes - (self.place.before or 0),
            complete=whole,
            cut_short=not self.reader.complete,
            problems=tuple(f"{text}; it is missing in the copy" for text in self.problems.values()),
        )


def _ends(place: ByteRange) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    return np.array([place.start]), np.array([place.stop])
