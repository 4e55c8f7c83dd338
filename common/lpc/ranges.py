"""Byte ranges: what to ask of a store, and how neighbouring ones become one request. Pure."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from .errors import FormatError

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(frozen=True, slots=True, order=True)
class ByteRange:
    """Bytes `start` to `stop` of a file, `stop` excluded; never empty."""

    start: int
    stop: int

    def __post_init__(self) -> None:
        if not 0 <= self.start < self.stop:
            raise ValueError(f"range {self.start}:{self.stop} is empty or starts before 0")

    @property
    def size(self) -> int:
        """Bytes in the range."""
        return self.stop - self.start

    @property
    def header(self) -> str:
        """Value of the HTTP header ``Range``, whose last byte is included (RFC 9110, 14.1.2)."""
        return f"bytes={self.start}-{self.stop - 1}"

    def __contains__(self, other: ByteRange) -> bool:
        return self.start <= other.start and other.stop <= self.stop

    def within(self, data: bytes | memoryview, part: ByteRange) -> memoryview:
        """Cut `part` out of the bytes of this range, without a copy."""
        if part not in self or len(data) != self.size:
            raise ValueError(f"{part} is not in the {len(data)} bytes of {self}")
        return memoryview(data)[part.start - self.start : part.stop - self.start]


def coalesce(ranges: Sequence[ByteRange], max_gap: int, max_bytes: int) -> list[tuple[ByteRange, list[int]]]:
    """Plan requests for ranges that are wanted, most urgent first.

    Neighbours in the file are merged when at most `max_gap` unwanted bytes lie between them and the merged range
    has at most `max_bytes` bytes. Ranges that touch or overlap count as a gap of 0; a single range may be longer.

    Parameters
    ----------
    ranges : sequence of ByteRange
        In order of priority, in any order of place; may overlap.
    max_gap : int
        Bytes that are cheaper to read than a request (goodput times the cost of one).
    max_bytes : int
        Longest merged range: what follows in it has to wait for all of it.

    Returns
    -------
    list of (ByteRange, list of int)
        Requests in order of their most urgent member; each with the positions in `ranges` of its members, which are
        in order of place, as their bytes arrive. Every position occurs exactly once.
    """
    plan: list[tuple[int, int, list[int]]] = []
    for number in sorted(range(len(ranges)), key=lambda i: (ranges[i].start, ranges[i].stop, i)):
        start, stop = ranges[number].start, ranges[number].stop
        if plan:
            first, last, members = plan[-1]
            stop = max(stop, last)
            if start - last <= max_gap and stop - first <= max_bytes:
                members.append(number)
                plan[-1] = (first, stop, members)
                continue
        plan.append((start, ranges[number].stop, [number]))
    plan.sort(key=lambda request: min(request[2]))
    return [(ByteRange(first, last), members) for first, last, members in plan]


_CONTENT_RANGE = re.compile(r"bytes ([0-9]{1,18})-([0-9]{1,18})/([0-9]{1,18}|\*)", re.ASCII | re.IGNORECASE)


def parse_content_range(text: str) -> tuple[int, int, int | None]:
    """Read the HTTP header ``Content-Range`` of a 206 reply (RFC 9110, 14.4).

    Returns
    -------
    start, stop : int
        Half-open.
    total : int or None
        Length of the whole file; None if the host does not know it.

    Raises
    ------
    FormatError
        If it is anything else, ``bytes */n`` of a 416 reply included.
    """
    match = _CONTENT_RANGE.fullmatch(text.strip(" \t"))
    if match is None:
        raise FormatError(f"Content-Range {text[:80]!r} is not `bytes FIRST-LAST/LENGTH`")
    start, last = int(match[1]), int(match[2])
    total = None if match[3] == "*" else int(match[3])
    if last < start or (total is not None and last >= total):
        raise FormatError(f"Content-Range {text[:80]!r} contradicts itself")
    return start, last + 1, total
