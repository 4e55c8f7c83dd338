"""httpx over an in-memory link: the real httpx and httpcore, and a real HTTP server, with no socket between them.

::

    httpx ─ httpcore pool ─ MemoryStream ─┐            ┌─ MemoryStream ─ Origin.handle
                                          └─ Line ─────┘

Under :func:`pointlink.virtual.run` a run takes as long as its own computing, and two runs are identical to the bit. A
connect costs one round trip (SYN out, SYN-ACK back); there is no TLS. Closing an end tells the other one half a round
trip later, and what had entered the link's queue by then still takes its time there, as it does in front of a real
modem.
"""

from __future__ import annotations

import asyncio
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import httpcore
import httpx

from pointlink.stream import MemoryStream
from pointlink.wire import Line

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator, Coroutine, Iterable, Iterator

    from pointlink.origin import Origin
    from pointlink.profiles import Profile

T = TypeVar("T")


class Network(httpcore.AsyncNetworkBackend):
    """A link of some profile with an origin at its far end; it answers under every host name and port.

    Parameters
    ----------
    origin
        Who answers; :meth:`Origin.handle` is called for each connection.
    profile
        The link, shared by all connections of all transports of this network.

    Notes
    -----
    Make and use it inside one running loop. As an ``httpcore.AsyncNetworkBackend`` it can also be given to a pool of
    one's own.
    """

    def __init__(self, origin: Origin, profile: Profile) -> None:
        self._origin = origin
        self._profile = profile
        self._line: Line | None = None
        self._serving: set[asyncio.Task[None]] = set()

    @property
    def line(self) -> Line:
        """Both directions; ``line.down.link`` keeps account of what was carried when."""
        if self._line is None:
            self._line = Line.open(self._profile, asyncio.get_running_loop())
        return self._line

    async def open_connection(self) -> MemoryStream:
        """Connect, in one round trip; return the client's end."""
        loop = asyncio.get_running_loop()
        opened: asyncio.Future[None] = loop.create_future()
        client, server = MemoryStream.pair(self.line)

        def serve() -> None:
            task = loop.create_task(self._serve(server))
            self._serving.add(task)
            task.add_done_callback(self._serving.discard)

        self.line.handshake(serve, lambda: None if opened.done() else opened.set_result(None))
        try:
            await opened
        except asyncio.CancelledError:
            client.abort()
            raise
        return client

    def transport(self, *, max_connections: int | None = None) -> httpx.AsyncBaseTransport:
        """Return a transport with its own connection pool over this network, as many as are wanted."""
        return MemoryTransport(self, max_connections=max_connections)

    async def aclose(self) -> None:
        """Stop serving."""
        for task in list(self._serving):
            task.cancel()
        await asyncio.gather(*self._serving, return_exceptions=True)

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,  # noqa: ASYNC109 - httpcore's interface
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.AsyncNetworkStream:
        """Connect to the origin whatever the address (called by httpcore)."""
        del host, port, local_address, socket_options
        return _HttpcoreStream(await _in_time(self.open_connection(), timeout, httpcore.ConnectTimeout))

    async def sleep(self, seconds: float) -> None:
        """Sleep on the running loop's clock (called by httpcore)."""
        await asyncio.sleep(seconds)

    async def _serve(self, server: MemoryStream) -> None:
        try:
            await self._origin.handle(server, server)
        except BaseException:
            server.abort()
            raise


def transport(origin: Origin, profile: Profile, *, max_connections: int | None = None) -> httpx.AsyncBaseTransport:
    """Return an httpx transport to an origin over a link of its own; several on one link: see :class:`Network`."""
    return Network(origin, profile).transport(max_connections=max_connections)


class MemoryTransport(httpx.AsyncBaseTransport):
    """httpcore's connection pool over a :class:`Network`, with httpx's exceptions.

    Idle connections are kept until either side closes them: httpcore times their expiry by the wall clock, which would
    make runs differ.
    """

    def __init__(self, network: Network, *, max_connections: int | None = None) -> None:
        self.network = network
        self._pool = httpcore.AsyncConnectionPool(
            network_backend=network, max_connections=max_connections, keepalive_expiry=None
        )

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request and return the response with its body still to come."""
        if not isinstance(request.stream, httpx.AsyncByteStream):
            raise TypeError("an asynchronous request needs an asynchronous body")
        url = request.url
        passed = httpcore.Request(
            method=request.method,
            url=httpcore.URL(scheme=url.raw_scheme, host=url.raw_host, port=url.port, target=url.raw_path),
            headers=request.headers.raw,
            content=request.stream,
            extensions=request.extensions,
        )
        with _httpx_errors():
            response = await self._pool.handle_async_request(passed)
        return httpx.Response(
            status_code=response.status,
            headers=response.headers,
            stream=_Body(response),
            extensions=response.extensions,
        )

    async def aclose(self) -> None:
        """Close all connections."""
        await self._pool.aclose()


class _Body(httpx.AsyncByteStream):
    def __init__(self, response: httpcore.Response) -> None:
        self._response = response

    async def __aiter__(self) -> AsyncIterator[bytes]:
        with _httpx_errors():
            async for part in self._response.aiter_stream():
                yield part

    async def aclose(self) -> None:
        with _httpx_errors():
            await self._response.aclose()


class _HttpcoreStream(httpcore.AsyncNetworkStream):
    """A :class:`MemoryStream` as httpcore sees it, with httpcore's exceptions."""

    def __init__(self, stream: MemoryStream) -> None:
        self._stream = stream

    async def read(self, max_bytes: int, timeout: float | None = None) -> bytes:  # noqa: ASYNC109
        try:
            return await _in_time(self._stream.read(max_bytes), timeout, httpcore.ReadTimeout)
        except ConnectionError as error:
            raise httpcore.ReadError(str(error)) from error

    async def write(self, buffer: bytes, timeout: float | None = None) -> None:  # noqa: ASYNC109
        try:
            self._stream.write(buffer)
            await _in_time(self._stream.drain(), timeout, httpcore.WriteTimeout)
        except ConnectionError as error:
            raise httpcore.WriteError(str(error)) from error

    async def aclose(self) -> None:
        self._stream.close()

    async def start_tls(
        self,
        ssl_context: ssl.SSLContext,
        server_hostname: str | None = None,
        timeout: float | None = None,  # noqa: ASYNC109
    ) -> httpcore.AsyncNetworkStream:
        del ssl_context, server_hostname, timeout
        raise httpcore.ConnectError("there is no TLS over an in-memory link: use an http: address")

    def get_extra_info(self, info: str) -> Any:
        return self._stream.readable if info == "is_readable" else None


async def _in_time(work: Coroutine[Any, Any, T], seconds: float | None, late: type[httpcore.TimeoutException]) -> T:
    try:
        async with asyncio.timeout(seconds):
            return await work
    except TimeoutError as error:
        raise late(f"nothing within {seconds:g} s") from error


@contextmanager
def _httpx_errors() -> Iterator[None]:
    """Translate httpcore's exceptions: httpx has one of the same name for each."""
    try:
        yield
    except (
        httpcore.TimeoutException,
        httpcore.NetworkError,
        httpcore.ProtocolError,
        httpcore.UnsupportedProtocol,
    ) as error:
        translated: type[httpx.TransportError] = getattr(httpx, type(error).__name__)
        raise translated(str(error)) from error
