"""Hosts to put under the HTTP store: over a virtual link, on a real socket, and answering whatever a script says."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import httpx

from pointlink import virtual
from pointlink.memory import Network
from pointlink.origin import Origin, serve_origin
from pointlink.profiles import LAN, Profile
from pointlink.resources import Resource
from pointstream.cache import Cache
from pointstream.stores import LocalStore, MemoryStore
from pointstream.stores.cached import CachedStore
from pointstream.stores.dialling import OneConnection
from pointstream.stores.http import HttpOptions, HttpStore

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable
    from pathlib import Path

    from pointstream.stores import Store

ADDRESS = "http://host.test/model.lpc"
PATH = "/model.lpc"


def origin_of(data: bytes, fault: Callable[[int], Any] | dict[int, Any] | None = None) -> Origin:
    """An honest host of one file, or one that misbehaves at some requests."""
    act = fault.get if isinstance(fault, dict) else fault
    resources = {PATH: Resource.from_bytes(data)}
    return Origin(resources=resources) if act is None else Origin(resources=resources, fault=act)


@asynccontextmanager
async def virtual_store(
    origin: Origin, profile: Profile = LAN, options: HttpOptions | None = None
) -> AsyncIterator[HttpStore]:
    """An HTTP store over a simulated link; runs on a virtual loop. Nothing may be left when it is closed."""
    network = Network(origin, profile)
    store = HttpStore(
        ADDRESS,
        clock=asyncio.get_running_loop().time,
        options=options,
        transports=lambda: OneConnection(backend=network, keep_alive=None),
    )
    before = asyncio.all_tasks()
    try:
        yield store
    finally:
        await store.close()
        await network.aclose()
        for _ in range(3):  # httpcore leaves the end of its generators to the event loop
            await asyncio.sleep(0)
        assert asyncio.all_tasks() <= before, f"left: {asyncio.all_tasks() - before}"


@asynccontextmanager
async def socket_store(origin: Origin, options: HttpOptions | None = None) -> AsyncIterator[HttpStore]:
    """An HTTP store over a real loopback socket."""
    server = await serve_origin(origin)
    port = server.sockets[0].getsockname()[1]
    store = HttpStore(f"http://127.0.0.1:{port}{PATH}", clock=asyncio.get_running_loop().time, options=options)
    try:
        yield store
    finally:
        await store.close()
        server.close()


KINDS = ("memory", "local", "virtual", "socket", "cached")


def with_store(kind: str, data: bytes, folder: Path, check: Callable[[Store], Awaitable[None]]) -> None:
    """Run a check on a store of some kind that holds `data`."""

    async def run() -> None:
        if kind == "virtual":
            async with virtual_store(origin_of(data)) as store:
                await check(store)
        elif kind == "socket":
            async with socket_store(origin_of(data)) as store:
                await check(store)
        elif kind == "cached":
            async with virtual_store(origin_of(data)) as store:
                cached = CachedStore(store, Cache(folder / "cache"))
                try:
                    await check(cached)
                finally:
                    await cached.close()
        else:
            path = folder / "file"
            path.write_bytes(data)
            plain: Store = LocalStore(path) if kind == "local" else MemoryStore(data, chunk=700)
            try:
                await check(plain)
            finally:
                await plain.close()

    if kind in ("virtual", "cached"):
        virtual.run(run())
    else:
        asyncio.run(run())


class Script(httpx.AsyncBaseTransport):
    """Answer request n by a function; the n-th transport of a store goes on where the others are."""

    def __init__(self, answer: Callable[[int, httpx.Request], httpx.Response]) -> None:
        self.answer = answer
        self.requests: list[httpx.Request] = []
        self.closed = 0

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        self.requests.append(request)
        trace = request.extensions["trace"]
        await trace("connection.connect_tcp.started", {})
        await trace("http11.send_request_headers.started", {})
        return self.answer(len(self.requests) - 1, request)

    async def aclose(self) -> None:
        self.closed += 1


class Pieces(httpx.AsyncByteStream):
    """A body in pieces; an exception among them is raised in its turn."""

    def __init__(self, *pieces: bytes | Exception) -> None:
        self.pieces = pieces

    async def __aiter__(self) -> AsyncIterator[bytes]:
        for piece in self.pieces:
            if isinstance(piece, Exception):
                raise piece
            yield piece


def reply(status: int, body: bytes = b"", **headers: str) -> httpx.Response:
    """A reply as a transport gives it; `content_range="..."` becomes ``Content-Range``."""
    fields = {name.replace("_", "-"): value for name, value in headers.items()}
    return httpx.Response(status, headers=fields, stream=Pieces(body))


def range_of(request: httpx.Request) -> tuple[int, int]:
    """First and one past the last byte that a request asks for."""
    first, _, last = request.headers["range"].removeprefix("bytes=").partition("-")
    return int(first), int(last) + 1


def honest(data: bytes, request: httpx.Request, etag: str = '"one"') -> httpx.Response:
    """The right answer."""
    start, stop = range_of(request)
    stop = min(stop, len(data))
    if start >= len(data):
        return reply(416, content_range=f"bytes */{len(data)}")
    return reply(206, data[start:stop], content_range=f"bytes {start}-{stop - 1}/{len(data)}", etag=etag)


def scripted(answer: Callable[[int, httpx.Request], httpx.Response], **options: Any) -> tuple[HttpStore, Script]:
    """An HTTP store on a script; runs on a virtual loop."""
    script = Script(answer)
    clock = asyncio.get_running_loop().time
    return HttpStore(ADDRESS, clock=clock, transports=lambda: script, options=HttpOptions(**options)), script
