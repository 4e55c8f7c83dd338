"""A small honest HTTP/1.1 server of byte ranges, for links that end inside this program.

It speaks RFC 9112 through h11 and the parts of RFC 9110 that range clients meet: 200, 206 and 416 with Content-Range,
HEAD, keep-alive, strong entity tags with If-Match, If-None-Match and If-Range. One range a request; a request for
several gets the whole resource, which the RFC allows. Whenever fewer bytes than promised can be sent, the connection is
closed. There is no Date header: a reply depends on nothing but the request.

:meth:`Origin.handle` talks to any pair of streams that look like asyncio's: in memory (:mod:`pointlink.memory`) or real
ones (:func:`serve_origin`). It is no server for the world: see ``pointserve`` for that.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol
from urllib.parse import unquote

import h11

from pointlink.faults import Fault, ResetNow, before_head, spoil
from pointlink.resources import CHUNK, body_of, decide

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from pointlink.resources import Resource


class Reader(Protocol):
    """What the origin needs of the incoming half of a stream, as ``asyncio.StreamReader``."""

    async def read(self, n: int = ..., /) -> bytes:
        """Return some bytes, none at the end."""


class Transport(Protocol):
    """What the origin needs of a writer's transport."""

    def abort(self) -> None:
        """Close without an orderly end."""


class Writer(Protocol):
    """What the origin needs of the outgoing half of a stream, as ``asyncio.StreamWriter``."""

    @property
    def transport(self) -> Transport:
        """The transport below."""

    def write(self, data: bytes, /) -> None:
        """Take bytes to send."""

    async def drain(self) -> None:
        """Wait until there is room for more."""

    def close(self) -> None:
        """Close after what was written."""

    async def wait_closed(self) -> None:
        """Wait until closed."""

    def get_extra_info(self, name: str, /) -> object:
        """Return the ``socket`` below, or None."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Exchange:
    """One request that was answered: what was asked and what went out.

    Attributes
    ----------
    number
        Counted from 0 over all connections.
    method, path
        Of the request; the path without its query, percent-decoding done.
    start, stop
        Byte range of the reply's body, half open.
    status
        Of the reply.
    """

    number: int
    method: str
    path: str
    start: int
    stop: int
    status: int


def _no_fault(number: int) -> Fault | None:  # noqa: ARG001
    return None


@dataclass(kw_only=True)
class Origin:
    """A server of resources by path.

    Parameters
    ----------
    resources
        By path with its leading slash; looked up at each request, so they may be replaced while serving.
    fault
        What to do wrong at which request, see :mod:`pointlink.faults`; a dict's ``get`` fits.
    idle_timeout
        Seconds after which a connection without a request is closed; None: never.

    Attributes
    ----------
    log
        All exchanges so far.
    """

    resources: Mapping[str, Resource]
    fault: Callable[[int], Fault | None] = _no_fault
    idle_timeout: float | None = None
    log: list[Exchange] = field(default_factory=list)
    _requests: int = 0

    async def handle(self, reader: Reader, writer: Writer) -> None:
        """Answer the requests of one connection until either side closes it."""
        connection = h11.Connection(h11.SERVER)
        try:
            while (request := await self._receive(connection, reader)) is not None:
                number, self._requests = self._requests, self._requests + 1
                if not await self._answer(connection, writer, request, number):
                    break
                if connection.our_state is not h11.DONE or connection.their_state is not h11.DONE:
                    break
                connection.start_next_cycle()
        except h11.RemoteProtocolError as error:
            if connection.our_state in (h11.IDLE, h11.SEND_RESPONSE):
                head = h11.Response(status_code=error.error_status_hint, headers=[("connection", "close")], reason=b"")
                writer.write(connection.send(head) or b"")
        except ResetNow:
            _reset(writer)
        except (ConnectionError, TimeoutError):
            pass
        finally:
            writer.close()
            with suppress(ConnectionError):
                await writer.wait_closed()

    async def _receive(self, connection: h11.Connection, reader: Reader) -> h11.Request | None:
        request: h11.Request | None = None
        while True:
            event = connection.next_event()
            if event is h11.NEED_DATA:
                async with asyncio.timeout(self.idle_timeout):
                    connection.receive_data(await reader.read(CHUNK))
            elif isinstance(event, h11.Request):
                request = event
            elif isinstance(event, h11.EndOfMessage):
                return request
            elif isinstance(event, h11.ConnectionClosed) or event is h11.PAUSED:
                return None

    async def _answer(self, connection: h11.Connection, writer: Writer, request: h11.Request, number: int) -> bool:
        """Send one reply; return whether all of it went out."""
        fault = self.fault(number)
        headers = {name.decode("ascii"): value.decode("latin-1") for name, value in request.headers}
        method, path = request.method.decode("ascii"), unquote(request.target.decode("ascii").partition("?")[0])
        reply = decide(method, self.resources.get(path), headers, fault)
        self.log.append(
            Exchange(number=number, method=method, path=path, start=reply.start, stop=reply.stop, status=reply.status)
        )
        await before_head(fault)
        head = h11.Response(status_code=reply.status, headers=list(reply.headers), reason=b"")
        writer.write(connection.send(head) or b"")
        missing = reply.stop - reply.start
        if method != "HEAD":
            async for data in spoil(fault, missing, body_of(reply)):
                writer.write(connection.send(h11.Data(data=data)) or b"")
                missing -= len(data)
                await writer.drain()
            if missing:
                return False
        writer.write(connection.send(h11.EndOfMessage()) or b"")
        await writer.drain()
        return True


async def serve_origin(origin: Origin, *, host: str = "127.0.0.1", port: int = 0) -> asyncio.Server:
    """Serve on real sockets of the running loop; port 0 takes a free one (``server.sockets[0].getsockname()[1]``)."""
    serving: set[asyncio.Task[None]] = set()

    def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.get_running_loop().create_task(origin.handle(reader, writer))
        serving.add(task)
        task.add_done_callback(serving.discard)

    return await asyncio.start_server(connected, host, port)


def _reset(writer: Writer) -> None:
    below = writer.get_extra_info("socket")
    if below is not None and hasattr(below, "setsockopt"):
        below.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    writer.transport.abort()
