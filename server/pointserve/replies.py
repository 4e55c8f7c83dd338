"""From a verdict to bytes on a connection.

A reply keeps its promise or ends the connection: where fewer bytes than Content-Length can be sent (the file was cut
short, the peer stalls), the next reply must never land inside the old body.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from aiohttp import web
from multidict import CIMultiDict

if TYPE_CHECKING:
    from .config import ServeConfig
    from .files import OpenFile
    from .ranges import Part, Verdict

SMALL = 256 * 1024
"""Bodies up to here are read and sent in one piece; larger ones go piece by piece through sendfile."""

PIECE = 512 * 1024
"""What one call of sendfile is given, so that a stalled reader is noticed between two."""

BODY_BYTES = web.ResponseKey("body_bytes", int)
"""Content bytes sent, for the access log."""

Fields = tuple[tuple[str, str], ...]


class FileShrunkError(Exception):
    """The file is shorter than its facts say, and nothing has been sent yet."""


async def send(
    request: web.Request, file: OpenFile, verdict: Verdict, *, extra: Fields, config: ServeConfig
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
    config : ServeConfig
        Its `patience` and `slowest` bound the time of the reply.

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
    if verdict.length <= SMALL:
        response: web.StreamResponse = web.Response(
            status=verdict.status, headers=headers, body=await _small_body(file, verdict)
        )
        async with _deadline(request, config, verdict.length):
            await response.prepare(request)
            await response.write_eof()
    else:
        response = web.StreamResponse(status=verdict.status, headers=headers)
        await response.prepare(request)
        for part in verdict.parts:
            if part.head:
                await response.write(part.head)
            await _send_part(request, response, file, part, config)
        await response.write_eof(verdict.tail)
    response[BODY_BYTES] = verdict.length
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
    request: web.Request, response: web.StreamResponse, file: OpenFile, part: Part, config: ServeConfig
) -> None:
    loop = asyncio.get_running_loop()
    at, piece = part.start, PIECE
    while at < part.stop:
        size = min(piece, part.stop - at)
        transport = request.transport
        if transport is None or transport.is_closing():
            raise ConnectionResetError("the reader has gone")
        async with _deadline(request, config, size):
            if piece == PIECE:
                try:
                    sent = await loop.sendfile(transport, file.file, at, size, fallback=False)
                except (asyncio.SendfileNotAvailableError, NotImplementedError):  # TLS, uvloop
                    piece = SMALL
                    continue
            else:
                data = await file.read(at, size)
                sent = len(data)
                await response.write(data)
        if sent < size:
            raise ConnectionResetError("the file was cut short while being sent")
        at += sent


class _deadline:  # noqa: N801 - reads like asyncio.timeout, which it narrows
    """Abort the connection of a reader that takes too long over `size` bytes."""

    def __init__(self, request: web.Request, config: ServeConfig, size: int) -> None:
        self._request = request
        self._timeout = asyncio.timeout(config.patience + size / config.slowest)

    async def __aenter__(self) -> None:
        await self._timeout.__aenter__()

    async def __aexit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        try:
            await self._timeout.__aexit__(kind, error, trace)  # type: ignore[arg-type]
        except TimeoutError:
            if self._request.transport is not None:
                self._request.transport.abort()
            raise ConnectionResetError("the reader takes nothing") from None
