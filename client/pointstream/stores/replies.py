"""What the head of an HTTP reply to a range request means. Pure: status and headers in, verdict or error out.

RFC 9110: 206 and Content-Range 14.4 and 15.3.7, 200 in place of 206 14.2, 416 15.5.17, If-Match 13.1.1, tags 8.8.3.
The rules beyond it are those of hosts as they are: a 206 may cover more or less than was asked, a 200 may carry a small
file, a cache may answer with another build, a proxy may compress what must not be.
"""

from __future__ import annotations

from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import TYPE_CHECKING

from lpc.errors import FormatError, ModelChanged, NotFound, RangesUnsupported, StoreError
from lpc.ranges import ByteRange, parse_content_range

if TYPE_CHECKING:
    from collections.abc import Mapping

SMALL_FILE = 65_536
"""A 200 of at most this many bytes, or of `SMALL_FACTOR` times what was asked, is taken whole."""
SMALL_FACTOR = 4
MOST_SURPLUS = 1 << 20
"""Bytes before the wanted ones that a host may send along (caches align ranges to blocks)."""
LONGEST_WAIT = 60.0

RETRIED = frozenset({408, 425, 429, 500, 502, 503, 504})
REDIRECTS = frozenset({301, 302, 303, 307, 308})


class Retry(Exception):  # noqa: N818 - a verdict, never seen outside the HTTP store
    """The request failed in a way that another try may cure; `after` is the host's wish in seconds."""

    def __init__(self, reason: str, *, after: float | None = None, stale: bool = False) -> None:
        super().__init__(reason)
        self.after = after
        self.stale = stale


@dataclass(frozen=True, slots=True, kw_only=True)
class Pins:
    """What all replies must agree on, as far as it is known."""

    length: int | None = None
    etag: str | None = None
    """Strong entity tag."""
    ranged: bool = False
    """A 206 has come, so a 200 is an accident."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """The body is this range of the file."""

    start: int
    stop: int
    pins: Pins


@dataclass(frozen=True, slots=True, kw_only=True)
class Whole:
    """The body is the whole file, at most `limit` bytes."""

    limit: int
    length: int | None
    pins: Pins


@dataclass(frozen=True, slots=True)
class Moved:
    """Ask there."""

    location: str


@dataclass(frozen=True, slots=True)
class Beyond:
    """The file has `length` bytes and ends before the wanted range."""

    length: int


Verdict = Part | Whole | Moved | Beyond


def judge(status: int, headers: Mapping[str, str], wanted: ByteRange, pins: Pins, host: str) -> Verdict:
    """Say what to do with a reply.

    Parameters
    ----------
    status : int
    headers : mapping
        Names in lower case (or a case-insensitive mapping).
    wanted : ByteRange
        What was asked.
    pins : Pins
        What earlier replies said.
    host : str
        The address, for messages.

    Raises
    ------
    Retry
        Another try may help.
    ModelChanged, RangesUnsupported, NotFound, StoreError
        None will.
    """
    if status in (200, 206):
        coding = headers.get("content-encoding", "identity").strip().lower()
        if coding not in ("", "identity"):
            raise StoreError(f"{host} compresses the file ({coding[:20]}): switch that off for .lpc files")
        return _part(headers, wanted, pins) if status == 206 else _whole(headers, wanted, pins, host)
    if status in REDIRECTS and "location" in headers:
        return Moved(headers["location"])
    if status == 412:
        raise ModelChanged(f"{host}: another build of the model stands there now")
    if status == 416:
        return _unsatisfied(headers, wanted, pins, host)
    if status in (404, 410):
        raise NotFound(f"{host}: there is no such file (status {status})")
    if status in RETRIED or status >= 500:
        raise Retry(f"status {status}", after=retry_after(headers))
    if status in (401, 403, 407):
        raise StoreError(f"{host} refuses access (status {status})")
    raise StoreError(f"{host} answers with status {status}, which no server of files does: is the address right?")


def strong_tag(headers: Mapping[str, str]) -> str | None:
    """Return the entity tag if it is strong."""
    tag = headers.get("etag", "").strip()
    return tag if len(tag) >= 2 and tag[0] == tag[-1] == '"' else None


def retry_after(headers: Mapping[str, str]) -> float | None:
    """Seconds that the host wants to be left alone: both forms, at most `LONGEST_WAIT`; a date counts from its Date."""
    value = headers.get("retry-after", "").strip()
    if value.isascii() and value.isdigit():
        return min(float(value[:9]), LONGEST_WAIT)
    try:
        wait = parsedate_to_datetime(value) - parsedate_to_datetime(headers["date"])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    return min(max(wait.total_seconds(), 0.0), LONGEST_WAIT)


def content_length(headers: Mapping[str, str]) -> int | None:
    """Return the Content-Length, or None."""
    value = headers.get("content-length", "").strip()
    return int(value) if value.isascii() and value.isdigit() and len(value) <= 18 else None


def _agree(pins: Pins, total: int | None, etag: str | None) -> None:
    if pins.length is not None and total is not None and total != pins.length:
        raise ModelChanged(f"the file has {total} bytes now, it had {pins.length}: another build stands there")
    if pins.etag is not None and etag is not None and etag != pins.etag:
        raise ModelChanged("the file's entity tag changed: another build stands there")


def _part(headers: Mapping[str, str], wanted: ByteRange, pins: Pins) -> Part:
    if headers.get("content-type", "").lower().startswith("multipart/"):
        raise Retry("multipart reply to a single range")
    try:
        start, stop, total = parse_content_range(headers.get("content-range", ""))
    except FormatError as error:
        raise Retry(f"206 with a bad Content-Range ({error})") from error
    etag = strong_tag(headers)
    _agree(pins, total, etag)
    if not start <= wanted.start < stop or wanted.start - start > MOST_SURPLUS:
        raise Retry(f"206 with bytes {start} to {stop - 1}, asked for {wanted.start} to {wanted.stop - 1}")
    length = content_length(headers)
    if length is not None and length != stop - start:
        raise Retry(f"206 whose length {length} is not that of bytes {start} to {stop - 1}")
    known = pins.length if total is None else total
    return Part(start=start, stop=stop, pins=Pins(length=known, etag=pins.etag or etag, ranged=True))


def _whole(headers: Mapping[str, str], wanted: ByteRange, pins: Pins, host: str) -> Whole:
    if pins.ranged:
        raise Retry("status 200 in place of 206")
    length, etag = content_length(headers), strong_tag(headers)
    _agree(pins, length, etag)
    limit = max(SMALL_FILE, SMALL_FACTOR * wanted.size)
    if length is not None and length > limit:
        raise ranges_unsupported(host, length)
    return Whole(limit=limit, length=length, pins=Pins(length=length, etag=etag))


def ranges_unsupported(host: str, length: int | None) -> RangesUnsupported:
    """Return the error that says what to do about a host without ranges."""
    size = "the whole file" if length is None else f"all {length} bytes"
    return RangesUnsupported(
        f"{host} ignores Range requests and sends {size}: serve the file with `pointstream serve`, nginx, Apache or"
        " any object store, or download it and give the path"
    )


def _unsatisfied(headers: Mapping[str, str], wanted: ByteRange, pins: Pins, host: str) -> Beyond:
    unit, _, total = headers.get("content-range", "").strip().partition("*/")
    known = int(total) if unit.strip() == "bytes" and total.isascii() and total.isdigit() else None
    if known is None and pins.length is None:
        raise StoreError(f"{host} cannot give bytes {wanted.start} to {wanted.stop - 1} (status 416)")
    if known is not None:
        _agree(pins, known, None)
    length = pins.length if known is None else known
    assert length is not None
    if length > wanted.start:
        raise Retry(f"status 416 for bytes inside the file of {length}")
    return Beyond(length)
