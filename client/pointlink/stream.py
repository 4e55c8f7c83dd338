"""One end of an in-memory connection: what asyncio's reader and writer do, over a :class:`~pointlink.wire.Line`."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from pointlink.wire import End, Flow

if TYPE_CHECKING:
    from pointlink.wire import Line

SEND_BUFFER = 16 * 1024
"""Bytes a writer may have waiting before ``drain`` holds it back, as a small SO_SNDBUF."""


class MemoryStream:
    """One end of an in-memory connection: an asyncio-like reader and writer in one."""

    def __init__(self) -> None:
        self._out: Flow
        self._source: Flow
        self._incoming = bytearray()
        self._at_end = False
        self._broken = False
        self._unheard = False
        self._closed = False
        self._reader: asyncio.Future[None] | None = None
        self._writers: list[asyncio.Future[None]] = []

    @classmethod
    def pair(cls, line: Line) -> tuple[MemoryStream, MemoryStream]:
        """Return the client's and the server's end of a connection that is open already."""
        client, server = cls(), cls()
        up = Flow(line.up, on_data=server.data_arrived, on_end=server.end_arrived, on_room=client.room_made)
        down = Flow(line.down, on_data=client.data_arrived, on_end=client.end_arrived, on_room=server.room_made)
        client.attach(out=up, source=down)
        server.attach(out=down, source=up)
        return client, server

    def attach(self, *, out: Flow, source: Flow) -> None:
        """Join this end to its two flows."""
        self._out, self._source = out, source

    @property
    def transport(self) -> MemoryStream:
        """The object with ``abort``, as on ``asyncio.StreamWriter``."""
        return self

    @property
    def readable(self) -> bool:
        """Whether ``read`` would return or raise at once."""
        return bool(self._incoming) or self._at_end or self._broken or self._closed

    async def read(self, n: int = -1) -> bytes:
        """Return up to ``n`` bytes as soon as there are any, none at the end.

        Raises
        ------
        ConnectionResetError
            The other end has reset the connection, or this end was closed.
        """
        while not self.readable:
            self._reader = asyncio.get_running_loop().create_future()
            await self._reader
        if self._closed or (self._broken and not self._incoming):
            raise ConnectionResetError(
                "the connection was closed here" if self._closed else "the other end reset the connection"
            )
        size = len(self._incoming) if n < 0 else min(n, len(self._incoming))
        data = bytes(self._incoming[:size])
        del self._incoming[:size]
        self._source.consumed(size)
        return data

    def write(self, data: bytes) -> None:
        """Take bytes to send; nobody gets them once the connection is broken, and ``drain`` says so."""
        self._out.send(data)

    async def drain(self) -> None:
        """Wait until little enough is waiting to be sent.

        Raises
        ------
        ConnectionResetError
            Nobody is left to send to.
        """
        while self._out.buffered > SEND_BUFFER:
            future = asyncio.get_running_loop().create_future()
            self._writers.append(future)
            await future
        if self._unheard:
            raise ConnectionResetError("the other end has closed the connection")

    def write_eof(self) -> None:
        """End this direction after what was written; the other one stays open."""
        self._out.end(End.HALF)

    def close(self) -> None:
        """Close both directions: what was written still goes out, what comes in is thrown away."""
        self._close(End.CLOSED)

    def abort(self) -> None:
        """Reset the connection, after what was written."""
        self._close(End.RESET)

    async def wait_closed(self) -> None:
        """Return at once: what is under way needs this end no more."""

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """Return the default: there is no socket below."""
        del name
        return default

    def data_arrived(self, data: bytes) -> None:
        """Take bytes from the wire."""
        if self._closed:
            self._source.consumed(len(data))
            return
        self._incoming += data
        self._wake_reader()

    def end_arrived(self, how: End) -> None:
        """Learn from the wire that the other end sends no more, or is gone."""
        self._at_end = True
        self._broken = how is End.RESET
        if how is not End.HALF:
            self._unheard = True
            self._out.drop()
        self._wake_reader()

    def room_made(self) -> None:
        """Let writers go on."""
        waiting, self._writers = self._writers, []
        for future in waiting:
            if not future.done():
                future.set_result(None)

    def _close(self, how: End) -> None:
        self._closed = True
        self._out.end(how)
        self._wake_reader()

    def _wake_reader(self) -> None:
        if self._reader is not None and not self._reader.done():
            self._reader.set_result(None)
