"""Any store with the disk cache before it: what was checked once is not fetched again, and works without a network.

At its first read of a model that it knows, it asks the host for the header alone: if that is the header it has, the
build is the one it has, and everything held is given from the disk. If the host does not answer it goes on with what is
here, and asks again when something is missing. Only what passed its checks is kept (`vouch`), and what fails
them after all is dropped (`reject`). Whatever goes wrong with the disk ends the keeping, with one line in `warnings`.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Protocol

import numpy as np

from lpc.errors import FormatError, ModelChanged, Unavailable
from lpc.header import HEADER_PROBE, Header, parse_header
from lpc.page import page_bytes
from lpc.ranges import ByteRange, coalesce

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from pointstream.goodput import Goodput

    from .base import Sink, Store
    from .sparse import SparseFile

ANSWER_SECONDS = 5.0
"""How long the host may take to say that a model is still the one that is held, before that is believed."""
GAP = 4096
"""Bytes that are fetched again rather than making two requests."""
LOOKED = 16 << 20
"""Bytes kept between two looks at the size of the cache."""
MOST_WAITING = 8 << 20
"""Bytes waiting to be written, at most: a disk slower than the link keeps less."""


class Shelf(Protocol):
    """Where files are kept: `pointstream.cache.Cache`, or the one file that `fetch` fills."""

    def last_build(self, address: str) -> str | None:
        """Build id that stood at an address."""

    def remember(self, address: str, digest: str) -> None:
        """Note it."""

    def find(self, address: str, digest: str) -> Path | None:
        """File of a build, if there is one."""

    def open(self, address: str, header: Header) -> SparseFile:
        """Open it, made if need be."""

    def room(self, keep: Path, size: int) -> int:
        """Bytes that may be added to a file."""

    def clear(self, entry: Path) -> bool:
        """Throw a folder away that is of no use; False if it stays."""


class CachedStore:
    """A store with a cache before it.

    Parameters
    ----------
    upstream : Store
        Closed by `close`.
    cache : Shelf
    """

    partial = False

    def __init__(self, upstream: Store, cache: Shelf) -> None:
        self.upstream, self.cache = upstream, cache
        self.name = upstream.name
        self.meter: Goodput | None = upstream.meter
        self._file: SparseFile | None = None
        self._header: Header | None = None
        self._current = False  # the host has said that the build held is the one that it has
        self._asking = asyncio.Lock()
        self._warnings: dict[str, str] = {}
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="cache")
        self._keeping = True
        self._waiting = 0
        self._room = 0

    def __repr__(self) -> str:
        return f"<CachedStore of {self.upstream!r} in {self.cache!r}>"

    @property
    def warnings(self) -> tuple[str, ...]:
        """What had to be done without, once each."""
        return (*self.upstream.warnings, *self._warnings.values())

    @property
    def length(self) -> int | None:
        """Bytes of the file where it comes from; while that is not known, of the model held."""
        if self.upstream.length is None and self._header is not None:
            return self._header.bytes
        return self.upstream.length

    @property
    def waiting(self) -> int:
        """Bytes on their way to the disk."""
        return self._waiting

    @property
    def held_bytes(self) -> int:
        """Bytes of the model on the disk."""
        return 0 if self._file is None else self._file.present.total

    @property
    def broken(self) -> str | None:
        """Why nothing is kept any more, if so."""
        return self._warnings.get("disk")

    async def opening_bytes(self) -> int:
        """Return the end of the clouds held at the start of the file, inside the usual first request."""
        if self._file is None:
            await self._recall()
        if self._file is None or self._header is None:
            return await self.upstream.opening_bytes()
        holes = self._file.missing(ByteRange(0, min(HEADER_PROBE, self._header.bytes)))
        stop = holes[0].start if holes else HEADER_PROBE
        first_page = self._header.page0 + page_bytes(self._header, 0)
        return stop if stop >= first_page else HEADER_PROBE

    async def read(self, wanted: ByteRange, sink: Sink | None = None) -> bytes:
        """Read a range: what is held from the disk, the rest from upstream."""
        file = self._file
        if file is None:
            return await self.upstream.read(wanted, sink)
        stop = wanted.stop if self.length is None else min(wanted.stop, self.length)
        if stop <= wanted.start:
            return b""
        wanted = ByteRange(wanted.start, stop)
        holes = coalesce(file.missing(wanted), GAP, wanted.size)
        data, offset = b"", wanted.start
        for hole in sorted(place for place, _ in holes):
            if offset < hole.start:
                data += await self._from_disk(file, ByteRange(offset, hole.start), sink)
            if not self._current:
                await self._ask()
            part = await self.upstream.read(hole, sink)
            data, offset = data + part, hole.stop
            if len(part) < hole.size:
                return data
        if offset < wanted.stop:
            data += await self._from_disk(file, ByteRange(offset, wanted.stop), sink)
        return data

    def holds(self, starts: NDArray[np.int64], stops: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which ranges are on the disk."""
        return np.zeros(len(starts), dtype=bool) if self._file is None else self._file.holds(starts, stops)

    def vouch(self, place: ByteRange, data: bytes) -> bool:
        """Write bytes that passed their checks, in a thread."""
        if not self._keeping:
            return False
        if place.start == 0:
            self._begin(data)
        file = self._file
        if file is None or self._waiting + len(data) > MOST_WAITING:
            return False
        if not file.missing(place):
            return True
        self._waiting += len(data)
        work = asyncio.get_running_loop().run_in_executor(self._writer, self._keep, file, place, data)
        work.add_done_callback(lambda done: self._kept(len(data), done))
        return True

    def reject(self, place: ByteRange) -> None:
        """Drop bytes that fail their checks."""
        if self._file is not None and not self._file.missing(place):
            try:
                self._file.drop(place)
            except OSError as error:
                self._give_up(error)
        else:
            self.upstream.reject(place)

    def forget(self, *, distrust_tags: bool = False) -> None:
        """Learn anew which build stands there."""
        self.upstream.forget(distrust_tags=distrust_tags)
        if not distrust_tags:
            self._let_go()

    async def flush(self) -> None:
        """Wait until everything kept so far is on the disk and in the map."""
        if (file := self._file) is not None:
            try:
                await asyncio.get_running_loop().run_in_executor(self._writer, file.flush)
            except (OSError, ValueError) as error:
                self._give_up(error)

    async def close(self) -> None:
        """Write what waits, and close both."""
        self._let_go()
        await asyncio.get_running_loop().run_in_executor(None, self._writer.shutdown)
        await self.upstream.close()

    async def _from_disk(self, file: SparseFile, place: ByteRange, sink: Sink | None) -> bytes:
        try:
            data = await asyncio.get_running_loop().run_in_executor(None, file.read, place)
        except (OSError, ValueError) as error:  # ValueError: closed meanwhile
            if file is self._file:
                self._file = None
                self._writer.submit(self._close, file)
                self._give_up(error)
            return await self.upstream.read(place, sink)
        if sink is not None:
            sink(place.start, data)
        return data

    async def _recall(self) -> None:
        """Open what is held of the model that stood at the address last; ask the host whether it still does."""
        digest = self.cache.last_build(self.name)
        path = None if digest is None else self.cache.find(self.name, digest)
        if path is None:
            return
        try:
            with path.open("rb") as start:
                header = parse_header(start.read(HEADER_PROBE))
            if header.digest != digest:
                raise OSError(f"{path} is another build")
            file = self.cache.open(self.name, header)
        except (OSError, FormatError):
            self.cache.clear(path.parent)
            return
        if file.missing(ByteRange(0, header.page0)):
            file.close()
            return
        self._file, self._header = file, header
        try:
            async with asyncio.timeout(ANSWER_SECONDS):
                await self._ask()
        except (Unavailable, TimeoutError):
            self._warnings["host"] = f"{self.name} does not answer: this is what the cache holds of it"
        except ModelChanged:
            self._let_go()

    async def _ask(self) -> None:
        """Ask the host for the header; ModelChanged if it is not the one that is held."""
        async with self._asking:
            if self._current or self._file is None or self._header is None:
                return
            place = ByteRange(0, self._header.page0)
            fresh = await self.upstream.read(place)
            if fresh != await self._from_disk(self._file, place, None):
                raise ModelChanged(f"{self.name}: another build of the model stands there now than the cache holds")
            self._current = True

    def _begin(self, data: bytes) -> None:
        """Open the file of the build whose header this is."""
        if self._file is not None:
            return
        self._header = parse_header(data)
        try:
            self._file = self.cache.open(self.name, self._header)
            self.cache.remember(self.name, self._header.digest)
        except OSError as error:
            self._give_up(error)
        self._current = True
        self._room = 0

    def _keep(self, file: SparseFile, place: ByteRange, data: bytes) -> None:
        if self._room < place.size:
            self._room = min(self.cache.room(file.path, place.size), LOOKED)
        if self._room >= place.size:
            file.keep(place, data)
            self._room -= place.size

    def _kept(self, size: int, done: asyncio.Future[None]) -> None:
        self._waiting -= size
        if not done.cancelled() and (error := done.exception()) is not None:
            if not isinstance(error, OSError | ValueError):
                raise error
            self._give_up(error)

    def _let_go(self) -> None:
        """Close the file once what waits is written."""
        file, self._file, self._header, self._current = self._file, None, None, False
        if file is not None:
            self._writer.submit(self._close, file)

    def _close(self, file: SparseFile) -> None:
        try:
            file.close()
        except OSError as error:
            self._warn(error)

    def _give_up(self, error: Exception) -> None:
        """Keep nothing any more; what is held goes on being read."""
        self._keeping = False
        self._warn(error)

    def _warn(self, error: Exception) -> None:
        reason = getattr(error, "strerror", None) or str(error)
        self._warnings.setdefault("disk", f"{self.cache} cannot be used ({reason}): going on without it")
