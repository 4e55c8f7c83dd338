"""A throttled TCP front for any server: real sockets, the rate, round-trip time and buffer of a profile.

::

    client ◀─socket─▶ RelayEnd ◀── Line: one Link a direction for all connections ──▶ RelayEnd ◀─socket─▶ upstream

The front relays bytes. For http: and https: upstreams it also replaces the Host header of each request, so that
``pointstream link https://models.example.org`` works with the paths of that server; redirects to absolute addresses
leave the front. With an https: upstream the client speaks plain HTTP to the front. ``tcp:`` upstreams are relayed
untouched.

What a connect costs: the kernel accepts at once, so the client's first bytes are held for one round trip. Connecting
and asking together take as long as on a real link of that round-trip time. Loss and slow start are not modelled, and
the real way to the upstream adds to the round trip.

Sockets of the loopback swallow megabytes; the front keeps its own small, so that what the client has read is what the
link has carried.
"""

from __future__ import annotations

import asyncio
import errno
import os
import selectors
import socket
import ssl
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self
from urllib.parse import urlsplit

from lpc.errors import Unavailable
from pointlink.hosts import HostRewriter
from pointlink.relay import RelayEnd
from pointlink.wire import Flow, Line

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from pointlink.profiles import Profile

SMALLEST_BUFFER = 16 * 1024
LARGEST_BUFFER = 4 * 1024 * 1024
LOOKAHEAD = 0.2
"""Seconds of the link that may wait in front of it, in socket and buffer; more than the upstream's round trip."""
HANDOVER = 0.01
"""Seconds of the link that may stand behind it, in the socket to the client."""
CONNECT_SECONDS = 10.0
_PORTS = {"http": 80, "https": 443}


@dataclass(frozen=True, kw_only=True, slots=True)
class Upstream:
    """The server behind the front.

    Parameters
    ----------
    scheme
        ``http``, ``https`` or ``tcp``.
    host, port
        Where it listens.
    path
        What follows in the address, kept for printing.
    """

    scheme: str
    host: str
    port: int
    path: str

    @property
    def authority(self) -> str:
        """Host, and port where it is not the scheme's own, as in a Host header."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return host if self.port == _PORTS.get(self.scheme) else f"{host}:{self.port}"


def parse_upstream(text: str) -> Upstream:
    """Read ``http://HOST[:PORT]/PATH``, ``https://...``, ``tcp://HOST:PORT`` or ``HOST:PORT`` (http).

    Raises
    ------
    ValueError
        The text is no address; the message is one line for the user.
    """
    try:
        parts = urlsplit(text if "://" in text else f"http://{text}")
        port = parts.port if parts.port is not None else _PORTS.get(parts.scheme)
    except ValueError:
        parts, port = urlsplit(""), None
    if parts.scheme not in ("http", "https", "tcp") or not parts.hostname or not port:
        raise ValueError(f"{text!r} is no server address: give http://HOST[:PORT]/, https://HOST/ or tcp://HOST:PORT")
    path = parts.path + (f"?{parts.query}" if parts.query else "")
    return Upstream(scheme=parts.scheme, host=parts.hostname, port=port, path=path)


class Front:
    """A front that listens; leave it with :meth:`close` or as an asynchronous context."""

    def __init__(self, upstream: Upstream, profile: Profile, listener: socket.socket) -> None:
        self.upstream = upstream
        self.line = Line.open(profile, asyncio.get_running_loop())
        self._listener = listener
        self._profile = profile
        self._secure = _trust(upstream)
        self._server: asyncio.Server | None = None
        self._ends: set[RelayEnd] = set()
        self._connecting: set[asyncio.Task[None]] = set()

    @property
    def url(self) -> str:
        """Address that stands for the upstream's, with its path."""
        host, port = self._listener.getsockname()[:2]
        scheme = "tcp" if self.upstream.scheme == "tcp" else "http"
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}{self.upstream.path}"

    async def start(self) -> None:
        """Accept connections from now on."""
        self._server = await asyncio.get_running_loop().create_server(self._accept, sock=self._listener)

    async def close(self) -> None:
        """Stop listening and cut what is open."""
        if self._server is not None:
            self._server.close()
        for task in list(self._connecting):
            task.cancel()
        await asyncio.gather(*self._connecting, return_exceptions=True)
        for end in list(self._ends):
            end.abort()
        if self._server is not None:
            await self._server.wait_closed()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def _accept(self) -> asyncio.Protocol:
        buffer = _bytes_in(LOOKAHEAD, self._profile)
        rewriter = None if self.upstream.scheme == "tcp" else HostRewriter(self.upstream.authority)
        near, far = RelayEnd(self._ends, buffer, rewriter), RelayEnd(self._ends, buffer)
        up = Flow(self.line.up, on_data=far.data_arrived, on_end=far.end_arrived, on_room=near.room_made)
        down = Flow(self.line.down, on_data=near.data_arrived, on_end=near.end_arrived, on_room=far.room_made)
        near.attach(out=up, source=down)
        far.attach(out=down, source=up)
        far.open_gate()

        def reach() -> None:
            task = asyncio.get_running_loop().create_task(self._reach(far))
            self._connecting.add(task)
            task.add_done_callback(self._connecting.discard)

        self.line.handshake(reach, near.open_gate)
        return near

    async def _reach(self, far: RelayEnd) -> None:
        try:
            await _connect(self.upstream, lambda: far, _bytes_in(LOOKAHEAD, self._profile), self._secure)
        except OSError:
            far.fail()


async def check_upstream(upstream: Upstream) -> None:
    """Connect once and hang up.

    Raises
    ------
    Unavailable
        Nobody listens there, or somebody without a valid certificate.
    """
    try:
        (await _connect(upstream, asyncio.Protocol, SMALLEST_BUFFER, _trust(upstream))).close()
    except OSError as error:
        raise Unavailable(
            f"cannot connect to {upstream.authority} ({_reason(error)}); check the address and that this server runs"
        ) from error


async def serve_front(upstream: Upstream, profile: Profile, *, host: str = "127.0.0.1", port: int = 0) -> Front:
    """Listen on ``host:port`` (0: any free port) and relay each connection to ``upstream`` over a link of that profile.

    Raises
    ------
    Unavailable
        The address cannot be listened on.
    """
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _bytes_in(LOOKAHEAD, profile))
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _bytes_in(HANDOVER, profile))
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise Unavailable(f"cannot listen on {host}:{port} ({_reason(error)}); give another --port") from error
    front = Front(upstream, profile, listener)
    await front.start()
    return front


def precise_loop() -> asyncio.SelectorEventLoop:
    """Return an event loop that waits to the microsecond, for ``asyncio.Runner(loop_factory=precise_loop)``.

    epoll, which asyncio takes by itself, waits whole milliseconds, rounded up: 1 ms more each way on the front.
    ``select`` is precise, and good for the few hundred connections of a simulated link.
    """
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


def _bytes_in(seconds: float, profile: Profile) -> int:
    """Return what the link carries in so many seconds, within what sockets are asked to hold."""
    rate = profile.down_rate
    return LARGEST_BUFFER if rate is None else min(LARGEST_BUFFER, max(SMALLEST_BUFFER, int(rate / 8.0 * seconds)))


def _trust(upstream: Upstream) -> ssl.SSLContext | None:
    # Reading the certificates takes tens of milliseconds, in which nothing would move: once, not at every connection.
    return ssl.create_default_context() if upstream.scheme == "https" else None


def _reason(error: OSError) -> str:
    if isinstance(error, TimeoutError):
        return f"nothing within {CONNECT_SECONDS:g} s"
    if isinstance(error, ssl.SSLCertVerificationError):
        return error.verify_message
    if error.errno is not None and error.errno in errno.errorcode and not isinstance(error, socket.gaierror):
        return os.strerror(error.errno)
    return error.strerror or str(error)


async def _connect(
    upstream: Upstream, protocol: Callable[[], asyncio.Protocol], buffer: int, secure: ssl.SSLContext | None
) -> asyncio.BaseTransport:
    async with asyncio.timeout(CONNECT_SECONDS):
        sock = await _open_socket(upstream, buffer)
        transport, _ = await asyncio.get_running_loop().create_connection(
            protocol, sock=sock, ssl=secure, server_hostname=upstream.host if secure else None
        )
    return transport


async def _open_socket(upstream: Upstream, buffer: int) -> socket.socket:
    """Connect with a small receive buffer, which must be set before."""
    loop = asyncio.get_running_loop()
    last: OSError = OSError(f"{upstream.host} has no address")
    for family, kind, protocol, _, address in await loop.getaddrinfo(
        upstream.host, upstream.port, type=socket.SOCK_STREAM
    ):
        sock = socket.socket(family, kind, protocol)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
            await loop.sock_connect(sock, address)
        except OSError as error:
            sock.close()
            last = error
        except BaseException:
            sock.close()
            raise
        else:
            return sock
    raise last
