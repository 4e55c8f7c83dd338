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
import hashlib
import inspect
import re
import socket
import struct
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol
from urllib.parse import unquote

import h11

from lpc.errors import NotFound
from pointlink.faults import Fault, IgnoreRange, OtherEtag, ResetNow, Shift, Status, before_head, spoil

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
    from pathlib import Path

CHUNK = 64 * 1024
_RANGE = re.compile(r"bytes\s*=\s*(?:(\d+)-(\d*)|-(\d+))\s*", re.IGNORECASE)


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
class Resource:
    """Something to serve.

    Parameters
    ----------
    length
        Bytes.
    etag
        Strong entity tag with its quotes.
    read
        ``read(start, stop)`` returns those bytes or an awaitable of them; fewer make the origin cut the reply.
    content_type
        Media type.
    """

    length: int
    etag: str
    read: Callable[[int, int], bytes | Awaitable[bytes]]
    content_type: str = "application/octet-stream"

    @classmethod
    def from_bytes(cls, data: bytes) -> Resource:
        """Serve these bytes under a tag of their content."""
        return cls(length=len(data), etag=f'"{hashlib.sha256(data).hexdigest()[:16]}"', read=lambda a, b: data[a:b])

    @classmethod
    def from_path(cls, path: Path) -> Resource:
        """Serve a file as long as it is now; it is read anew for each range.

        Raises
        ------
        NotFound
            There is no such readable file.
        """

        def read(start: int, stop: int) -> bytes:
            with path.open("rb") as file:
                file.seek(start)
                return file.read(stop - start)

        try:
            read(0, 1)
            stat = path.stat()
        except OSError as error:
            raise NotFound(f"{path}: cannot be read ({error.strerror}); give the path of a file") from error
        return cls(length=stat.st_size, etag=f'"{stat.st_size:x}-{stat.st_mtime_ns:x}"', read=read)


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


@dataclass(frozen=True, kw_only=True, slots=True)
class _Reply:
    status: int
    headers: tuple[tuple[str, str], ...] = ()
    resource: Resource | None = None
    start: int = 0
    stop: int = 0


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
        reply = _reply(method, self.resources.get(path), headers, fault)
        self.log.append(
            Exchange(number=number, method=method, path=path, start=reply.start, stop=reply.stop, status=reply.status)
        )
        await before_head(fault)
        head = h11.Response(status_code=reply.status, headers=list(reply.headers), reason=b"")
        writer.write(connection.send(head) or b"")
        missing = reply.stop - reply.start
        if method != "HEAD":
            async for data in spoil(fault, missing, _body(reply)):
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


def select_range(text: str | None, length: int) -> tuple[int, int] | None:
    """Return the one range ``[start, stop)`` that a Range header asks of ``length`` bytes; None: send everything.

    Raises
    ------
    IndexError
        The range is well formed and lies outside (416).
    """
    match = _RANGE.fullmatch(text.strip()) if text else None
    if match is None:
        return None
    first, last, suffix = match.groups()
    if suffix is not None:
        start, stop = max(0, length - int(suffix)), length
    else:
        start, stop = int(first), min(length, int(last) + 1) if last else length
        if last and int(last) < start:
            return None
    if start >= stop:
        raise IndexError(text)
    return start, stop


def _reply(method: str, resource: Resource | None, asked: dict[str, str], fault: Fault | None) -> _Reply:
    empty = ("content-length", "0")
    if isinstance(fault, Status):
        retry = (("retry-after", fault.retry_after),) if fault.retry_after is not None else ()
        return _Reply(status=fault.code, headers=(empty, *retry))
    if resource is None:
        return _Reply(status=404, headers=(empty,))
    if method not in ("GET", "HEAD"):
        return _Reply(status=405, headers=(empty, ("allow", "GET, HEAD")))
    if isinstance(fault, OtherEtag):
        resource = replace(resource, etag=fault.etag)
    tag = ("etag", resource.etag)
    if "if-match" in asked and not _lists(asked["if-match"], resource.etag):
        return _Reply(status=412, headers=(empty, tag))
    if "if-none-match" in asked and _lists(asked["if-none-match"], resource.etag):
        return _Reply(status=304, headers=(tag,))
    common = (tag, ("accept-ranges", "bytes"), ("content-type", resource.content_type))
    wanted = None
    if method == "GET" and asked.get("if-range", resource.etag) == resource.etag and not isinstance(fault, IgnoreRange):
        try:
            wanted = select_range(asked.get("range"), resource.length)
        except IndexError:
            return _Reply(status=416, headers=(empty, tag, ("content-range", f"bytes */{resource.length}")))
    if wanted is None:
        size = ("content-length", str(resource.length))
        return _Reply(status=200, headers=(size, *common), resource=resource, stop=resource.length)
    start, stop = wanted
    if isinstance(fault, Shift):
        start, stop = min(start + fault.by, resource.length - 1), min(stop + fault.by, resource.length)
    place = ("content-range", f"bytes {start}-{stop - 1}/{resource.length}")
    size = ("content-length", str(stop - start))
    return _Reply(status=206, headers=(size, place, *common), resource=resource, start=start, stop=stop)


def _lists(header: str, etag: str) -> bool:
    return header.strip() == "*" or etag in [item.strip() for item in header.split(",")]


async def _body(reply: _Reply) -> AsyncIterator[bytes]:
    if reply.resource is None:
        return
    at = reply.start
    while at < reply.stop:
        data = reply.resource.read(at, min(at + CHUNK, reply.stop))
        if inspect.isawaitable(data):
            data = await data
        if not data:
            return
        yield data
        at += len(data)


def _reset(writer: Writer) -> None:
    below = writer.get_extra_info("socket")
    if below is not None and hasattr(below, "setsockopt"):
        below.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    writer.transport.abort()
