from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import byte_ranges

from lpc.errors import FormatError
from lpc.ranges import ByteRange, coalesce, parse_content_range


def test_a_range_is_half_open_and_the_header_is_not() -> None:
    wanted = ByteRange(100, 200)
    assert wanted.size == 100
    assert wanted.header == "bytes=100-199"
    assert ByteRange(100, 101) in wanted
    assert ByteRange(99, 101) not in wanted
    assert bytes(ByteRange(2, 5).within(b"abc", ByteRange(3, 5))) == b"bc"


@pytest.mark.parametrize(("start", "stop"), [(0, 0), (5, 4), (-1, 3)])
def test_a_range_is_never_empty(start: int, stop: int) -> None:
    with pytest.raises(ValueError, match="empty"):
        ByteRange(start, stop)


@pytest.mark.parametrize("part", [ByteRange(1, 3), ByteRange(4, 6)])
def test_only_a_part_is_cut_out(part: ByteRange) -> None:
    with pytest.raises(ValueError, match="not in"):
        ByteRange(2, 5).within(b"abc", part)


def test_neighbours_become_one_request_and_the_urgent_one_goes_first() -> None:
    ranges = [ByteRange(500, 600), ByteRange(0, 10), ByteRange(610, 700), ByteRange(12, 20), ByteRange(2000, 2001)]
    assert coalesce(ranges, max_gap=10, max_bytes=1000) == [
        (ByteRange(500, 700), [0, 2]),
        (ByteRange(0, 20), [1, 3]),
        (ByteRange(2000, 2001), [4]),
    ]


def test_gap_and_length_are_limits_that_may_be_reached() -> None:
    near, far = ByteRange(0, 10), ByteRange(14, 20)
    assert coalesce([near, far], max_gap=4, max_bytes=20) == [(ByteRange(0, 20), [0, 1])]
    assert len(coalesce([near, far], max_gap=3, max_bytes=20)) == 2
    assert len(coalesce([near, far], max_gap=4, max_bytes=19)) == 2
    assert coalesce([ByteRange(0, 50)], max_gap=0, max_bytes=10) == [(ByteRange(0, 50), [0])]
    assert coalesce([], max_gap=0, max_bytes=10) == []


@given(st.lists(byte_ranges(), max_size=30), st.integers(0, 60), st.integers(1, 400))
def test_a_plan_brings_everything_once_within_its_limits(ranges: list[ByteRange], max_gap: int, max_bytes: int) -> None:
    plan = coalesce(ranges, max_gap=max_gap, max_bytes=max_bytes)
    assert sorted(index for _, members in plan for index in members) == list(range(len(ranges)))
    assert [min(members) for _, members in plan] == sorted(min(members) for _, members in plan)
    for merged, members in plan:
        places = [ranges[index] for index in members]
        assert places == sorted(places)
        assert merged == ByteRange(min(p.start for p in places), max(p.stop for p in places))
        assert len(members) == 1 or merged.size <= max_bytes
        wanted = {byte for place in places for byte in range(place.start, place.stop)}
        unwanted, run = set(range(merged.start, merged.stop)) - wanted, 0
        for byte in range(merged.start, merged.stop):
            run = run + 1 if byte in unwanted else 0
            assert run <= max_gap
    tight = sorted(plan, key=lambda request: request[0])
    for (left, _), (_, members) in itertools.pairwise(tight):  # nothing mergeable is left apart
        first = ranges[members[0]]
        assert first.start - left.stop > max_gap or max(left.stop, first.stop) - left.start > max_bytes


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("bytes 0-99/200", (0, 100, 200)),
        ("bytes 5-5/6", (5, 6, 6)),
        ("Bytes 0-0/*", (0, 1, None)),
        (" bytes 0-1/2\t", (0, 2, 2)),
    ],
)
def test_content_range_is_read(text: str, expected: tuple[int, int, int | None]) -> None:
    assert parse_content_range(text) == expected


@pytest.mark.parametrize(
    "text",
    ["", "bytes */200", "bytes 5-4/9", "bytes 0-9/9", "bytes 0-9", "items 0-9/10", "bytes 0-9/10, 3", "bytes -1-9/10",
     "bytes 0x1-9/10", "bytes 0-9/1_0", "bytes ٠-٩/10", "bytes 0 - 9/10", "bytes 0-9/" + "9" * 400],
)  # fmt: skip
def test_a_content_range_that_is_not_one_is_refused(text: str) -> None:
    with pytest.raises(FormatError):
        parse_content_range(text)


@given(st.text(max_size=40))
def test_any_text_gives_a_range_or_a_format_error(text: str) -> None:
    try:
        start, stop, total = parse_content_range(text)
    except FormatError:
        return
    assert 0 <= start < stop <= (total or stop)
