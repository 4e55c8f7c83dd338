"""Sockets around the application: connections with deadlines and limits, TLS, and a stop that lets replies end."""

from __future__ import annotations

import asyncio
import errno
import socket
import ssl
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any, cast

from aiohttp import web

from lpc.errors import StoreError

from .accesslog import LOGGER
from .app import ledger_of, make_app
from .board import CONNECTIONS, REFUSED, Board

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from .board import Seat
    from .config import ServeConfig


class Guests:
    """Who is connected, to all workers: says when somebody is one too many.

    Parameters
    ----------
    total, per_address : int
        Connections at a time.
    seat : Seat
        Where this worker's are counted.
    """

    def __init__(self, total: int, per_address: int, seat: Seat) -> None:
        self._total = total
        self._per_address = per_address
        self._seat = seat
        self._here = 0
        self._left = asyncio.Event()

    def enter(self, address: str) -> bool:
        """Let a connection in, or not."""
        seat, peer = self._seat, self._seat.peer(address)
        if seat.board.total(CONNECTIONS) >= self._total or seat.board.total(peer) >= self._per_address:
            seat.row[REFUSED] += 1
            return False
        seat.row[CONNECTIONS] += 1
        seat.row[peer] += 1
        self._here += 1
        return True

    def leave(self, address: str) -> None:
        """Take note that a connection that was let in has ended."""
        self._seat.row[CONNECTIONS] -= 1
        self._seat.row[self._seat.peer(address)] -= 1
        self._here -= 1
        self._left.set()

    async def gone(self, seconds: float) -> None:
        """Wait until everybody whom this worker let in has left, but no longer than that."""
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while self._here:
                    self._left.clear()
                    await self._left.wait()


class Connection(web.RequestHandler):
    """One connection. Errors below the application are answered here, without naming what answers."""

    __slots__ = ("_address", "_guests", "_head_seconds", "_head_timer")

    def __init__(self, guests: Guests, manager: web.Server, *, head_seconds: float, **options: Any) -> None:
        super().__init__(manager, **options)
        self._guests = guests
        self._address: str | None = None
        self._head_seconds = head_seconds
        self._head_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Let the peer in if there is room for it, and let the kernel drop it if it acknowledges nothing."""
        address = str((transport.get_extra_info("peername") or ("?",))[0])
        if not self._guests.enter(address):
            self._refuse(cast("asyncio.Transport", transport))
            return
        self._address = address
        super().connection_made(transport)
        self._head_timer = self._loop.call_later(self._head_seconds, self._head_is_late)
        sock = transport.get_extra_info("socket")
        if sock is not None and hasattr(socket, "TCP_USER_TIMEOUT") and sock.family != socket.AF_UNIX:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * self.keepalive_timeout))

    def data_received(self, data: bytes) -> None:
        """Take what arrives; a head has to be complete in time, however many pieces it comes in."""
        before = self._request_count
        super().data_received(data)
        if self._request_count != before:
            self._stop_head_timer()
        elif self._head_timer is None and self._waiter is not None:
            self._head_timer = self._loop.call_later(self._head_seconds, self._head_is_late)

    def _head_is_late(self) -> None:
        self._head_timer = None
        if self._waiter is not None:  # nothing is being answered
            self.force_close()

    def _stop_head_timer(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def connection_lost(self, exc: BaseException | None) -> None:
        """Give the place free."""
        if self._address is not None:
            self._guests.leave(self._address)
            self._address = None
        self._stop_head_timer()
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
            LOGGER.error("unforeseen error on a connection of %s", request.remote, exc_info=exc)
        text = f"{status} {'the request is not well-formed HTTP' if status == 400 else 'the server failed'}\n"
        response = web.Response(status=status, text=text, headers={"Server": "pointstream"})
        response.force_close()
        return response


@asynccontextmanager
async def serving(
    config: ServeConfig, *, seat: Seat | None = None, share_port: bool = False, **app_options: Any
) -> AsyncIterator[str]:
    """Serve a folder inside the running loop, for the length of the block.

    On leaving, no connection is accepted any more, idle ones are closed, and replies under way get `config.grace`
    seconds to end.

    Parameters
    ----------
    config : ServeConfig
    seat : Seat, optional
        Where this worker counts; one of its own, if not given.
    share_port : bool
        Other workers listen on the same port (SO_REUSEPORT): the kernel deals connections out among them.
    **app_options
        Of `make_app`.

    Yields
    ------
    str
        The URL of the catalogue, with the port that was taken.

    Raises
    ------
    StoreError
        If the folder is missing, the certificate cannot be used or the address cannot be listened on.
    """
    if not config.directory.is_dir():
        raise StoreError(f"{config.directory} is not a folder; name the folder that holds the models")
    tls = tls_context(config)
    seat = seat or Board().seat(0)
    app = make_app(config, seat=seat, **app_options)
    runner = web.AppRunner(app, shutdown_timeout=config.grace, auto_decompress=False)
    await runner.setup()
    guests = Guests(config.connections, config.per_address, seat)
    loop = asyncio.get_running_loop()
    stopped = loop.time()
    try:
        server = await _listen(runner, config, guests, tls=tls, share_port=share_port)
        try:
            yield address_of(config, server.sockets[0].getsockname()[1])
        finally:
            server.close()
            stopped = loop.time()
    finally:
        await runner.cleanup()
        # The last bytes of a reply may still be in a transport's buffer, which ends with the loop.
        await guests.gone(stopped + config.grace - loop.time())


def address_of(config: ServeConfig, port: int) -> str:
    """URL of the catalogue."""
    host = f"[{config.host}]" if ":" in config.host else config.host
    return f"{'http' if config.certfile is None else 'https'}://{host}:{port}/"


def tls_context(config: ServeConfig) -> ssl.SSLContext | None:
    """Return what speaks TLS with the configured certificate; None where plain HTTP is wanted.

    Raises
    ------
    StoreError
        If certificate and key cannot be read or do not belong together.
    """
    if config.certfile is None:
        if config.keyfile is not None:
            raise StoreError("--keyfile is of use only with --certfile")
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(config.certfile, config.keyfile)
    except ssl.SSLError as error:
        raise StoreError(f"{config.certfile} and its key are no matching PEM files: {error.reason}") from error
    except OSError as error:
        raise StoreError(f"{config.certfile} or its key cannot be read: {error.strerror}") from error
    return context


async def _listen(
    runner: web.AppRunner, config: ServeConfig, guests: Guests, *, tls: ssl.SSLContext | None, share_port: bool
) -> asyncio.Server:
    loop = asyncio.get_running_loop()
    manager = runner.server
    assert manager is not None
    logger_class = ledger_of(runner.app).logger_class()

    def connection() -> Connection:
        return Connection(
            guests, manager, head_seconds=config.head_seconds, loop=loop, keepalive_timeout=config.idle,
            access_log=LOGGER, access_log_class=logger_class, auto_decompress=False,
        )  # fmt: skip

    try:
        return await loop.create_server(
            connection, config.host, config.port, backlog=1024, reuse_port=share_port or None, ssl=tls,
            ssl_handshake_timeout=None if tls is None else config.head_seconds,
        )  # fmt: skip
    except OSError as error:
        raise cannot_listen(config, error) from error


def cannot_listen(config: ServeConfig, error: OSError) -> StoreError:
    """Say why an address cannot be listened on."""
    where = f"port {config.port} of {config.host}"
    if error.errno == errno.EADDRINUSE:
        return StoreError(f"{where} is in use; choose another with --port (0 takes a free one)")
    return StoreError(f"{where} cannot be listened on: {error.strerror or error}")
