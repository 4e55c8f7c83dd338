"""Connections that survive httpx: each belongs to one lane, and whatever goes wrong on it, it is thrown away.

httpx 0.28 loses slots of a shared pool for ever when a request is cancelled inside it, and idle connections die in its
hands. So a pool is never shared: a lane owns a transport with one connection, runs one request at a time, and after any
exception (a cancel too) the transport is closed, off the caller's path, and the next request gets a new one.
"""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import httpx

from .dialling import OneConnection

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

CLOSING_SECONDS = 2.0


def plain_transports(*, tls: bool) -> Callable[[], httpx.AsyncBaseTransport]:
    """Return what makes transports of one connection each; they share one TLS context, which is costly to make."""
    context = httpx.create_ssl_context() if tls else None
    return lambda: OneConnection(context)


class Lane:
    """One transport and whether it may go on."""

    def __init__(self, transport: httpx.AsyncBaseTransport) -> None:
        self.transport = transport
        self.spoiled = False


class Lanes:
    """At most `count` lanes, the last used first, so that few connections do most of the work."""

    def __init__(self, factory: Callable[[], httpx.AsyncBaseTransport], count: int) -> None:
        self._factory = factory
        self._room = asyncio.Semaphore(count)
        self._idle: list[Lane] = []
        self._busy: set[Lane] = set()
        self._closing: set[asyncio.Task[None]] = set()

    def __repr__(self) -> str:
        return f"<Lanes {len(self._busy)} busy, {len(self._idle)} idle, {len(self._closing)} closing>"

    @asynccontextmanager
    async def lane(self) -> AsyncIterator[Lane]:
        """Lend a lane; it is thrown away if the block raises anything or marks it as spoiled."""
        async with self._room:
            lane = self._idle.pop() if self._idle else Lane(self._factory())
            self._busy.add(lane)
            try:
                yield lane
            except BaseException:
                lane.spoiled = True
                raise
            finally:
                self._busy.discard(lane)
                if lane.spoiled:
                    self._discard(lane)
                else:
                    self._idle.append(lane)

    def dial(self, host: str, port: int, count: int) -> None:
        """Open connections ahead of the requests that will need them, as far as the transports can."""
        for _ in range(count - len(self._idle) - len(self._busy)):
            lane = Lane(self._factory())
            if isinstance(lane.transport, OneConnection):
                lane.transport.dial(host, port)
            self._idle.insert(0, lane)

    def renew(self, factory: Callable[[], httpx.AsyncBaseTransport] | None) -> None:
        """Use no lane of before again; make new ones by `factory`, if given."""
        self._factory = factory or self._factory
        for lane in self._busy:
            lane.spoiled = True
        while self._idle:
            self._discard(self._idle.pop())

    async def close(self) -> None:
        """Close all lanes that are not lent, and wait for those that are being closed."""
        self.renew(None)
        while self._closing:
            await asyncio.gather(*self._closing, return_exceptions=True)

    def _discard(self, lane: Lane) -> None:
        # A task of its own: the caller may be in the middle of being cancelled, and TLS may wait for a dead peer.
        task = asyncio.get_running_loop().create_task(_close(lane.transport), name="close a connection")
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)


async def _close(transport: httpx.AsyncBaseTransport) -> None:
    try:
        async with asyncio.timeout(CLOSING_SECONDS):
            await transport.aclose()
    except (httpx.HTTPError, OSError, RuntimeError):
        # Nothing more can be done for it. RuntimeError: httpcore refuses to close what a cancel left half open.
        pass
