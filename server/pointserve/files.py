"""Open descriptors of the files that are being served, kept from request to request.

A request costs no `stat` and no `open`: a descriptor is opened once and its directory entry looked at again at most
once in `recheck` seconds. When another file stands there (device, inode, modification time or size differ), the next
request opens that one; replies that are under way go on reading the old one, which a rename does not touch, and the
last of them closes it. Reads name their position, so any number of replies share a descriptor. Files are never
mapped: a mapped file that is cut short kills the process.

Everything here runs on the event loop's thread; only reads that would wait for a disk leave it.
"""

from __future__ import annotations

import asyncio
import errno
import io
import os
import stat
from collections import OrderedDict
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Self

from lpc.errors import FormatError, NotFound, Unavailable
from lpc.header import HEADER_PROBE, PART_SUFFIX, parse_header

from .paths import MODEL_SUFFIX, content_type, is_plain_name
from .preconditions import FileFacts

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

Identity = tuple[int, int, int, int]

_READ_WITHOUT_WAITING: int | None = getattr(os, "RWF_NOWAIT", None)
_HOST_IN_TROUBLE = {errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EIO}


class OpenFile:
    """A descriptor and what was true of its file when it was opened."""

    __slots__ = ("_nowait", "_readers", "_retired", "checked", "facts", "file", "identity")

    def __init__(self, file: io.FileIO, facts: FileFacts, identity: Identity, checked: float) -> None:
        self.file = file
        self.facts = facts
        self.identity = identity
        self.checked = checked
        self._nowait = _READ_WITHOUT_WAITING
        self._readers = 0
        self._retired = False

    async def read(self, start: int, size: int) -> bytearray:
        """Read at a position; shorter than `size` only where the file ends.

        What the page cache holds is read at once; only a read that would wait for the disk goes to a thread, where it
        holds up nobody else.
        """
        buffer = bytearray(size)
        done = self._read_cached(buffer, start)
        if done < size:
            done = await asyncio.get_running_loop().run_in_executor(None, self._read_waiting, buffer, start, done)
        if done < size:
            del buffer[done:]
        return buffer

    def _read_cached(self, buffer: bytearray, start: int) -> int:
        if self._nowait is None:
            return 0
        try:
            return os.preadv(self.file.fileno(), [buffer], start, self._nowait)
        except BlockingIOError:
            return 0
        except OSError:
            self._nowait = None  # not a thing of this file system: every read goes to a thread
            return 0

    def _read_waiting(self, buffer: bytearray, start: int, done: int) -> int:
        view = memoryview(buffer)
        while done < len(view) and (got := os.preadv(self.file.fileno(), [view[done:]], start + done)):
            done += got
        return done

    @contextmanager
    def lease(self) -> Iterator[Self]:
        """Keep the descriptor open for the length of a reply."""
        self._readers += 1
        try:
            yield self
        finally:
            self._readers -= 1
            self._close_if_unused()

    def retire(self) -> None:
        """Close the descriptor as soon as no reply reads from it."""
        self._retired = True
        self._close_if_unused()

    def _close_if_unused(self) -> None:
        if self._retired and self._readers == 0:
            self.file.close()


class FileStore:
    """Files below a folder, by the names of `paths.model_names`.

    Parameters
    ----------
    root : Path
        The served folder. Symbolic links below it are followed as long as they end below it.
    clock : callable of float
        Monotonic seconds.
    wall : callable of float
        Seconds since 1970, for Last-Modified.
    recheck : float
        Seconds for which a directory entry is believed.
    capacity : int
        Descriptors kept open; the least recently asked for is given up first.
    """

    def __init__(
        self,
        root: Path,
        *,
        clock: Callable[[], float],
        wall: Callable[[], float],
        recheck: float = 1.0,
        capacity: int = 128,
    ) -> None:
        self.root = root.resolve()
        self._clock = clock
        self._wall = wall
        self._recheck = recheck
        self._capacity = capacity
        self._open: OrderedDict[tuple[str, ...], OpenFile] = OrderedDict()

    def get(self, names: tuple[str, ...], *, fresh: bool = False) -> OpenFile:
        """Return the open file of a name; take its `lease` before awaiting anything.

        Parameters
        ----------
        names : tuple of str
            As `paths.model_names` gives them.
        fresh : bool
            Look at the directory entry now, however recently that was done.

        Raises
        ------
        NotFound
            If no regular file of that name can be read below the folder.
        Unavailable
            If the machine has run out of descriptors or memory, or the disk fails.
        """
        now = self._clock()
        known = self._open.get(names)
        if known is not None and now - known.checked < self._recheck and not fresh:
            self._open.move_to_end(names)
            return known
        try:
            if known is not None and _identity(self.root.joinpath(*names).stat()) == known.identity:
                known.checked = now
                self._open.move_to_end(names)
                return known
            self._forget(names)
            self._open[names] = opened = self._open_file(names, now)
        except OSError as error:
            self._forget(names)
            if error.errno in _HOST_IN_TROUBLE:
                raise Unavailable(f"{names[-1]} cannot be opened now: {error.strerror}") from error
            raise NotFound(f"there is no model {'/'.join(names)} here") from error
        while len(self._open) > self._capacity:
            self._open.popitem(last=False)[1].retire()
        return opened

    def close(self) -> None:
        """Give up all descriptors; replies under way keep theirs."""
        while self._open:
            self._open.popitem()[1].retire()

    def _forget(self, names: tuple[str, ...]) -> None:
        if (known := self._open.pop(names, None)) is not None:
            known.retire()

    def _open_file(self, names: tuple[str, ...], now: float) -> OpenFile:
        if self.root.joinpath(*names[:-1], names[-1] + PART_SUFFIX).exists():
            raise NotFound(f"{names[-1]} is the copy of a part; complete it with `pointstream fetch`")
        file = io.FileIO(self._descriptor(names), "rb")
        try:
            status = os.fstat(file.fileno())
            media = content_type(names[-1])
            if not stat.S_ISREG(status.st_mode) or media is None:
                raise NotFound(f"{names[-1]} is not a file that is served")
            facts = FileFacts(
                length=status.st_size,
                etag=_entity_tag(file.fileno(), names[-1], status),
                modified=int(min(status.st_mtime_ns // 1_000_000_000, self._wall())),
                content_type=media,
            )
            return OpenFile(file, facts, _identity(status), now)
        except BaseException:
            file.close()
            raise

    def _descriptor(self, names: tuple[str, ...]) -> int:
        # Links are resolved first, and the result then walked without following any: whatever is exchanged in
        # between, the walk cannot leave the folder.
        real = names_inside(self.root, self.root.joinpath(*names))
        if not real:
            raise NotFound(f"{names[-1]} lies outside the served folder")
        at = os.open(self.root, os.O_RDONLY | os.O_DIRECTORY)
        for depth, name in enumerate(real):
            # O_NONBLOCK: opening a pipe must not wait for its writer.
            kind = os.O_DIRECTORY if depth < len(real) - 1 else os.O_NONBLOCK
            try:
                below = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | kind, dir_fd=at)
            finally:
                os.close(at)
            at = below
        return at


def names_inside(root: Path, path: Path) -> tuple[str, ...] | None:
    """Names below `root` (resolved) where a path ends when links are followed; None if outside it or hidden."""
    real = Path(os.path.realpath(path))
    names = real.relative_to(root).parts if real.is_relative_to(root) else None
    return names if names is None or all(map(is_plain_name, names)) else None


def _identity(status: os.stat_result) -> Identity:
    return status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size


def _entity_tag(descriptor: int, name: str, status: os.stat_result) -> str:
    """Strong tag of a file: a model's digest and length, the same on every machine that holds a copy.

    Two builds of equal size written in one second differ in it, unlike in tags made of size and time.
    """
    if name.endswith(MODEL_SUFFIX):
        try:
            return f'"{parse_header(os.pread(descriptor, HEADER_PROBE, 0)).digest}-{status.st_size:x}"'
        except FormatError:
            pass
    return f'"{status.st_dev:x}-{status.st_ino:x}-{status.st_mtime_ns:x}-{status.st_size:x}"'
