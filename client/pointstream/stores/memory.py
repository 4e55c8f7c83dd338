"""A file that is already in memory, for tests and for bytes that came from elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .base import KeepsNothing

if TYPE_CHECKING:
    from lpc.ranges import ByteRange
    from pointstream.goodput import Goodput

    from .base import Sink


class MemoryStore(KeepsNothing):
    """Bytes as a store.

    Parameters
    ----------
    data : bytes
        The file.
    chunk : int
        Bytes that a sink gets at a time.
    """

    def __init__(self, data: bytes, *, chunk: int = 65_536, name: str = "memory") -> None:
        self.name = name
        self.data = data
        self.length: int | None = len(data)
        self.meter: Goodput | None = None
        self._chunk = chunk

    async def read(self, wanted: ByteRange, sink: Sink | None = None) -> bytes:
        """Read a range."""
        data = self.data[wanted.start : wanted.stop]
        if sink is not None:
            for start in range(0, len(data), self._chunk):
                sink(wanted.start + start, data[start : start + self._chunk])
        return data

    def forget(self, *, distrust_tags: bool = False) -> None:
        """Learn the length anew."""
        del distrust_tags
        self.length = len(self.data)

    async def close(self) -> None:
        """Nothing to free."""
