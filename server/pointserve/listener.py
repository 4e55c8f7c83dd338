"""Sockets around the application: connections with deadlines, and a stop that lets replies end."""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from collections import Counter
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, cast

from aiohttp import web
from aiohttp.abc import AbstractAccessLogger

from lpc.errors import StoreError

from .app import make_app
from .replies import BODY_BYTES

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from .config import ServeConfig

_log = logging.getLogger("pointserve")


class AccessLog(AbstractAccessLogger):
    """One line a reply, ``key=value``: who, what, how much of it, how long."""

    @property
    def enabled(self) -> bool:
        """Whether anybody reads the log; if not, replies cost nothing for it."""
        return self.logger.isEnabledFor(logging.INFO)

    def log(self, request: web.BaseRequest, response: web.StreamResponse, time: float) -> None:
        """Write the line."""
        without_body = request.method == "HEAD" or response.status in (204, 304)
        sent = response.get(BODY_BYTES, 0 if without_body else response.content_length or 0)
        wanted = request.headers.get("Range", "-")
        self.logger.info(
            'peer=%s method=%s path="%s" status=%d bytes=%d range="%s" ms=%.1f',
            request.remote, request.method, _safe(request.rel_url.raw_path), response.status, sent,
            _safe(wanted[:200]), 1000 * time,
        )  # fmt: skip


def _safe(text: str) -> str:
    return "".join(c if c.isprintable() and c != '"' else "?" for c in text)


class Guests:
    """Who is connected: counts in total and by address, and says when somebody is one too many."""

    def __init__(self, total: int, per_address: int) -> None:
        self._free = total
        self._per_address = per_address
        self._count: Counter[str] = Counter()

    def enter(self, address: str) -> bool:
        """Let a connection in, or not."""
        if self._free <= 0 or self._count[address] >= self._per_address:
            return False
        self._free -= 1
        self._count[address] += 1
        return True

    def leave(self, address: str) -> None:
        """Take note that a connection that was let in has ended."""
        self._free += 1
        self._count[address] -= 1
        if not self._count[address]:
            del self._count[address]


class Connection(web.RequestHandler):
    """One connection. Errors below the application are answered here, without naming what answers."""

    __slots__ = ("_address", "_guests")

    def __init__(self, guests: Guests, manager: web.Server, **options: Any) -> None:
        super().__init__(manager, **options)
        self._guests = guests
        self._address: str | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Let the peer in if there is room for it, and let the kernel drop it if it acknowledges nothing."""
        address = str((transport.get_extra_info("peername") or ("?",))[0])
        if not self._guests.enter(address):
            self._refuse(cast("asyncio.Transport", transport))
            return
        self._address = address
        super().connection_made(transport)
        sock = transport.get_extra_info("socket")
        if sock is not None and hasattr(socket, "TCP_USER_TIMEOUT") and sock.family != socket.AF_UNIX:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * self.keepalive_timeout))

    def connection_lost(self, exc: BaseException | None) -> None:
        """Give the place free."""
        if self._address is not None:
            self._guests.leave(self._address)
            self._address = None
        super().connection_lost(exc)

    def _refuse(self, transport: asyncio.Transport) -> None:
        self.force_close()  # nothing that arrives is looked at
        text = b"503 too many connections; come back later\n"
        transport.write(
            b"HTTP/1.1 503 Service Unavailable\r\nServer: pointstream\r\nRetry-After: 5\r\nConnection: close\r\n"
            b"Content-Type: text/plain\r\nContent-Length: %d\r\n\r\n%b" % (len(text), text)
        )
        transport.close()

    def handle_error(
        self,
        request: web.BaseRequest,
        status: int = 500,
        exc: BaseException | None = None,
        message: str | None = None,  # noqa: ARG002 - aiohttp's own words are not repeated
    ) -> web.StreamResponse:
        """Answer what is not HTTP, or broke outside the application, and close."""
        if request.writer.output_size > 0:
            raise ConnectionError("an error after the first byte of a reply")
        if status >= 500:
            _log.error("unforeseen error on a connection of %s", request.remote, exc_info=exc)
        text = f"{status} {'the request is not well-formed HTTP' if status == 400 else 'the server failed'}\n"
        response = web.Response(status=status, text=text, headers={"Server": "pointstream"})
        response.force_close()
        return response


@asynccontextmanager
async def serving(config: ServeConfig, **app_options: Any) -> AsyncIterator[str]:
    """Serve a folder inside the running loop, for the length of the block.

    On leaving, no connection is accepted any more, idle ones are closed, and replies under way get `config.grace`
    seconds to end.

    Yields
    ------
    str
        The URL of the catalogue, with the port that was taken.

    Raises
    ------
    StoreError
        If the folder is missing or the address cannot be listened on.
    """
    if not config.directory.is_dir():
        raise StoreError(f"{config.directory} is not a folder; name the folder that holds the models")
    app = make_app(config, **app_options)
    runner = web.AppRunner(app, shutdown_timeout=config.grace, auto_decompress=False)
    await runner.setup()
    try:
        server = await _listen(runner, config)
        try:
            port = server.sockets[0].getsockname()[1]
            yield f"http://{f'[{config.host}]' if ':' in config.host else config.host}:{port}/"
        finally:
            server.close()
    finally:
        await runner.cleanup()


async def _listen(runner: web.AppRunner, config: ServeConfig) -> asyncio.Server:
    loop = asyncio.get_running_loop()
    manager = runner.server
    assert manager is not None

    guests = Guests(config.connections, config.per_address)

    def connection() -> Connection:
        return Connection(
            guests, manager, loop=loop, keepalive_timeout=config.idle, access_log=_log, access_log_class=AccessLog,
            auto_decompress=False,
        )  # fmt: skip

    try:
        return await loop.create_server(connection, config.host, config.port, backlog=1024)
    except OSError as error:
        where = f"port {config.port} of {config.host}"
        if error.errno == errno.EADDRINUSE:
            raise StoreError(f"{where} is in use; choose another with --port (0 takes a free one)") from error
        raise StoreError(f"{where} cannot be listened on: {error.strerror or error}") from error
