"""A file that fills up in any order, and beside it the map of what is there.

::

    model.lpc            as long as the whole model, with holes where nothing has come yet
    model.lpc.present    the map: a head of 24 bytes, then records of 24 bytes, only ever appended
                         start u64 | stop u64 | 1: here, 0: not any more, u32 | CRC-32 of the record so far, u32

Once the last byte has come the map is removed: what stands there then is simply the model.

Nothing is locked, and a process that is killed at any moment leaves no wrong byte. A range enters the map only after
its bytes are on the disk; a torn record fails its checksum and is cut off at the next opening, by a new map renamed
over the old one. Two processes write the same bytes to the same places, since a file belongs to one build, and append
whole records; what one of them loses (its map was replaced) is only fetched again.
"""

from __future__ import annotations

import os
import struct
import threading
import zlib
from typing import TYPE_CHECKING

from lpc.header import PART_SUFFIX
from lpc.ranges import ByteRange

from .presence import Presence

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

MAGIC = b"LPCMAP\x01\n"
HEAD = struct.Struct("<8sQ8s")
RECORD = struct.Struct("<QQII")
FLUSHED = 1 << 20
"""Bytes written after which they are made durable and enter the map."""
SLACK = 1024
"""Records beyond twice the ranges that they describe, before the map is written anew."""


def map_path(path: Path) -> Path:
    """Where the map of a file stands."""
    return path.with_name(path.name + PART_SUFFIX)


class SparseFile:
    """A file with holes. All methods may be called from any thread.

    Parameters
    ----------
    path : Path
    length : int
        Bytes of the whole file.
    tag : bytes, 8
        Of the build: a map of another build is not heeded.
    writable : bool
        Made if it is not there.

    Raises
    ------
    OSError
    """

    def __init__(self, path: Path, *, length: int, tag: bytes, writable: bool = True) -> None:
        self.path, self.length = path, length
        self._map, self._tag, self._writable = map_path(path), tag, writable
        self._lock = threading.Lock()
        self._pending: list[bytes] = []
        self._unflushed = 0
        self.present = Presence()
        whole = not self._map.exists() and path.is_file() and path.stat().st_size == length
        if whole:
            self.present.add(ByteRange(0, length))
        else:
            self._load(repair=writable)
        if writable:
            self._file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o644), "r+b", buffering=0)
            if not whole:
                os.truncate(path, length)
        else:
            self._file = path.open("rb", buffering=0)

    @property
    def complete(self) -> bool:
        """Whether there is no hole."""
        return self.present.total >= self.length

    def holds(self, starts: NDArray[np.int64], stops: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which ranges are wholly here."""
        with self._lock:
            return self.present.holds(starts, stops)

    def missing(self, place: ByteRange) -> list[ByteRange]:
        """Return the parts of a range that are not here."""
        with self._lock:
            return self.present.missing(place)

    def read(self, place: ByteRange) -> bytes:
        """Read a range, holes as zeros.

        Raises
        ------
        OSError
            If the device fails or the file was cut short.
        """
        with self._lock:
            self._file.seek(place.start)
            data = bytearray()
            while len(data) < place.size and (part := self._file.read(place.size - len(data))):
                data += part
        if len(data) < place.size:
            raise OSError(f"{self.path} was cut short")
        return bytes(data)

    def keep(self, place: ByteRange, data: bytes) -> None:
        """Write a range.

        Raises
        ------
        OSError
        """
        with self._lock:
            if not self.present.missing(place):
                return
            self._file.seek(place.start)
            rest = memoryview(data)
            while rest:
                rest = rest[self._file.write(rest) :]
            self.present.add(place)
            self._note(place, here=True)
            self._unflushed += place.size
        if self._unflushed >= FLUSHED:
            self.flush()

    def drop(self, place: ByteRange) -> None:
        """Count a range as not here any more."""
        with self._lock:
            self.present.remove(place)
            if self._writable:
                if not self._map.exists():  # it was complete
                    self._rewrite()
                self._note(place, here=False)

    def flush(self) -> None:
        """Make everything written durable, then enter it into the map; a complete file loses its map.

        Raises
        ------
        OSError
        """
        with self._lock:
            pending, self._pending, self._unflushed = self._pending, [], 0
            if not pending or not self._writable:
                return
            os.fsync(self._file.fileno())
            if self.complete:
                self._map.unlink(missing_ok=True)
                return
            try:
                map_file = os.open(self._map, os.O_WRONLY | os.O_APPEND)
            except FileNotFoundError:
                return  # another process has completed the file, or has cleared it away
            with os.fdopen(map_file, "wb", buffering=0) as file:
                file.write(b"".join(pending))

    def close(self) -> None:
        """Flush and close.

        Raises
        ------
        OSError
        """
        try:
            self.flush()
        finally:
            self._file.close()

    def _note(self, place: ByteRange, *, here: bool) -> None:
        self._pending.append(_record(place, here=here))

    def _load(self, *, repair: bool) -> None:
        """Read the map; write it anew if it is missing, another build's, torn or long-winded."""
        try:
            text = self._map.read_bytes()
        except FileNotFoundError:
            text = b""
        sound = text[: HEAD.size] == HEAD.pack(MAGIC, self.length, self._tag)
        records = 0
        body = memoryview(text)[HEAD.size :] if sound else memoryview(b"")
        for offset in range(0, len(body) - RECORD.size + 1, RECORD.size):
            start, stop, here, crc = RECORD.unpack_from(body, offset)
            if crc != zlib.crc32(body[offset : offset + 20]) or not start < stop <= self.length:
                sound = False
                break
            records += 1
            (self.present.add if here else self.present.remove)(ByteRange(start, stop))
        sound &= len(body) == records * RECORD.size
        if repair and (not sound or records > 2 * len(self.present) + SLACK):
            self._rewrite()

    def _rewrite(self) -> None:
        parts = [HEAD.pack(MAGIC, self.length, self._tag), *(_record(place, here=True) for place in self.present)]
        fresh = self._map.with_name(f"{self._map.name}.{os.getpid()}-{threading.get_ident()}")
        try:
            with fresh.open("wb") as file:
                file.write(b"".join(parts))
                file.flush()
                os.fsync(file.fileno())
            fresh.replace(self._map)
        except OSError:
            fresh.unlink(missing_ok=True)
            raise


def _record(place: ByteRange, *, here: bool) -> bytes:
    head = RECORD.pack(place.start, place.stop, here, 0)[:20]
    return head + zlib.crc32(head).to_bytes(4, "little")
