"""What to answer to a request for a file: RFC 9110 sections 13 and 14, pure.

`judge` takes the request's method and fields and the facts of the file, and returns a `Verdict`: the status, the
header fields and the parts of the file that make up the body. It does no I/O and reads no clock, so every case of
the RFC is a test of one call. Where the RFC leaves a choice:

- a Range that is malformed, inverted or of another unit is ignored (200), as 14.2 allows;
- only GET has ranges; HEAD answers for the whole;
- ranges that overlap or touch are merged; one that remains is a plain 206, up to `MAX_PARTS` become
  multipart/byteranges in the order of their first mention, and what would be more parts, or more bytes than the
  file and `MAX_OVERHEAD`, is refused with 416: no request can make the server send more than that.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass

from .preconditions import Field, FileFacts, if_range_holds, precondition_status

__all__ = ["MAX_OVERHEAD", "MAX_PARTS", "FileFacts", "Part", "Verdict", "judge", "parse_ranges"]

MAX_PARTS = 16
MAX_OVERHEAD = 1024

_SPEC = re.compile(r"([0-9]*)-([0-9]*)")
_BEYOND_ANY_FILE = 1 << 127


@dataclass(frozen=True, slots=True)
class Part:
    """Bytes `start` to `stop` (half open) of the file, after the bytes `head` of a multipart body."""

    start: int
    stop: int
    head: bytes = b""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """A reply, but for its transport.

    Parameters
    ----------
    status : int
        200, 206, 304, 405, 412 or 416.
    headers : tuple of (str, str)
        Fields that follow from request and file, without Content-Length.
    length : int or None
        Content-Length; None for a reply that has no content of the file (304, 405, 412, 416).
    parts : tuple of Part
        The body, in order; empty for HEAD.
    tail : bytes
        What follows the last part.
    """

    status: int
    headers: tuple[tuple[str, str], ...]
    length: int | None = None
    parts: tuple[Part, ...] = ()
    tail: bytes = b""


def judge(method: str, request: Field, facts: FileFacts, *, now: float) -> Verdict:
    """Decide a request for a file.

    Parameters
    ----------
    method : str
        Of the request.
    request : callable of str to str or None
        Header fields by canonical name (``"If-Range"``).
    facts : FileFacts
        Of the file as it is now.
    now : float
        Wall clock, seconds since 1970.
    """
    if method not in ("GET", "HEAD"):
        return Verdict(status=405, headers=(("Allow", "GET, HEAD, OPTIONS"),))
    status = precondition_status(method, request, facts, now=now)
    if status is not None:
        return Verdict(status=status, headers=facts.validators)
    if method == "GET" and (wanted := request("Range")) is not None:
        condition = request("If-Range")
        if condition is None or if_range_holds(condition, facts, now=now):
            ranges = parse_ranges(wanted, facts.length)
            if ranges is not None:
                return _partial(ranges, facts)
    headers = (*facts.validators, ("Content-Type", facts.content_type))
    parts = (Part(0, facts.length),) if method == "GET" else ()
    return Verdict(status=200, headers=headers, length=facts.length, parts=parts)


def parse_ranges(value: str, length: int) -> list[tuple[int, int]] | None:
    """Read a Range field (RFC 9110 14.2).

    Returns
    -------
    list of (int, int), or None
        Half-open ranges inside the file, merged, in the order of their first mention; an empty list if none can be
        satisfied. None if the field is to be ignored.
    """
    unit, equals, specs = value.strip(" \t").partition("=")
    if not equals or unit.lower() != "bytes":
        return None
    ranges: list[tuple[int, int]] = []
    mentioned = False
    for spec in specs.split(","):
        text = spec.strip(" \t")
        if not text:
            continue
        found = _SPEC.fullmatch(text)
        if found is None or text == "-":
            return None
        mentioned = True
        first, last = found.groups()
        if not first:
            start, stop = max(0, length - _number(last)), length
            if length == 0 and _number(last) > 0:
                return None  # satisfiable, yet no Content-Range can name an empty range
        else:
            start, stop = _number(first), min(_number(last) + 1, length) if last else length
            if last and _number(last) < start:
                return None
        if start < stop:
            ranges.append((start, stop))
    return _merge(ranges) if mentioned else None


def _number(digits: str) -> int:
    significant = digits.lstrip("0")
    return int(significant or "0") if len(significant) < 30 else _BEYOND_ANY_FILE


def _merge(ranges: list[tuple[int, int]]) -> list[tuple[int, int]]:
    if len(ranges) < 2:
        return ranges
    merged: list[tuple[int, int, int]] = []
    for start, stop, mention in sorted((start, stop, mention) for mention, (start, stop) in enumerate(ranges)):
        if merged and start <= merged[-1][1]:
            before = merged[-1]
            merged[-1] = (before[0], max(before[1], stop), min(before[2], mention))
        else:
            merged.append((start, stop, mention))
    return [(start, stop) for start, stop, _ in sorted(merged, key=lambda entry: entry[2])]


def _partial(ranges: list[tuple[int, int]], facts: FileFacts) -> Verdict:
    if not ranges or len(ranges) > MAX_PARTS:
        return _unsatisfied(facts)
    if len(ranges) == 1:
        start, stop = ranges[0]
        headers = (
            *facts.validators,
            ("Content-Type", facts.content_type),
            ("Content-Range", f"bytes {start}-{stop - 1}/{facts.length}"),
        )
        return Verdict(status=206, headers=headers, length=stop - start, parts=(Part(start, stop),))
    boundary = hashlib.blake2b(facts.etag.encode(), digest_size=12).hexdigest()
    parts = tuple(
        Part(start, stop, _part_head(boundary, start, stop, facts, first=number == 0))
        for number, (start, stop) in enumerate(ranges)
    )
    tail = f"\r\n--{boundary}--\r\n".encode()
    total = sum(len(part.head) + part.stop - part.start for part in parts) + len(tail)
    if total > facts.length + MAX_OVERHEAD:
        return _unsatisfied(facts)
    headers = (*facts.validators, ("Content-Type", f"multipart/byteranges; boundary={boundary}"))
    return Verdict(status=206, headers=headers, length=total, parts=parts, tail=tail)


def _part_head(boundary: str, start: int, stop: int, facts: FileFacts, *, first: bool) -> bytes:
    return (
        f"{'' if first else chr(13) + chr(10)}--{boundary}\r\nContent-Type: {facts.content_type}\r\n"
        f"Content-Range: bytes {start}-{stop - 1}/{facts.length}\r\n\r\n"
    ).encode()


def _unsatisfied(facts: FileFacts) -> Verdict:
    return Verdict(status=416, headers=(*facts.validators, ("Content-Range", f"bytes */{facts.length}")))
