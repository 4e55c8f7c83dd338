"""A local file, read by position off the event loop.

Not mapped, unlike LPC 4: a file that is cut short under a mapping kills the process with SIGBUS; a read of it comes
back short and becomes an error that can be told.
"""

from __future__ import annotations

import asyncio
import os
import threading
from typing import TYPE_CHECKING

from lpc.errors import ModelChanged, NotFound, StoreError, Unavailable

from .base import KeepsNothing

if TYPE_CHECKING:
    from pathlib import Path

    from lpc.ranges import ByteRange
    from pointstream.goodput import Goodput

    from .base import Sink


class LocalStore(KeepsNothing):
    """A file as a store; a file that is replaced by rename stays readable to its last byte.

    Raises
    ------
    NotFound, StoreError
        If it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self.meter: Goodput | None = None
        if path.is_dir():
            raise StoreError(f"{path} is a folder: give the path of a .lpc file")
        try:
            self._file = path.open("rb", buffering=0)
        except FileNotFoundError as error:
            raise NotFound(f"{path}: there is no such file") from error
        except OSError as error:
            raise StoreError(f"{path} cannot be opened: {error.strerror}") from error
        self._lock = threading.Lock()
        self.length: int | None = os.fstat(self._file.fileno()).st_size

    async def read(self, wanted: ByteRange, sink: Sink | None = None) -> bytes:
        """Read a range."""
        data = await asyncio.get_running_loop().run_in_executor(None, self.read_now, wanted)
        if sink is not None and data:
            sink(wanted.start, data)
        return data

    def read_now(self, wanted: ByteRange) -> bytes:
        """Read a range in this thread.

        Raises
        ------
        ModelChanged
            If the file is shorter than when it was opened.
        Unavailable
            If the device fails.
        """
        assert self.length is not None
        parts, offset, stop = [], wanted.start, min(wanted.stop, self.length)
        try:
            with self._lock:
                self._file.seek(offset)
                while offset < stop and (part := self._file.read(stop - offset)):
                    parts.append(part)
                    offset += len(part)
        except (OSError, ValueError) as error:  # ValueError: closed
            raise Unavailable(f"{self.name} cannot be read: {error}") from error
        if offset < stop:
            raise ModelChanged(f"{self.name} was cut short while being read: open it again")
        return b"".join(parts)

    def forget(self, *, distrust_tags: bool = False) -> None:
        """Learn the length anew."""
        del distrust_tags
        self.length = os.fstat(self._file.fileno()).st_size

    async def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._file.close()
