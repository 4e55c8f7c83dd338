"""An httpx transport of one connection that can be opened ahead of its first request.

A connection costs a round trip before the first request can go out on it, and httpx opens one only for a request. So
here is httpcore's pool of one connection, over a network backend that may hold the open stream already when asked.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import httpcore
import httpx

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator, Iterable, Iterator

KEEP_ALIVE = 4.0
"""Seconds for which an idle connection is used: below the 5 s of Apache and lighttpd."""
CONNECT_SECONDS = 10.0


class Dialler(httpcore.AsyncNetworkBackend):
    """A network backend that may have dialled already.

    Parameters
    ----------
    backend : httpcore.AsyncNetworkBackend
        What really connects.
    """

    def __init__(self, backend: httpcore.AsyncNetworkBackend) -> None:
        self._backend = backend
        self._dialled: asyncio.Task[httpcore.AsyncNetworkStream] | None = None
        self._place: tuple[str, int] | None = None
        self._at = 0.0

    def dial(self, host: str, port: int) -> None:
        """Start to connect; one connection is kept for the next `connect_tcp` to the same place."""
        loop = asyncio.get_running_loop()
        self._place, self._at = (host, port), loop.time()
        self._dialled = loop.create_task(self._backend.connect_tcp(host, port, timeout=CONNECT_SECONDS), name="dial")

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,  # noqa: ASYNC109 - httpcore's interface
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.AsyncNetworkStream:
        """Give the connection dialled ahead if it is fresh and alive, else a new one (called by httpcore)."""
        if self._dialled is not None:
            fresh = self._place == (host, port) and asyncio.get_running_loop().time() - self._at < KEEP_ALIVE
            with contextlib.suppress(httpcore.ConnectError, httpcore.ConnectTimeout, OSError):
                if fresh:
                    stream = await self._dialled
                    if not stream.get_extra_info("is_readable"):  # readable before a request: the host has hung up
                        self._dialled = None
                        return stream
            await self.hang_up()
        return await self._backend.connect_tcp(host, port, timeout, local_address, socket_options)

    async def hang_up(self) -> None:
        """Close what was dialled and not used."""
        task, self._dialled = self._dialled, None
        if task is None:
            return
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError, httpcore.NetworkError, httpcore.TimeoutException, OSError):
            stream = await task
            await stream.aclose()

    async def sleep(self, seconds: float) -> None:
        """Sleep (called by httpcore)."""
        await self._backend.sleep(seconds)


class OneConnection(httpx.AsyncBaseTransport):
    """A transport with one connection.

    Parameters
    ----------
    context : ssl.SSLContext, optional
        For https.
    backend : httpcore.AsyncNetworkBackend, optional
        Another network than the system's: what stands in for it in tests and simulations.
    keep_alive : float, optional
        Seconds (of the wall clock) for which the idle connection is used again; None: as long as it lives.
    """

    def __init__(
        self,
        context: ssl.SSLContext | None = None,
        backend: httpcore.AsyncNetworkBackend | None = None,
        keep_alive: float | None = KEEP_ALIVE,
    ) -> None:
        self._dialler = Dialler(backend or httpcore.AnyIOBackend())
        self._pool = httpcore.AsyncConnectionPool(
            ssl_context=context, max_connections=1, keepalive_expiry=keep_alive, network_backend=self._dialler
        )

    @property
    def connections(self) -> int:
        """Connections in the pool: at most one."""
        return len(self._pool.connections)

    def dial(self, host: str, port: int) -> None:
        """Connect ahead of the first request."""
        self._dialler.dial(host, port)

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request; return the response with its body still to come."""
        assert isinstance(request.stream, httpx.AsyncByteStream)
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
        return httpx.Response(response.status, headers=response.headers, stream=_Body(response))

    async def aclose(self) -> None:
        """Close the connection, used or not."""
        await self._dialler.hang_up()
        await self._pool.aclose()


class _Body(httpx.AsyncByteStream):
    def __init__(self, response: httpcore.Response) -> None:
        self._response = response

    async def __aiter__(self) -> AsyncIterator[bytes]:
        with _httpx_errors():
            async with contextlib.aclosing(self._response.aiter_stream()) as parts:  # type: ignore[type-var]
                async for part in parts:
                    yield part

    async def aclose(self) -> None:
        with _httpx_errors():
            await self._response.aclose()


@contextlib.contextmanager
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
        kind: type[httpx.TransportError] = getattr(httpx, type(error).__name__, httpx.TransportError)
        raise kind(str(error)) from error
