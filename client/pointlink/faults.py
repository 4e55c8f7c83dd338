"""How an origin can be told to misbehave, one request at a time.

An :class:`~pointlink.origin.Origin` asks ``fault(number)`` for every request, counted from 0 over all connections in
the order in which their heads arrive, so ``fault={3: Reset(after=100)}.get`` spoils the fourth. Faults of the reply
change its head; faults of the body change the bytes, after the head has promised the right ones.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


class ResetNow(Exception):  # noqa: N818 - a signal to the origin, not an error of anybody
    """Tell the origin to reset the connection."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Status:
    """Answer with this status and no body, whatever was asked; ``retry_after`` becomes the header of that name."""

    code: int = 503
    retry_after: str | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class IgnoreRange:
    """Answer 200 with the whole resource in place of 206."""


@dataclass(frozen=True, kw_only=True, slots=True)
class OtherEtag:
    """Answer under another entity tag, as after a new build at the same address."""

    etag: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Shift:
    """Send, and declare in Content-Range, a range that starts ``by`` bytes later than the one asked for."""

    by: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Reset:
    """Reset the connection after ``after`` bytes of body; None: before the head."""

    after: int | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Short:
    """Close the connection, in order, when ``missing`` bytes of the body are still to come."""

    missing: int = 1


@dataclass(frozen=True, kw_only=True, slots=True)
class Stall:
    """Send nothing for some seconds after ``after`` bytes of body; None: before the head."""

    seconds: float
    after: int | None = 0


@dataclass(frozen=True, kw_only=True, slots=True)
class Flip:
    """Invert the bits ``mask`` of the byte at ``at`` in the body."""

    at: int = 0
    mask: int = 1


Fault = Status | IgnoreRange | OtherEtag | Shift | Reset | Short | Stall | Flip


async def before_head(fault: Fault | None) -> None:
    """Do what a fault does before the head of the reply.

    Raises
    ------
    ResetNow
        The connection is to be reset.
    """
    match fault:
        case Reset(after=None):
            raise ResetNow
        case Stall(seconds=seconds, after=None):
            await asyncio.sleep(seconds)


async def spoil(fault: Fault | None, length: int, chunks: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """Pass a body of ``length`` bytes through a fault.

    Raises
    ------
    ResetNow
        The bytes up to here are to be sent, then the connection is to be reset.
    """
    match fault:
        case Reset(after=int(at)) | Stall(after=int(at)):
            cut = at
        case Short(missing=missing):
            cut = max(0, length - missing)
        case Flip(at=at):
            cut = at
        case _:
            cut = length
    sent = 0
    async for chunk in chunks:
        before, rest = chunk[: max(0, cut - sent)], chunk[max(0, cut - sent) :]
        at_cut = sent <= cut < sent + len(chunk)
        sent += len(chunk)
        if before:
            yield before
        if at_cut:
            match fault:
                case Reset():
                    raise ResetNow
                case Short():
                    return
                case Stall(seconds=seconds):
                    await asyncio.sleep(seconds)
                case Flip(mask=mask):
                    rest = bytes([rest[0] ^ mask]) + rest[1:]
        if rest:
            yield rest
