"""A host that can do anything wrong, on the virtual link: each fault is a function that writes the reply itself."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import httpcore

from pointlink.resources import Resource, decide

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from pointlink.memory import Network

    Act = Callable[["Reply"], Awaitable[bool]]


@dataclass
class Reply:
    """The right answer to one request, and the connection to spoil it on."""

    writer: Any
    status: int
    headers: list[tuple[str, str]]
    body: bytes
    number: int = 0
    start: int = 0

    def head(self, status: int | None = None, **changes: str | None) -> bytes:
        """The head; `content_range=None` leaves a field out, a text replaces or adds it."""
        fields = dict(self.headers)
        for name, value in changes.items():
            fields.pop(name.replace("_", "-"), None)
            if value is not None:
                fields[name.replace("_", "-")] = value
        lines = [f"HTTP/1.1 {status or self.status} x", *(f"{name}: {value}" for name, value in fields.items())]
        return "\r\n".join([*lines, "", ""]).encode()

    async def send(self, *parts: bytes) -> None:
        for part in parts:
            self.writer.write(part)
        await self.writer.drain()


@dataclass
class Wicked:
    """Serves one file; `act(reply)` answers instead of the honest host where it returns a function.

    Parameters
    ----------
    data : bytes
        May be replaced while serving.
    act : callable
        Number of the request -> fault, or None for the right answer.
    etag : str
        Of the right answers; None: that of the bytes.
    """

    data: bytes
    act: Callable[[int], Act | None] = lambda _: None
    etag: str | None = None
    log: list[tuple[int, int]] = field(default_factory=list)
    open: set[Any] = field(default_factory=set)

    async def handle(self, reader: Any, writer: Any) -> None:
        self.open.add(writer)
        try:
            while (request := await _request(reader)) is not None:
                number = len(self.log)
                reply = self._right(request, writer, number)
                fault = self.act(number)
                if fault is None:
                    await reply.send(reply.head(), reply.body)
                elif not await fault(reply):
                    return
        except ConnectionError:
            pass
        finally:
            self.open.discard(writer)
            with suppress(ConnectionError):
                writer.close()

    def _right(self, request: dict[str, str], writer: Any, number: int) -> Reply:
        resource = Resource.from_bytes(self.data)
        if self.etag is not None:
            resource = Resource(length=resource.length, etag=self.etag, read=resource.read)
        reply = decide("GET", resource, request, None)
        self.log.append((reply.start, reply.stop))
        body = self.data[reply.start : reply.stop] if reply.resource is not None else b""
        return Reply(writer, reply.status, list(reply.headers), body, number, reply.start)


async def _request(reader: Any) -> dict[str, str] | None:
    head = b""
    while b"\r\n\r\n" not in head:
        part = await reader.read(65_536)
        if not part:
            return None
        head += part
    lines = head.decode("latin-1").split("\r\n")[1:]
    return {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in lines if line)}


class Unsteady(httpcore.AsyncNetworkBackend):
    """A network on which connecting may fail: `act(now)` gives "refused", "nowhere", "hole" or None."""

    def __init__(self, network: Network, act: Callable[[float], str | None]) -> None:
        self.network, self.act = network, act

    async def connect_tcp(self, host: str, port: int, timeout: float | None = None, *rest: Any, **more: Any) -> Any:  # noqa: ASYNC109
        match self.act(asyncio.get_running_loop().time()):
            case "refused":
                raise httpcore.ConnectError("connection refused")
            case "nowhere":
                raise httpcore.ConnectError("name or service not known")
            case "hole":
                await asyncio.sleep(timeout or 3600.0)
                raise httpcore.ConnectTimeout("no answer")
        return await self.network.connect_tcp(host, port, timeout)

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(seconds)


def fault(*parts: Any, keep: bool = False, reset: bool = False) -> Act:
    """A fault that sends parts: bytes, functions of the reply, or numbers: seconds to wait."""

    async def act(reply: Reply) -> bool:
        for part in parts:
            if isinstance(part, int | float):
                await asyncio.sleep(part)
            else:
                await reply.send(part(reply) if callable(part) else part)
        if reset:
            await asyncio.sleep(0.2)  # what was sent gets there first
            reply.writer.abort()
        return keep

    return act
