"""Bytes to serve by ranges, and which reply a request for them gets. Pure but for the callable that reads bytes."""

from __future__ import annotations

import hashlib
import inspect
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from lpc.errors import NotFound
from pointlink.faults import Fault, IgnoreRange, OtherEtag, Shift, Status

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable
    from pathlib import Path

CHUNK = 64 * 1024
_RANGE = re.compile(r"bytes=(?:(\d{1,300})-(\d{0,300})|-(\d{1,300}))", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True, slots=True)
class Resource:
    """Something to serve.

    Parameters
    ----------
    length
        Bytes.
    etag
        Strong entity tag with its quotes.
    read
        ``read(start, stop)`` returns those bytes or an awaitable of them; fewer make the origin cut the reply.
    content_type
        Media type.
    """

    length: int
    etag: str
    read: Callable[[int, int], bytes | Awaitable[bytes]]
    content_type: str = "application/octet-stream"

    @classmethod
    def from_bytes(cls, data: bytes) -> Resource:
        """Serve these bytes under a tag of their content."""
        return cls(length=len(data), etag=f'"{hashlib.sha256(data).hexdigest()[:16]}"', read=lambda a, b: data[a:b])

    @classmethod
    def from_path(cls, path: Path) -> Resource:
        """Serve a file as long as it is now; it is read anew for each range.

        Raises
        ------
        NotFound
            There is no such readable file.
        """

        def read(start: int, stop: int) -> bytes:
            with path.open("rb") as file:
                file.seek(start)
                return file.read(stop - start)

        try:
            read(0, 1)
            stat = path.stat()
        except OSError as error:
            raise NotFound(f"{path}: cannot be read ({error.strerror}); give the path of a file") from error
        return cls(length=stat.st_size, etag=f'"{stat.st_size:x}-{stat.st_mtime_ns:x}"', read=read)


@dataclass(frozen=True, kw_only=True, slots=True)
class Reply:
    """What to send: status, headers, and the bytes ``[start, stop)`` of a resource (None: no body)."""

    status: int
    headers: tuple[tuple[str, str], ...] = ()
    resource: Resource | None = None
    start: int = 0
    stop: int = 0


def select_range(text: str | None, length: int) -> tuple[int, int] | None:
    """Return the one range ``[start, stop)`` that a Range header asks of ``length`` bytes; None: send everything.

    Raises
    ------
    IndexError
        The range is well formed and lies outside (416).
    """
    match = _RANGE.fullmatch(text.strip()) if text else None
    if match is None:
        return None
    first, last, suffix = match.groups()
    if suffix is not None:
        start, stop = max(0, length - int(suffix)), length
    else:
        start, stop = int(first), min(length, int(last) + 1) if last else length
        if last and int(last) < start:
            return None
    if start >= stop:
        raise IndexError(text)
    return start, stop


def decide(method: str, resource: Resource | None, asked: dict[str, str], fault: Fault | None) -> Reply:
    """Return the reply to a request; ``asked`` are its headers by lower-case name."""
    empty = ("content-length", "0")
    if isinstance(fault, Status):
        retry = (("retry-after", fault.retry_after),) if fault.retry_after is not None else ()
        return Reply(status=fault.code, headers=(empty, *retry))
    if resource is None:
        return Reply(status=404, headers=(empty,))
    if method not in ("GET", "HEAD"):
        return Reply(status=405, headers=(empty, ("allow", "GET, HEAD")))
    if isinstance(fault, OtherEtag):
        resource = replace(resource, etag=fault.etag)
    tag = ("etag", resource.etag)
    if "if-match" in asked and not _lists(asked["if-match"], resource.etag):
        return Reply(status=412, headers=(empty, tag))
    if "if-none-match" in asked and _lists(asked["if-none-match"], resource.etag):
        return Reply(status=304, headers=(tag,))
    common = (tag, ("accept-ranges", "bytes"), ("content-type", resource.content_type))
    wanted = None
    if method == "GET" and asked.get("if-range", resource.etag) == resource.etag and not isinstance(fault, IgnoreRange):
        try:
            wanted = select_range(asked.get("range"), resource.length)
        except IndexError:
            return Reply(status=416, headers=(empty, tag, ("content-range", f"bytes */{resource.length}")))
    if wanted is None:
        size = ("content-length", str(resource.length))
        return Reply(status=200, headers=(size, *common), resource=resource, stop=resource.length)
    start, stop = wanted
    if isinstance(fault, Shift):
        start, stop = min(start + fault.by, resource.length - 1), min(stop + fault.by, resource.length)
    place = ("content-range", f"bytes {start}-{stop - 1}/{resource.length}")
    size = ("content-length", str(stop - start))
    return Reply(status=206, headers=(size, place, *common), resource=resource, start=start, stop=stop)


def _lists(header: str, etag: str) -> bool:
    return header.strip() == "*" or etag in [item.strip() for item in header.split(",")]


async def body_of(reply: Reply) -> AsyncIterator[bytes]:
    """Read the body of a reply piece by piece; it ends early where the resource does."""
    if reply.resource is None:
        return
    at = reply.start
    while at < reply.stop:
        data = reply.resource.read(at, min(at + CHUNK, reply.stop))
        if inspect.isawaitable(data):
            data = await data
        if not data:
            return
        yield data
        at += len(data)
