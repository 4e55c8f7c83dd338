"""From a verdict to bytes on a connection.

A reply keeps its promise or ends the connection: where fewer bytes than Content-Length can be sent (the file was cut
short, the peer stalls), the next reply must never land inside the old body.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING

from aiohttp import web
from multidict import CIMultiDict

from .accesslog import SENT_BYTES

if TYPE_CHECKING:
    from .files import OpenFile
    from .ranges import Part, Verdict
    from .rate import RateCap

SMALL = 256 * 1024
"""Bodies up to here are read and sent in one piece; larger ones go piece by piece."""

LARGE = 4 * 1024 * 1024
"""Parts from here on go through sendfile: it spares copies, but each call waits for the socket to drain, which below
this size costs more than the copies do (benchmarks/serve.py). What it has under way are the file's own pages: where
a file is cut short in place they read as zeros, until the connection is closed for it."""

PIECE = 1024 * 1024
"""What one call of sendfile is given, so that a stalled reader is noticed between two."""

Fields = tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """How fast replies may and have to go.

    Parameters
    ----------
    patience : float
        Seconds for which a reader may take nothing.
    slowest : float
        Bytes a second that it has to take beyond that.
    cap : RateCap, optional
        What one address may have a second.
    """

    patience: float
    slowest: float
    cap: RateCap | None = None

    async def turn(self, request: web.Request, size: int) -> None:
        """Wait until the peer may have `size` more bytes."""
        if self.cap is not None and (delay := self.cap.delay(request.remote or "?", size)) > 0:
            await asyncio.sleep(delay)

    def deadline(self, request: web.Request, size: int) -> _Deadline:
        """Bound the time in which the peer takes `size` bytes."""
        return _Deadline(request, self.patience + size / self.slowest)


class FileShrunkError(Exception):
    """The file is shorter than its facts say, and nothing has been sent yet."""


async def send(
    request: web.Request, file: OpenFile, verdict: Verdict, *, extra: Fields, pace: Pace
) -> web.StreamResponse:
    """Send a reply.

    Parameters
    ----------
    request : web.Request
        The request that it answers.
    file : OpenFile
        Leased for the duration of the call.
    verdict : Verdict
        What `ranges.judge` decided.
    extra : tuple of (str, str)
        More header fields.
    pace : Pace
        How fast it may and has to go.

    Raises
    ------
    FileShrunkError
        If the file ends before the first byte could be promised.
    ConnectionResetError
        If the connection has to be closed because the promise cannot be kept.
    """
    headers = CIMultiDict((*verdict.headers, *extra))
    if verdict.length is None:
        body = _explanation(verdict, file.facts.length) if request.method != "HEAD" else None
        return web.Response(status=verdict.status, headers=headers, text=body)
    headers["Content-Length"] = str(verdict.length)
    if not verdict.parts:
        return web.Response(status=verdict.status, headers=headers)
    small = SMALL if pace.cap is None else min(SMALL, pace.cap.piece)
    if verdict.length <= small:
        response: web.StreamResponse = web.Response(
            status=verdict.status, headers=headers, body=await _small_body(file, verdict)
        )
        await pace.turn(request, verdict.length)
        async with pace.deadline(request, verdict.length):
            await response.prepare(request)
            await response.write_eof()
        return response
    response = web.StreamResponse(status=verdict.status, headers=headers)
    request[SENT_BYTES] = 0
    await response.prepare(request)
    for part in verdict.parts:
        if part.head:
            await response.write(part.head)
        await _send_part(request, response, file, part, pace)
    await response.write_eof(verdict.tail)
    request[SENT_BYTES] = verdict.length
    return response


def _explanation(verdict: Verdict, length: int) -> str | None:
    if verdict.status == 412:
        return "412 another build of the model stands here now; read it again from its start\n"
    if verdict.status == 416:
        return f"416 the file has {length} bytes; ask for at most 16 ranges that begin inside it\n"
    if verdict.status == 405:
        return "405 models are read with GET and HEAD\n"
    return None


async def _small_body(file: OpenFile, verdict: Verdict) -> bytes | bytearray:
    pieces: list[bytes | bytearray] = []
    for part in verdict.parts:
        data = await file.read(part.start, part.stop - part.start)
        if len(data) < part.stop - part.start:
            raise FileShrunkError
        pieces += (part.head, data) if part.head else (data,)
    return pieces[0] if len(pieces) == 1 else b"".join((*pieces, verdict.tail))


async def _send_part(
    request: web.Request, response: web.StreamResponse, file: OpenFile, part: Part, pace: Pace
) -> None:
    loop = asyncio.get_running_loop()
    transport = request.transport
    by_kernel = part.stop - part.start >= LARGE and transport is not None and _has_sendfile(loop, transport)
    piece = PIECE if by_kernel else SMALL
    if pace.cap is not None:
        piece = min(piece, pace.cap.piece)
    at = part.start
    while at < part.stop:
        size = min(piece, part.stop - at)
        await pace.turn(request, size)
        if transport is None or transport.is_closing():
            raise ConnectionResetError("the reader has gone")
        async with pace.deadline(request, size):
            if by_kernel:
                sent = await loop.sendfile(transport, file.file, at, size, fallback=False)
            else:
                data = await file.read(at, size)
                sent = len(data)
                await response.write(data)
        at += sent
        request[SENT_BYTES] += sent
        if sent < size:
            raise ConnectionResetError("the file was cut short while being sent")


def _has_sendfile(loop: asyncio.AbstractEventLoop, transport: asyncio.BaseTransport) -> bool:
    """Whether the kernel can send a file over a connection: not over TLS, and not in uvloop, which has no such call."""
    return isinstance(loop, asyncio.BaseEventLoop) and transport.get_extra_info("sslcontext") is None


class _Deadline:
    """Abort the connection of a reader that takes too long; a context that narrows `asyncio.timeout`."""

    def __init__(self, request: web.Request, seconds: float) -> None:
        self._request = request
        self._timeout = asyncio.timeout(seconds)

    async def __aenter__(self) -> None:
        await self._timeout.__aenter__()

    async def __aexit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        try:
            await self._timeout.__aexit__(kind, error, trace)  # type: ignore[arg-type]
        except TimeoutError:
            if self._request.transport is not None:
                self._request.transport.abort()
            raise ConnectionResetError("the reader takes nothing") from None
