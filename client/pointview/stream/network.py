"""A model at the far end of a link: the same access layer over a real or a virtual network.

==========  ==================================  =========================================================
target      real clock                          virtual clock
==========  ==================================  =========================================================
path        an origin on a loopback socket,     an origin in memory, behind an in-memory link
            behind the throttled front
address     the throttled front before it       an origin in memory that fetches from the address outside
                                                of the virtual time
==========  ==================================  =========================================================

With ``none`` for a link there is no front: a path is read as a file, an address directly.
"""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar
from urllib.parse import urlsplit

import httpx

from lpc.errors import LpcError, RangesUnsupported, StoreError, Unavailable
from lpc.ranges import parse_content_range
from pointlink import virtual
from pointlink.front import parse_upstream, precise_loop, serve_front
from pointlink.memory import Network
from pointlink.origin import Origin, serve_origin
from pointlink.resources import Resource
from pointstream.stores import Store, is_address, open_store
from pointstream.stores.dialling import OneConnection
from pointstream.stores.http import HttpStore
from pointstream.stores.sparse import map_path

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from pointlink.profiles import Profile

ClockKind = Literal["real", "virtual"]
T = TypeVar("T")

MODEL = "/model.lpc"
FETCH_TIMEOUT = 30.0


def run(kind: ClockKind, main: Awaitable[T]) -> T:
    """Run a coroutine to its end on an event loop of that clock."""

    async def wait() -> T:
        return await main

    if kind == "virtual":
        return virtual.run(wait())
    with asyncio.Runner(loop_factory=precise_loop) as runner:
        return runner.run(wait())


@asynccontextmanager
async def open_link(target: str, profile: Profile, kind: ClockKind) -> AsyncIterator[Callable[[], Store]]:
    """Put a link before a model.

    Parameters
    ----------
    target : str
        Path or http(s) address of a .lpc file.
    profile : Profile
        The link; without rates and round-trip time there is none.
    kind : {"real", "virtual"}
        Must be the clock of the running loop.

    Yields
    ------
    callable
        Makes the store that reads through the link. It connects when it is first read.

    Raises
    ------
    StoreError
        If the target cannot be reached.
    """
    clock = asyncio.get_running_loop().time
    free = profile.down_rate is None and profile.up_rate is None and profile.rtt == 0.0
    unlinked = free and kind == "real"
    if not unlinked and not is_address(target) and map_path(Path(target)).is_file():
        raise StoreError(
            f"{target} is the copy of a part: complete it with `pointstream fetch`, or use --link none --clock real"
        )
    async with AsyncExitStack() as stack:
        if kind == "virtual":
            resource = _remote_resource(target, stack) if is_address(target) else Resource.from_path(Path(target))
            network = Network(Origin(resources={MODEL: resource}), profile)
            stack.push_async_callback(network.aclose)
            yield lambda: HttpStore(
                f"http://model.example{MODEL}",
                clock=clock,
                transports=lambda: OneConnection(backend=network, keep_alive=None),
            )
        elif unlinked:
            yield lambda: open_store(target, clock=clock)
        else:
            address = target
            if not is_address(target):
                origin = Origin(resources={MODEL: Resource.from_path(Path(target))})
                server = await stack.enter_async_context(await serve_origin(origin))
                host, port = server.sockets[0].getsockname()[:2]
                address = f"http://{host}:{port}{MODEL}"
            through = await stack.enter_async_context(_front(address, profile))
            yield lambda: HttpStore(through, clock=clock)


@asynccontextmanager
async def _front(address: str, profile: Profile) -> AsyncIterator[str]:
    """Put a throttled front before an address; yield the address that stands for it."""
    try:
        upstream = parse_upstream(address)
    except ValueError as error:
        raise StoreError(str(error)) from error
    async with await serve_front(upstream, profile) as front:
        login, at, _ = urlsplit(address).netloc.rpartition("@")
        yield front.url.replace("://", f"://{login}{at}", 1)


def _remote_resource(address: str, stack: AsyncExitStack) -> Resource:
    """Return a resource whose bytes are fetched while the virtual clock stands still."""
    client = stack.enter_context(
        httpx.Client(timeout=FETCH_TIMEOUT, follow_redirects=True, headers={"Accept-Encoding": "identity"})
    )

    def fetch(start: int, stop: int) -> tuple[bytes, int, str]:
        try:
            reply = client.get(address, headers={"Range": f"bytes={start}-{stop - 1}"})
            reply.raise_for_status()
            _, _, total = parse_content_range(reply.headers.get("Content-Range", ""))
        except httpx.InvalidURL as error:
            raise StoreError(f"{address} is no address: {error}") from error
        except httpx.HTTPError as error:
            raise Unavailable(f"{address}: cannot be read: {error}") from error
        except (LpcError, ValueError) as error:
            raise RangesUnsupported(
                f"{address}: the host does not answer byte ranges; try `pointstream serve`"
            ) from error
        if total is None:
            raise RangesUnsupported(f"{address}: the host does not say how long the file is")
        return reply.content, total, reply.headers.get("ETag", '"model"')

    _, length, etag = fetch(0, 1)
    return Resource(length=length, etag=etag.removeprefix("W/"), read=lambda start, stop: fetch(start, stop)[0])
