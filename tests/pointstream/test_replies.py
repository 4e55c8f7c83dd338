"""What each reply of a host means."""

from __future__ import annotations

import random
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lpc.errors import LpcError, ModelChanged, NotFound, RangesUnsupported, StoreError, Unavailable
from lpc.ranges import ByteRange
from pointstream.stores.patience import PatienceOptions, Tries, overdue
from pointstream.stores.replies import Beyond, Moved, Part, Pins, Retry, Whole, judge, retry_after, strong_tag

WANTED = ByteRange(1000, 3000)
PINNED = Pins(length=10_000, etag='"one"', ranged=True)


def verdict(status: int, pins: Pins = PINNED, wanted: ByteRange = WANTED, **headers: str) -> Any:
    fields = httpx.Headers({name.replace("_", "-"): value for name, value in headers.items()})
    return judge(status, fields, wanted, pins, "host.test")


@pytest.mark.parametrize(
    ("content_range", "start", "stop"),
    [
        ("bytes 1000-2999/10000", 1000, 3000),
        ("bytes 1000-2999/*", 1000, 3000),
        ("bytes 0-4095/10000", 0, 4096),  # a cache that aligns to blocks
        ("bytes 1000-1999/10000", 1000, 2000),  # less than asked
    ],
)
def test_a_206_that_holds_the_first_wanted_byte_is_taken(content_range: str, start: int, stop: int) -> None:
    part = verdict(206, content_range=content_range, content_length=str(stop - start), etag='"one"')
    assert part == Part(start=start, stop=stop, pins=PINNED)
    assert verdict(206, Pins(), content_range=content_range).pins.etag is None


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"content_range": "bytes 1000-2999"},
        {"content_range": "bytes */10000"},
        {"content_range": "bytes 2999-1000/10000"},
        {"content_range": "bytes 1001-3000/10000"},
        {"content_range": "bytes 0-999/10000"},
        {"content_range": "bytes 1000-2999/10000", "content_length": "1999"},
        {"content_range": "bytes 1000-2999/10000", "content_type": "multipart/byteranges; boundary=x"},
    ],
)
def test_any_other_206_is_asked_for_again(headers: dict[str, str]) -> None:
    with pytest.raises(Retry):
        verdict(206, **headers)


@pytest.mark.parametrize(
    ("status", "headers"),
    [
        (206, {"content_range": "bytes 1000-2999/10001"}),
        (206, {"content_range": "bytes 1000-2999/10000", "etag": '"two"'}),
        (412, {}),
        (416, {"content_range": "bytes */500"}),
    ],
)
def test_another_length_or_tag_is_another_build(status: int, headers: dict[str, str]) -> None:
    with pytest.raises(ModelChanged):
        verdict(status, **headers)


def test_weak_and_missing_tags_prove_nothing() -> None:
    for tag in ('W/"two"', "two", ""):
        assert verdict(206, content_range="bytes 1000-2999/10000", etag=tag).pins == PINNED
    assert strong_tag(httpx.Headers({"etag": 'W/"x"'})) is None


def test_a_200_is_taken_when_small_and_refused_when_large() -> None:
    fresh = Pins()
    assert verdict(200, fresh, content_length="9000", etag='"a"') == Whole(
        limit=65_536, length=9000, pins=Pins(length=9000, etag='"a"')
    )
    assert verdict(200, fresh, ByteRange(0, 65_536), content_length="262144").limit == 262_144
    assert verdict(200, fresh).length is None
    with pytest.raises(RangesUnsupported, match=r"ignores Range.*pointstream serve"):
        verdict(200, fresh, content_length="65537")
    with pytest.raises(Retry, match="200 in place of 206"):
        verdict(200, content_length="9000")


@pytest.mark.parametrize("coding", ["gzip", "br", "zstd, gzip"])
@pytest.mark.parametrize("status", [200, 206])
def test_coded_bodies_are_never_read(status: int, coding: str) -> None:
    with pytest.raises(StoreError, match="compress"):
        verdict(status, content_range="bytes 1000-2999/10000", content_encoding=coding)


@pytest.mark.parametrize(
    ("status", "error"),
    [(401, StoreError), (403, StoreError), (404, NotFound), (410, NotFound), (405, StoreError), (204, StoreError)],
)
def test_what_no_retry_cures(status: int, error: type[LpcError]) -> None:
    with pytest.raises(error):
        verdict(status)


@pytest.mark.parametrize("status", [408, 425, 429, 500, 502, 503, 504, 599])
def test_what_a_retry_may_cure(status: int) -> None:
    with pytest.raises(Retry) as caught:
        verdict(status, retry_after="7")
    assert caught.value.after == 7


def test_the_end_of_the_file() -> None:
    assert verdict(416, Pins(), content_range="bytes */900") == Beyond(900)
    assert verdict(416, Pins(length=900)) == Beyond(900)
    with pytest.raises(Retry):
        verdict(416, content_range="bytes */10000")
    with pytest.raises(StoreError):
        verdict(416, Pins())


def test_redirects() -> None:
    assert verdict(302, location="/other") == Moved("/other")
    with pytest.raises(StoreError):
        verdict(302)


@pytest.mark.parametrize(
    ("value", "seconds"),
    [
        ("0", 0.0),
        ("12", 12.0),
        ("99999999999999999999", 60.0),
        ("Sun, 06 Nov 1994 08:49:47 GMT", 10.0),
        ("Sun, 06 Nov 1994 07:00:00 GMT", 0.0),
        ("Sun, 06 Nov 2094 08:49:47 GMT", 60.0),
        ("soon", None),
        ("-3", None),
        ("", None),
    ],
)
def test_retry_after(value: str, seconds: float | None) -> None:
    headers = httpx.Headers({"retry-after": value, "date": "Sun, 06 Nov 1994 08:49:37 GMT"})
    assert retry_after(headers) == seconds


texts = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=40)


@given(
    st.integers(100, 599),
    st.dictionaries(
        st.sampled_from(["content-range", "content-length", "etag", "retry-after", "location", "content-type", "date"]),
        texts | st.from_regex(r"bytes \d{1,3}-\d{1,3}/(\d{1,20}|\*)", fullmatch=True) | st.from_regex(r'"\w*"'),
    ),
)
def test_any_reply_is_a_verdict_or_one_error(status: int, headers: dict[str, str]) -> None:
    wanted = ByteRange(10, 50)
    for pins in (Pins(), Pins(length=100, etag='"a"', ranged=True)):
        try:
            found = judge(status, headers, wanted, pins, "host")
        except (Retry, StoreError):
            continue
        if isinstance(found, Part):
            assert found.start <= wanted.start < found.stop
            assert pins.length in (None, found.pins.length)


def test_waits_grow_and_end() -> None:
    options = PatienceOptions()
    for seed in range(20):
        tries, waits = Tries(options, random.Random(seed), "file"), []
        with pytest.raises(Unavailable, match=r"4 tries \(last straw\)"):
            waits.extend(tries.wait(Retry("last straw")) for _ in range(10))
        assert len(waits) == 3
        assert all(0 <= wait <= 0.2 * 2 ** (n + 1) for n, wait in enumerate(waits))
    tries = Tries(options, random.Random(0), "file")
    assert tries.wait(Retry("died idle", stale=True)) == 0
    assert tries.wait(Retry("busy", after=30.0)) == 30.0


@given(st.integers(0, 10**7), st.floats(100, 1e8))
def test_the_deadline_moves_only_forward(received: int, rate: float) -> None:
    options = PatienceOptions()
    assert overdue(1.0, 0, rate, options) == 6.0
    assert overdue(1.0, received + 1, rate, options) > overdue(1.0, received, rate, options)
