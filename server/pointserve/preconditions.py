"""Validators and preconditions of a request: RFC 9110 section 13, pure.

A request names the build that it wants by entity tag or by date; the facts of the file say which build stands
there. `precondition_status` walks the fields in the order that section 13.2.2 fixes, `if_range_holds` answers the
one question left for a Range. Fields that cannot be parsed are treated as the RFC says: a date that is none is
ignored, a tag list that is none matches nothing.
"""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

Field = Callable[[str], str | None]
"""Value of a request header field by its canonical name, lines of the same name joined by commas; None: absent."""


class EntityTag(NamedTuple):
    """An entity tag; `opaque` keeps its quotes."""

    opaque: str
    weak: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class FileFacts:
    """What a reply says about a file.

    Parameters
    ----------
    length : int
        Bytes.
    etag : str
        Strong entity tag with its quotes.
    modified : int
        Seconds since 1970, UTC; never later than the moment the file was opened.
    content_type : str
        Media type of the whole.
    """

    length: int
    etag: str
    modified: int
    content_type: str = "application/octet-stream"
    validators: tuple[tuple[str, str], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        fields = (("ETag", self.etag), ("Last-Modified", http_date(self.modified)), ("Accept-Ranges", "bytes"))
        object.__setattr__(self, "validators", fields)


def precondition_status(method: str, request: Field, facts: FileFacts, *, now: float) -> int | None:
    """Return 304 or 412 where a precondition says so, None where the method goes on (RFC 9110 13.2.2)."""
    if (wanted := request("If-Match")) is not None:
        if not _tags_match(wanted, facts.etag, strong=True):
            return 412
    elif (latest := parse_http_date(request("If-Unmodified-Since"), now=now)) is not None and facts.modified > latest:
        return 412
    safe = method in ("GET", "HEAD")
    if (known := request("If-None-Match")) is not None:
        if _tags_match(known, facts.etag, strong=False):
            return 304 if safe else 412
    elif safe and (since := parse_http_date(request("If-Modified-Since"), now=now)) is not None:
        return 304 if facts.modified <= since else None
    return None


def if_range_holds(value: str, facts: FileFacts, *, now: float) -> bool:
    """Tell whether an If-Range field allows the Range beside it (RFC 9110 13.1.5).

    A date is a strong validator only if the file did not change within a second of it (8.8.2.2), and has to be
    equal, not merely later. A weak tag never holds.
    """
    tags = parse_tags(value)
    if tags is not None:
        return len(tags) == 1 and not tags[0].weak and tags[0].opaque == facts.etag
    date = parse_http_date(value, now=now)
    return date is not None and date == facts.modified and now - facts.modified >= 1


def _tags_match(value: str, etag: str, *, strong: bool) -> bool:
    if value.strip(" \t") == "*":
        return True
    return any(tag.opaque == etag and not (strong and tag.weak) for tag in parse_tags(value) or ())


_TAG = re.compile(r'(W/)?("[^"\x00-\x20\x7f]*")[ \t]*(?=,|$)')
_SEPARATORS = re.compile(r"[ \t,]*")


def parse_tags(value: str) -> list[EntityTag] | None:
    """Read a list of entity tags (RFC 9110 8.8.3); None where the text is no such list.

    Commas may stand inside a tag, and empty elements between tags are allowed (5.6.1.2).
    """
    tags = []
    at = _end_of(_SEPARATORS, value, 0)
    while at < len(value):
        found = _TAG.match(value, at)
        if found is None:
            return None
        tags.append(EntityTag(found[2], found[1] is not None))
        at = _end_of(_SEPARATORS, value, found.end())
    return tags or None


def _end_of(pattern: re.Pattern[str], text: str, at: int) -> int:
    found = pattern.match(text, at)
    return found.end() if found else at


_DAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
_TIME = r"(?P<h>[0-9]{2}):(?P<m>[0-9]{2}):(?P<s>[0-9]{2})"
_DAY = "|".join(_DAYS)
_MONTH = rf"(?P<month>{'|'.join(_MONTHS)})"
_FORMATS = (
    re.compile(rf"(?:{_DAY}), (?P<day>[0-9]{{2}}) {_MONTH} (?P<year>[0-9]{{4}}) {_TIME} GMT"),
    re.compile(
        rf"(?:Mon|Tues|Wednes|Thurs|Fri|Satur|Sun)day, (?P<day>[0-9]{{2}})-{_MONTH}-(?P<year>[0-9]{{2}}) {_TIME} GMT"
    ),
    re.compile(rf"(?:{_DAY}) {_MONTH} (?P<day>[0-9 ][0-9]) {_TIME} (?P<year>[0-9]{{4}})"),
)


def http_date(seconds: int) -> str:
    """Return the one date format that may be generated (RFC 9110 5.6.7), whatever the locale."""
    at = dt.datetime.fromtimestamp(max(0, seconds), dt.UTC)
    return f"{_DAYS[at.weekday()]}, {at.day:02} {_MONTHS[at.month - 1]} {at.year:04} {at:%H:%M:%S} GMT"


def parse_http_date(value: str | None, *, now: float) -> int | None:
    """Read a date in any of the three formats of RFC 9110 5.6.7; None where it is none of them.

    A year of two digits that would lie more than 50 years after `now` is of the century before.
    """
    if value is None:
        return None
    for form in _FORMATS:
        if found := form.fullmatch(value.strip(" \t")):
            year = int(found["year"])
            if len(found["year"]) == 2:
                year = _full_year(year, dt.datetime.fromtimestamp(now, dt.UTC).year)
            try:
                moment = dt.datetime(
                    year, _MONTHS.index(found["month"]) + 1, int(found["day"]),
                    int(found["h"]), int(found["m"]), min(int(found["s"]), 59), tzinfo=dt.UTC,
                )  # fmt: skip
            except ValueError:
                return None
            leap = int(found["s"]) - moment.second
            return int(moment.timestamp()) + leap if leap <= 1 else None
    return None


def _full_year(two_digits: int, this_year: int) -> int:
    year = this_year // 100 * 100 + two_digits
    return year - 100 if year > this_year + 50 else year
