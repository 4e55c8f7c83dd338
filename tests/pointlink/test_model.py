"""The link model against what any link must keep, whatever is sent when and however seldom somebody looks."""

from __future__ import annotations

from collections import defaultdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointlink.model import SEGMENT, Link, Piece

RATE, DELAY, QUEUE = 1.25e6, 0.025, 8192
PER_BYTE = 8 / RATE

Offer = tuple[float, str, int]
offers = st.lists(
    st.tuples(st.floats(0, 0.5, allow_subnormal=False), st.sampled_from("abc"), st.integers(1, 30_000)),
    min_size=1,
    max_size=12,
).map(lambda items: sorted(items, key=lambda item: item[0]))
looks = st.lists(st.floats(0, 2), max_size=20)


def adsl(queue: int = QUEUE) -> Link[str]:
    return Link(rate=RATE, delay=DELAY, queue=queue)


def play(link: Link[str], sent: list[Offer], looked: list[float] | None = None) -> list[Piece[str]]:
    """Offer at the given times, look at some others, then let everything pass."""
    events = [(time, 1, flow, size) for time, flow, size in sent] + [(time, 0, "", 0) for time in looked or []]
    pieces = []
    for time, kind, flow, size in sorted(events, key=lambda event: event[:2]):
        pieces += link.offer(time, flow, size) if kind else link.advance(time)
    while link.next_room is not None:
        pieces += link.advance(link.next_room)
    return pieces


@given(offers)
def test_every_byte_arrives_once_in_order(sent: list[Offer]) -> None:
    link = adsl()
    pieces = play(link, sent)
    carried = defaultdict(int)
    for piece in pieces:
        assert 0 < piece.size <= SEGMENT
        carried[piece.flow] += piece.size
    expected = defaultdict(int)
    for _, flow, size in sent:
        expected[flow] += size
    assert carried == expected
    assert link.carried == sum(expected.values())
    arrivals = [piece.arrival for piece in pieces]
    assert arrivals == sorted(arrivals)


@given(offers)
def test_no_byte_arrives_before_it_could(sent: list[Offer]) -> None:
    got = defaultdict(int)
    for piece in play(adsl(), sent):
        got[piece.flow] += piece.size
        needed = offered = 0
        for time, flow, size in sent:
            if flow == piece.flow and offered < got[flow]:
                offered, needed = offered + size, time
        assert piece.arrival >= needed + DELAY + piece.size * PER_BYTE * (1 - 1e-9)


@given(offers)
def test_never_faster_than_the_rate_over_any_window(sent: list[Offer]) -> None:
    pieces = play(adsl(), sent)
    for first in range(len(pieces)):
        size = 0
        for last in range(first, min(len(pieces), first + 40)):
            size += pieces[last].size
            window = pieces[last].arrival - pieces[first].arrival
            assert size <= window / PER_BYTE + SEGMENT + 1e-6


@given(offers)
def test_never_idle_while_bytes_wait(sent: list[Offer]) -> None:
    # The slow oracle: a fluid server that works off everything that was sent, first come first served.
    finish = 0.0
    for time, _, size in sent:
        finish = max(finish, time) + size * PER_BYTE
    link = adsl()
    assert play(link, sent)[-1].arrival == pytest.approx(finish + DELAY, abs=1e-9)
    assert link.busy(0, 1e9) == pytest.approx(link.carried * PER_BYTE, abs=1e-9)


@given(offers, looks)
def test_looking_at_it_changes_nothing(sent: list[Offer], looked: list[float]) -> None:
    assert play(adsl(), sent) == play(adsl(), sent, looked)


@given(st.integers(1, 200_000), st.integers(1, 5), st.integers(1, 3 * SEGMENT))
def test_a_small_flow_waits_for_one_piece_of_each_other_and_the_queue(bulk: int, others: int, small: int) -> None:
    sent = [(0.0, f"bulk {i}", bulk) for i in range(others)] + [(0.01, "small", small)]
    last = max(piece.arrival for piece in play(adsl(), sent) if piece.flow == "small")
    turns = -(-small // SEGMENT)
    assert last <= 0.01 + DELAY + (QUEUE + SEGMENT + turns * (others + 1) * SEGMENT) * PER_BYTE


def test_equal_flows_share_equally() -> None:
    ends = {}
    for piece in play(adsl(), [(0.0, flow, 100_000) for flow in "abcd"]):
        ends[piece.flow] = piece.arrival
    # The first to come has filled the queue before the others came: each of them ends later by at most that.
    assert max(ends.values()) - min(ends.values()) <= 3 * (QUEUE + SEGMENT) * PER_BYTE
    del ends["a"]
    assert max(ends.values()) - min(ends.values()) <= 3 * SEGMENT * PER_BYTE


@given(offers, st.integers(1, 20_000))
def test_the_queue_is_bounded(sent: list[Offer], queue: int) -> None:
    link = adsl(queue)
    entered = []
    for time, flow, size in sent:
        entered += link.offer(time, flow, size)
        unfinished = sum(piece.size for piece in entered if piece.arrival - DELAY > time + 1e-12)
        assert unfinished <= max(queue, SEGMENT)


def test_hand_computed_arrivals() -> None:
    link: Link[str] = Link(rate=8000.0, delay=0.5, queue=10_000)  # a byte a millisecond
    assert link.offer(1.0, "a", 2000) == [
        Piece("a", 1448, pytest.approx(1 + 1.448 + 0.5)),
        Piece("a", 552, pytest.approx(1 + 2.0 + 0.5)),
    ]
    assert link.signal(1.0) == pytest.approx(3.5)
    assert link.signal(10.0) == 10.5
    link.offer(5.0, "b", 1000)
    assert link.windows == [(1.0, pytest.approx(3.0)), (5.0, pytest.approx(6.0))]
    assert link.busy(2.5, 5.5) == pytest.approx(1.0)


def test_what_has_not_entered_can_be_taken_back() -> None:
    link = adsl()
    entered = sum(piece.size for piece in link.offer(0.0, "a", 100_000))
    assert entered <= QUEUE
    assert link.withdraw("a") == 100_000 - entered
    assert link.next_room is None
    assert link.withdraw("a") == 0
    assert link.advance(100.0) == []


def test_a_link_without_limit_takes_only_its_delay() -> None:
    link: Link[str] = Link(rate=None, delay=0.01, queue=1)
    assert {piece.arrival for piece in link.offer(2.0, "a", 1_000_000)} == {2.01}


def test_a_fast_link_carries_larger_pieces() -> None:
    link: Link[str] = Link(rate=2e9, delay=0.0, queue=1_000_000)
    pieces = link.offer(0.0, "a", 250_000)
    assert len(pieces) == 10
    assert pieces[-1].arrival == pytest.approx(0.001)
