"""The pure verdict, case by case of RFC 9110 sections 13 and 14, and against a slow obvious oracle."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointserve.preconditions import http_date, parse_http_date, parse_tags
from pointserve.ranges import MAX_OVERHEAD, MAX_PARTS, FileFacts, Verdict, judge, parse_ranges

NOW = 1_800_000_000.0
OLD = 1_600_000_000
THOUSAND = FileFacts(length=1000, etag='"a"', modified=OLD)
EMPTY = FileFacts(length=0, etag='"e"', modified=OLD)
ONE = FileFacts(length=1, etag='"o"', modified=OLD)
HUGE = FileFacts(length=5 << 30, etag='"h"', modified=OLD)


def ask(facts: FileFacts = THOUSAND, method: str = "GET", **fields: str) -> Verdict:
    request = {name.replace("_", "-"): value for name, value in fields.items()}
    return judge(method, request.get, facts, now=NOW)


def content_range(verdict: Verdict) -> str | None:
    return dict(verdict.headers).get("Content-Range")


@pytest.mark.parametrize(
    ("value", "first", "last"),
    [
        ("bytes=0-0", 0, 0),
        ("bytes=0-499", 0, 499),
        ("bytes=500-999", 500, 999),
        ("bytes=999-999", 999, 999),
        ("bytes=900-", 900, 999),
        ("bytes=0-", 0, 999),
        ("bytes=-1", 999, 999),
        ("bytes=-1000", 0, 999),
        ("bytes=-5000", 0, 999),
        ("bytes=990-1000", 990, 999),
        ("bytes=990-99999999999999999999999999999999999999999", 990, 999),
        ("bytes=0-9223372036854775808", 0, 999),
        ("bytes=-18446744073709551616", 0, 999),
        ("bytes=00000000000000000000000000000000000000005-0009", 5, 9),
        ("BYTES=1-2", 1, 2),
        ("Bytes=1-2", 1, 2),
        ("bytes=1-2,", 1, 2),
        ("bytes=,,1-2", 1, 2),
        ("bytes= 1-2", 1, 2),
        ("bytes=\t1-2 ,", 1, 2),
        ("bytes=0-9,10-19", 0, 19),
        ("bytes=10-19,0-9", 0, 19),
        ("bytes=0-9,5-19", 0, 19),
        ("bytes=0-,0-,0-,-1", 0, 999),
        ("bytes=5-6,2000-3000", 5, 6),
        ("bytes=5-6,-0", 5, 6),
        ("bytes=" + ",".join(f"{n}-{n}" for n in range(1000)), 0, 999),
        ("bytes=-" + "9" * 8000, 0, 999),
    ],
)
def test_one_range(value: str, first: int, last: int) -> None:
    verdict = ask(Range=value)
    assert verdict.status == 206
    assert content_range(verdict) == f"bytes {first}-{last}/1000"
    assert verdict.length == last - first + 1
    assert [(part.start, part.stop, part.head) for part in verdict.parts] == [(first, last + 1, b"")]
    assert verdict.tail == b""


@pytest.mark.parametrize(
    "value",
    [
        "bytes=1000-", "bytes=1000-1000", "bytes=1000-2000", "bytes=-0", "bytes=-000", "bytes=9223372036854775807-",
        "bytes=9223372036854775808-", "bytes=99999999999999999999999999-999999999999999999999999999",
        "bytes=2000-,-0", f"bytes={'9' * 8000}-",
        "bytes=" + ",".join(f"{2 * n}-{2 * n}" for n in range(MAX_PARTS + 1)),
    ],
)  # fmt: skip
def test_unsatisfiable(value: str) -> None:
    verdict = ask(Range=value)
    assert verdict.status == 416
    assert content_range(verdict) == "bytes */1000"
    assert verdict.length is None
    assert verdict.parts == ()


@pytest.mark.parametrize(
    "value",
    [
        "", "bytes", "bytes=", "bytes=,", "bytes=-", "bytes=--1", "bytes=5-3", "bytes=5-3,7-9",
        "bytes=7-9,5-3", "bytes=a-b",
        "bytes=1-2x", "bytes=1", "bytes=+1-2", "bytes=-+1", "bytes=1 - 2", "bytes=0x1-0x2",
        "bytes=1.0-2", "bytes =1-2", "bytes: 1-2",
        "bytes=1-2-3", "bytes=1-2;3-4", "bytes=١-٢", "items=0-5", "seconds=1-2", "bytes=1-2 3-4", "none", "x=bytes=1-2",
    ],
)  # fmt: skip
def test_ignored(value: str) -> None:
    verdict = ask(Range=value)
    assert (verdict.status, verdict.length, content_range(verdict)) == (200, 1000, None)


def test_ranges_beyond_four_gigabytes() -> None:
    for first, last in ((2**31 - 1, 2**31), (2**32 - 1, 2**32), (5 * 2**30 - 4, 5 * 2**30 - 1)):
        verdict = ask(HUGE, Range=f"bytes={first}-{last}")
        assert content_range(verdict) == f"bytes {first}-{last}/{5 << 30}"
    assert content_range(ask(HUGE, Range="bytes=-4")) == f"bytes {5 * 2**30 - 4}-{5 * 2**30 - 1}/{5 << 30}"


def test_empty_and_one_byte_files() -> None:
    assert ask(EMPTY).status == 200
    assert ask(EMPTY, Range="bytes=0-").status == 416
    assert ask(EMPTY, Range="bytes=0-0").status == 416
    assert ask(EMPTY, Range="bytes=-0").status == 416
    assert (ask(EMPTY, Range="bytes=-5").status, ask(EMPTY, Range="bytes=-5").length) == (200, 0)
    assert content_range(ask(ONE, Range="bytes=0-0")) == "bytes 0-0/1"
    assert content_range(ask(ONE, Range="bytes=-1")) == "bytes 0-0/1"
    assert content_range(ask(ONE, Range="bytes=1-")) == "bytes */1"


def test_head_answers_for_the_whole() -> None:
    verdict = ask(method="HEAD", Range="bytes=0-9", If_Range='"a"')
    assert (verdict.status, verdict.length, verdict.parts, content_range(verdict)) == (200, 1000, (), None)


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "get", "TRACE"])
def test_other_methods_have_no_ranges(method: str) -> None:
    verdict = ask(method=method, Range="bytes=0-9")
    assert verdict.status == 405
    assert dict(verdict.headers)["Allow"] == "GET, HEAD, OPTIONS"


def test_every_reply_with_the_file_names_its_build() -> None:
    for verdict in (ask(), ask(Range="bytes=0-1"), ask(If_None_Match="*"), ask(Range="bytes=0-1,5-6")):
        headers = dict(verdict.headers)
        assert headers["ETag"] == '"a"'
        assert headers["Last-Modified"] == "Sun, 13 Sep 2020 12:26:40 GMT"
        assert headers["Accept-Ranges"] == "bytes"


DATE, EARLIER, LATER = http_date(OLD), http_date(OLD - 1), http_date(OLD + 1)


@pytest.mark.parametrize(
    ("value", "status"),
    [
        ('"a"', 206), ('"b"', 200), ('W/"a"', 200), ('"a", "b"', 200), ("a", 200), ("", 200), ("*", 200), ('"A"', 200),
        (DATE, 206), (EARLIER, 200), (LATER, 200), ("Sunday, 13-Sep-20 12:26:40 GMT", 206),
        ("Sun Sep 13 12:26:40 2020", 206),
        ("2020-09-13T12:26:40Z", 200), ("Sun, 13 Sep 2020 12:26:40", 200),
    ],
)  # fmt: skip
def test_if_range(value: str, status: int) -> None:
    assert ask(Range="bytes=0-9", If_Range=value).status == status
    assert ask(Range="bytes=2000-", If_Range=value).status == (416 if status == 206 else 200)
    assert ask(If_Range=value).status == 200


def test_if_range_date_is_weak_within_a_second_of_the_change() -> None:
    fresh = FileFacts(length=1000, etag='"a"', modified=int(NOW))
    request = {"Range": "bytes=0-9", "If-Range": http_date(int(NOW))}
    assert judge("GET", request.get, fresh, now=NOW + 0.9).status == 200
    assert judge("GET", request.get, fresh, now=NOW + 1.0).status == 206


@pytest.mark.parametrize(
    ("fields", "status"),
    [
        ({"If-Match": '"a"'}, 200),
        ({"If-Match": '"b", "a"'}, 200),
        ({"If-Match": '"b,c",,"a"'}, 200),
        ({"If-Match": "*"}, 200),
        ({"If-Match": '"b"'}, 412),
        ({"If-Match": 'W/"a"'}, 412),
        ({"If-Match": "a"}, 412),
        ({"If-Match": ""}, 412),
        ({"If-None-Match": '"a"'}, 304),
        ({"If-None-Match": 'W/"a"'}, 304),
        ({"If-None-Match": '"x", W/"a"'}, 304),
        ({"If-None-Match": "*"}, 304),
        ({"If-None-Match": '"b"'}, 200),
        ({"If-None-Match": "a"}, 200),
        ({"If-Modified-Since": DATE}, 304),
        ({"If-Modified-Since": LATER}, 304),
        ({"If-Modified-Since": EARLIER}, 200),
        ({"If-Modified-Since": "yesterday"}, 200),
        ({"If-Modified-Since": f"{DATE}, {DATE}"}, 200),
        ({"If-Unmodified-Since": DATE}, 200),
        ({"If-Unmodified-Since": LATER}, 200),
        ({"If-Unmodified-Since": EARLIER}, 412),
        ({"If-Unmodified-Since": "yesterday"}, 200),
        # 13.2.2: tags before dates, If-Match before If-None-Match, all before Range
        ({"If-Match": '"a"', "If-Unmodified-Since": EARLIER}, 200),
        ({"If-Match": '"b"', "If-None-Match": '"a"'}, 412),
        ({"If-Match": '"a"', "If-None-Match": '"a"'}, 304),
        ({"If-None-Match": '"b"', "If-Modified-Since": LATER}, 200),
        ({"If-None-Match": '"a"', "If-Modified-Since": EARLIER}, 304),
        ({"If-Unmodified-Since": EARLIER, "If-None-Match": '"a"'}, 412),
        ({"If-Match": '"b"', "Range": "bytes=0-1"}, 412),
        ({"If-Match": '"a"', "Range": "bytes=0-1"}, 206),
        ({"If-Match": '"b"', "Range": "bytes=2000-"}, 412),
        ({"If-None-Match": '"a"', "Range": "bytes=0-1"}, 304),
        ({"If-None-Match": '"b"', "Range": "bytes=2000-"}, 416),
        ({"If-Match": '"a"', "Range": "bytes=0-1", "If-Range": '"b"'}, 200),
        ({"If-Unmodified-Since": LATER, "Range": "bytes=0-1", "If-Range": DATE}, 206),
    ],
)
def test_preconditions(fields: dict[str, str], status: int) -> None:
    assert judge("GET", fields.get, THOUSAND, now=NOW).status == status
    head = judge("HEAD", fields.get, THOUSAND, now=NOW).status
    assert head == (200 if status in (206, 416) else status)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("Sun, 06 Nov 1994 08:49:37 GMT", 784111777),
        ("Sunday, 06-Nov-94 08:49:37 GMT", 784111777),
        ("Sun Nov  6 08:49:37 1994", 784111777),
        ("Thu, 01 Jan 1970 00:00:00 GMT", 0),
        ("Sat, 31 Dec 2016 23:59:60 GMT", 1483228800),
        ("Friday, 31-Dec-76 23:59:59 GMT", 3376684799),
        ("Friday, 31-Dec-99 23:59:59 GMT", 946684799),
        ("Sun, 31 Feb 1994 08:49:37 GMT", None),
        ("Sun, 06 Nov 1994 24:49:37 GMT", None),
        ("Sun, 06 Nov 1994 08:49:61 GMT", None),
        ("Sun, 06 Nov 1994 08:49:37 CET", None),
        ("Sun, 6 Nov 1994 08:49:37 GMT", None),
        ("sun, 06 nov 1994 08:49:37 gmt", None),
        ("784111777", None),
    ],
)
def test_dates(text: str, seconds: int | None) -> None:
    assert parse_http_date(text, now=NOW) == seconds  # NOW is in 2027: '76 is ahead of it, '99 behind


@given(st.integers(0, 253402300799))
def test_dates_come_back(seconds: int) -> None:
    assert parse_http_date(http_date(seconds), now=NOW) == seconds


@given(st.lists(st.text(st.characters(min_codepoint=0x21, max_codepoint=0x7E, exclude_characters='"')), min_size=1))
def test_tags_come_back(texts: list[str]) -> None:
    tags = [f'{"W/" * (number % 2)}"{text}"' for number, text in enumerate(texts)]
    parsed = parse_tags(" , ".join(tags))
    assert parsed is not None
    assert [f"{'W/' * tag.weak}{tag.opaque}" for tag in parsed] == tags


numbers = st.integers(0, 40).map(str)
spec = st.one_of(
    st.tuples(numbers, numbers).map("-".join), numbers.map("{}-".format), numbers.map("-{}".format), st.just("")
)


def oracle(specs: list[str], length: int) -> set[int] | None:
    """Positions that a list of specs names, one by one; None if it is invalid."""
    chosen: set[int] = set()
    if not any(specs):
        return None
    for text in filter(None, specs):
        first, last = text.split("-")
        if not first:
            chosen |= set(range(length)[max(0, length - int(last)) :])
        elif last and int(last) < int(first):
            return None
        else:
            chosen |= {place for place in range(length) if int(first) <= place <= (int(last) if last else length)}
    return chosen


@given(st.lists(spec, max_size=20), st.integers(1, 30))
def test_ranges_name_exactly_the_positions_asked_for(specs: list[str], length: int) -> None:
    ranges = parse_ranges("bytes=" + ",".join(specs), length)
    wanted = oracle(specs, length)
    if wanted is None:
        assert ranges is None
        return
    assert ranges is not None
    named = [place for start, stop in ranges for place in range(start, stop)]
    assert len(named) == len(set(named))
    assert set(named) == wanted
    assert all((stop not in wanted and start - 1 not in wanted) for start, stop in ranges), "neighbours are merged"


@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 50)), min_size=2, max_size=40), st.integers(1, 5000))
def test_multipart_is_bounded_and_its_parts_are_in_order_of_mention(pairs: list[tuple[int, int]], length: int) -> None:
    facts = FileFacts(length=length, etag='"a"', modified=OLD)
    verdict = ask(facts, Range="bytes=" + ",".join(f"{start}-{start + more}" for start, more in pairs))
    ranges = parse_ranges("bytes=" + ",".join(f"{start}-{start + more}" for start, more in pairs), length)
    assert ranges is not None
    if verdict.status == 416:
        assert not ranges or len(ranges) > MAX_PARTS or length < 4096
        return
    assert verdict.status == 206
    assert verdict.length == sum(len(part.head) + part.stop - part.start for part in verdict.parts) + len(verdict.tail)
    assert verdict.length <= length + MAX_OVERHEAD
    assert len(verdict.parts) <= MAX_PARTS
    assert [(part.start, part.stop) for part in verdict.parts] == ranges
    if len(ranges) > 1:
        assert content_range(verdict) is None
        boundary = dict(verdict.headers)["Content-Type"].removeprefix("multipart/byteranges; boundary=")
        for number, part in enumerate(verdict.parts):
            head = part.head.decode()
            start = f"--{boundary}\r\n" if number == 0 else f"\r\n--{boundary}\r\n"
            assert head.startswith(start)
            assert f"\r\nContent-Range: bytes {part.start}-{part.stop - 1}/{length}\r\n" in head
            assert head.endswith("\r\n\r\n")
        assert verdict.tail.decode() == f"\r\n--{boundary}--\r\n"
    mentions = [
        next(n for n, (s, more) in enumerate(pairs) if s < stop and s + more >= start) for start, stop in ranges
    ]
    assert mentions == sorted(mentions)


@given(st.text(max_size=60))
def test_no_text_breaks_the_evaluator(text: str) -> None:
    for name in ("Range", "If-Range", "If-Match", "If-None-Match", "If-Modified-Since", "If-Unmodified-Since"):
        fields = {"Range": "bytes=0-1", name: text}
        assert judge("GET", fields.get, THOUSAND, now=NOW).status in (200, 206, 304, 412, 416)
    parse_ranges("bytes=" + re.sub(r"[^0-9,-]", "", text), 7)
