"""One real socket of a relayed connection, on asyncio's transports."""

from __future__ import annotations

import asyncio
import socket
import struct
from typing import TYPE_CHECKING

from pointlink.wire import End, Flow

if TYPE_CHECKING:
    from pointlink.hosts import HostRewriter

WRITE_BUFFER = 16 * 1024
"""Bytes that may wait for a socket before the line is held back."""


class RelayEnd(asyncio.Protocol):
    """One real socket of a connection: what it reads goes into one flow, what the other flow brings is written.

    The socket comes later than the object and may go earlier; what the line brings before is kept, after is thrown
    away.
    """

    def __init__(self, ends: set[RelayEnd], buffer: int, rewriter: HostRewriter | None = None) -> None:
        self._ends = ends
        self._buffer = buffer
        self._rewriter = rewriter
        self._out: Flow
        self._source: Flow
        self._transport: asyncio.Transport | None = None
        self._early = bytearray()
        self._gate_open = False
        self._gone = False
        self._heard_all = False
        self._told_all = False
        self._writing_paused = False
        self._unwritten = 0

    def attach(self, *, out: Flow, source: Flow) -> None:
        """Join this end to its two flows."""
        self._out, self._source = out, source

    def open_gate(self) -> None:
        """Begin to read: the handshake is over."""
        self._gate_open = True
        self.room_made()

    def fail(self) -> None:
        """Say to the other end that there is nobody here."""
        self._gone = True
        self._out.end(End.RESET)

    def abort(self) -> None:
        """Reset the socket."""
        self._gone = True
        if self._transport is not None:
            _reset(self._transport)

    # The line's side.

    def data_arrived(self, data: bytes) -> None:
        """Write what the line brings."""
        if self._gone:
            self._source.consumed(len(data))
        elif self._transport is None:
            self._early += data
        else:
            self._transport.write(data)
            self._unwritten += len(data)
            if not self._writing_paused:
                self.resume_writing()

    def end_arrived(self, how: End) -> None:
        """Learn from the line that the other end has stopped."""
        self._told_all = True
        if how is End.RESET:
            self._out.drop()
            self.abort()
        elif self._transport is not None:
            self._pass_end(self._transport)

    def room_made(self) -> None:
        """Read on when enough has left for the line."""
        if self._transport is not None and self._gate_open and self._out.buffered <= self._buffer:
            self._transport.resume_reading()

    # The socket's side.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the socket."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._ends.add(self)
        if self._gone:
            _reset(transport)
            return
        transport.set_write_buffer_limits(high=WRITE_BUFFER)
        if not self._gate_open:
            transport.pause_reading()
        if self._early:
            early, self._early = bytes(self._early), bytearray()
            self.data_arrived(early)
        if self._told_all:
            self._pass_end(transport)

    def data_received(self, data: bytes) -> None:
        """Send what was read over the line."""
        self._out.send(self._rewriter.feed(data) if self._rewriter else data)
        if self._out.buffered > self._buffer and self._transport is not None:
            self._transport.pause_reading()

    def eof_received(self) -> bool:
        """Pass on that nothing more will be read; keep writing while the line brings something."""
        self._heard_all = True
        if self._rewriter:
            self._out.send(self._rewriter.finish())
        self._out.end(End.HALF)
        return not self._told_all and self._transport is not None and self._transport.can_write_eof()

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell the other end, unless all that was to be read has been."""
        self._transport = None
        self._gone = True
        self._ends.discard(self)
        if exc is not None or not self._heard_all:
            self._out.end(End.RESET)

    def pause_writing(self) -> None:
        """Hold the line back: the socket takes no more."""
        self._writing_paused = True

    def resume_writing(self) -> None:
        """Let the line bring more."""
        self._writing_paused = False
        size, self._unwritten = self._unwritten, 0
        self._source.consumed(size)

    def _pass_end(self, transport: asyncio.Transport) -> None:
        if self._heard_all:
            transport.close()
        elif transport.can_write_eof():
            transport.write_eof()


def _reset(transport: asyncio.Transport) -> None:
    sock = transport.get_extra_info("socket")
    if sock is not None:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    transport.abort()
