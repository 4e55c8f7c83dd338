"""A strict little HTTP/1.1 client on a bare socket: it sends what it is told, mends nothing and reads exact bodies."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from types import TracebackType


@dataclass(frozen=True)
class Reply:
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def closes(self) -> bool:
        return self.headers.get("connection") == "close"


class RawConnection:
    """One connection; `async with RawConnection(url) as connection`."""

    def __init__(self, url: str) -> None:
        host, _, port = url.removeprefix("http://").rstrip("/").partition(":")
        self.host, self.port = host, int(port)

    async def __aenter__(self) -> Self:
        self.reader, self.writer = await asyncio.open_connection(self.host, self.port, limit=1 << 20)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.writer.close()
        with contextlib.suppress(ConnectionError):
            await self.writer.wait_closed()

    async def ask(self, target: str, *lines: str, method: str = "GET", body: bytes = b"") -> Reply:
        """Send one request with these header lines and read its reply."""
        length = [f"Content-Length: {len(body)}"] if body else []
        head = "\r\n".join([f"{method} {target} HTTP/1.1", "Host: test", *lines, *length, "", ""])
        self.writer.write(head.encode("latin-1") + body)
        return await self.read(method)

    async def read_head(self) -> tuple[int, dict[str, str]]:
        head = (await asyncio.wait_for(self.reader.readuntil(b"\r\n\r\n"), 10)).decode("latin-1")
        status, *fields = head.removesuffix("\r\n\r\n").split("\r\n")
        assert status.startswith("HTTP/1."), status
        headers: dict[str, str] = {}
        for line in fields:
            name, _, value = line.partition(": ")
            assert name.lower() not in headers, f"{name} stands twice"
            headers[name.lower()] = value
        return int(status.split(" ")[1]), headers

    async def read(self, method: str = "GET") -> Reply:
        status, headers = await self.read_head()
        assert "transfer-encoding" not in headers
        if method == "HEAD" or status in (204, 304):
            return Reply(status, headers, b"")
        body = await asyncio.wait_for(self.reader.readexactly(int(headers["content-length"])), 10)
        return Reply(status, headers, body)

    async def at_end(self) -> bool:
        """Whether the server closes without sending more."""
        try:
            return await asyncio.wait_for(self.reader.read(1), 10) == b""
        except ConnectionError:
            return True


async def ask_once(url: str, target: str, *lines: str, method: str = "GET") -> Reply:
    """Ask over a connection of its own."""
    async with RawConnection(url) as connection:
        return await connection.ask(target, *lines, method=method)
