"""What is fetched before anybody wants it: never at a want's cost, counted to the byte."""

from __future__ import annotations

import asyncio
import random
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.fifo import Fifo
from support.frames import FRAME
from support.layers import over_line

from lpc.header import parse_header
from pointlink.faults import Flip
from pointstream.foresight import Foresight
from pointstream.goodput import Goodput
from pointstream.scheduler import LinkState, Scheduler, SchedulerOptions

if TYPE_CHECKING:
    from pointlink.origin import Origin
    from pointstream.layer import AccessLayer
    from pointstream.offers import Request

ADSL = LinkState(156_250.0, 0.05, measured=True)
Table = list[tuple[int, int, int]]

WANTED, LATER = range(40), range(100, 140)


def columns(items: Table) -> tuple[Any, Any, Any]:
    table = np.array(items, dtype=np.int64).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2]


def places(keys: Any) -> Table:
    return [(key, key * 7000, key * 7000 + 1000 + 90 * (key % 50)) for key in keys]


def spans(requests: list[Request]) -> list[tuple[int, int]]:
    return [(request.range.start, request.range.stop) for request in requests]


events = st.lists(
    st.one_of(
        st.tuples(st.just("frame"), st.lists(st.sampled_from(WANTED), unique=True, max_size=12)),
        st.tuples(st.just("later"), st.lists(st.sampled_from(LATER), unique=True, max_size=12)),
        st.tuples(st.just("look"), st.floats(0, 1)),
        st.tuples(st.just("lands"), st.tuples(st.integers(0, 9), st.floats(0, 1))),
        st.tuples(st.just("later lands"), st.tuples(st.integers(0, 9), st.floats(0, 1))),
        st.tuples(st.just("link"), st.tuples(st.floats(1e4, 1e7), st.floats(0, 0.5), st.booleans())),
    ),
    max_size=50,
)


@given(events)
@settings(deadline=None)
def test_which_wants_are_asked_for_and_when_does_not_depend_on_it(events: list[tuple[str, Any]]) -> None:
    """Two schedulers see the same, but for what is offered ahead and what becomes of it."""
    options = SchedulerOptions(most_requests=3, most_ahead=2)
    plain, both = Scheduler(options), Scheduler(options)
    flying: tuple[list[Request], list[Request]] = ([], [])
    later: list[Request] = []
    now, link = 0.0, ADSL
    for kind, what in events:
        if kind == "frame":
            for scheduler in (plain, both):
                scheduler.offer(*columns(places(what)))
        elif kind == "later":
            both.offer_ahead(*columns(places(what)))
        elif kind == "link":
            link = LinkState(*what)
        elif kind == "look":
            now += what
            idle = not both.outstanding
            new = both.issue(now, link)
            flying[1].extend(request for request in new if not request.ahead)
            flying[0].extend(plain.issue(now, link))
            ahead = [request for request in new if request.ahead]
            if ahead:
                assert both.waiting == 0, "something wanted had to wait"
                before_last = both.outstanding - ahead[-1].range.size
                assert (idle and len(new) == 1) or before_last == 0 or before_last < link.rate * link.rtt
            for request in ahead:
                assert request.range.size <= link.rate * options.ahead_seconds or len(request.items) == 1
                assert request.range.size <= link.rate * options.ahead_patience
            later += ahead
            assert len(later) <= options.most_ahead
        elif kind == "lands" and flying[0]:
            for scheduler, requests in zip((plain, both), flying, strict=True):
                land(scheduler, requests, *what)
        elif kind == "later lands" and later:
            land(both, later, *what)
        assert spans(flying[0]) == spans(flying[1])
        keys = [item.key for request in (*flying[1], *later) for item in request.items]
        assert len(keys) == len(set(keys))


def land(scheduler: Scheduler, requests: list[Request], which: int, part: float) -> None:
    request = requests[which % len(requests)]
    scheduler.landed(request, int(part * request.outstanding) if part < 0.5 else request.outstanding)
    if request.outstanding == 0:
        scheduler.ended(requests.pop(requests.index(request)))


def test_what_becomes_wanted_is_not_asked_for_twice() -> None:
    scheduler = Scheduler()
    scheduler.offer_ahead(*columns(places([100, 120])))
    assert [request.items[0].key for request in scheduler.issue(0.0, ADSL)] == [100, 120]
    scheduler.offer(*columns(places([100, 121])))
    assert [(r.items[0].key, r.ahead) for r in scheduler.issue(0.1, ADSL)] == [(121, False)]
    scheduler = Scheduler()
    scheduler.offer_ahead(*columns(places([100])))
    scheduler.offer(*columns(places([100])))
    assert [(r.items[0].key, r.ahead) for r in scheduler.issue(0.0, ADSL)] == [(100, False)]


def test_nothing_goes_ahead_without_a_link_or_room() -> None:
    scheduler = Scheduler()
    scheduler.offer_ahead(*columns(places([100])))
    assert scheduler.issue(0.0, None) == []
    assert scheduler.issue(0.0, ADSL, ahead=False) == []
    assert len(scheduler.issue(0.0, ADSL)) == 1


class Line:
    """A scheduler on a simulated line: clouds that nobody wants for ever, and one that is wanted all at once."""

    def __init__(self, when: float, *, ahead: bool) -> None:
        self.link, self.meter, self.scheduler = Fifo(ADSL.rate, 0.05, header=375), Goodput(), Scheduler()
        self.here: dict[int, float] = {}
        self.ahead, self.wants = ahead, [(-1, 9_000_000, 9_005_000)]
        draw, place = random.Random(4), 70_000
        self.later: Table = []
        for key in range(2000):
            self.later.append((key, place, place + draw.randint(3500, 6500)))
            place = self.later[-1][2] + draw.choice([0, 3000])
        self.bulk = self.later[1000:1080]
        self.when = when
        self.link.at(0.0, self.look)
        self.link.at(when, self.look)

    def look(self) -> None:
        now = self.link.now
        wants = self.bulk if now < 1.0 else self.wants if now >= self.when else []  # some bulk first: it is measured
        self.scheduler.offer(*columns([want for want in wants if want[0] not in self.here]))
        if self.ahead:
            self.scheduler.offer_ahead(*columns([item for item in self.later[:1000] if item[0] not in self.here]))
        self.issue()
        self.link.at(now + FRAME, self.look)

    def issue(self) -> None:
        now = self.link.now
        for request in self.scheduler.issue(now, LinkState(self.meter.admission(now), self.meter.rtt, True)):
            self.ask(request)

    def ask(self, request: Request) -> None:
        transfer = self.meter.begin(self.link.now, request.range.size)

        def piece(nbytes: int, last: bool) -> None:
            self.meter.received(transfer, self.link.now, nbytes)
            self.scheduler.landed(request, nbytes)
            if last:
                self.here.update(dict.fromkeys((item.key for item in request.items), self.link.now))
                self.meter.end(transfer, self.link.now)
                self.scheduler.ended(request)
                self.issue()

        self.link.request(request.range.size, piece)


@pytest.mark.parametrize("when", [4.0, 4.007, 4.013, 4.02, 4.027, 5.5, 6.1])
def test_a_want_is_delayed_by_one_short_request_at_most(when: float) -> None:
    plain, both = Line(when, ahead=False), Line(when, ahead=True)
    for line in (plain, both):
        line.link.run(when + 1.0)
    carried = sum(line[2] - line[1] for line in both.later if line[0] in both.here)
    assert carried > 0.9 * ADSL.rate * (when - 1.0), "the line was not busy"
    delay = both.here[-1] - plain.here[-1]
    longest = max(SchedulerOptions().ahead_seconds, 6500 / ADSL.rate) + 375 / ADSL.rate
    assert -1e-9 <= delay <= longest
    assert both.meter.rate(when) == pytest.approx(ADSL.rate, rel=0.05)


came = st.tuples(st.integers(0, 30), st.integers(1, 9))
counted = st.lists(
    st.one_of(
        st.tuples(st.just("cloud"), came),
        st.tuples(st.just("page"), came),
        st.tuples(st.just("draw"), st.sets(st.integers(0, 30))),
        st.tuples(st.just("drop"), st.sets(st.integers(0, 30))),
        st.tuples(st.just("gap"), st.integers(0, 5)),
    ),
    max_size=40,
)


@given(counted)
def test_waste_is_what_no_frame_drew(events: list[tuple[str, Any]]) -> None:
    """Against a list of what came, each with whether it was drawn before it went."""
    foresight, came = Foresight(), list[dict[str, Any]]()
    foresight.begin(31, 4)
    for kind, what in events:
        if kind in ("cloud", "page"):
            key, size = what
            if any(entry["key"] == (kind, key) and entry["here"] for entry in came):
                continue  # nothing comes twice while it is here
            foresight.landed(size)
            foresight.came(key if kind == "cloud" else ~key, size)
            came.append({"key": (kind, key), "size": size, "here": True, "drawn": False})
        elif kind == "draw":
            foresight.drew(np.array(sorted(what), dtype=np.int64))
            for entry in came:
                drawn = what if entry["key"][0] == "cloud" else {node // 4 for node in what}
                entry["drawn"] |= entry["here"] and entry["key"][1] in drawn
        elif kind == "drop":
            foresight.dropped(sorted(what))
            for entry in came:
                entry["here"] &= not (entry["key"][0] == "cloud" and entry["key"][1] in what)
        else:
            foresight.landed(what)
            came.append({"key": ("gap", 0), "size": what, "here": False, "drawn": False})
    assert foresight.received == sum(entry["size"] for entry in came)
    assert foresight.wasted == sum(entry["size"] for entry in came if not entry["drawn"])


def test_bytes_ahead_are_those_that_the_host_sent_for_them(large_model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        await layer.idle()
        opened = layer.stats
        assert opened.speculative_bytes == opened.wasted_bytes == 0
        first = int(np.flatnonzero(~layer.resident)[0])
        nodes = np.arange(first, first + 20, 2)  # gaps between them
        while not layer.resident[nodes].all():
            layer.end_frame([], pinned=[0])
            assert layer.spare
            layer.prefetch(nodes)
            await asyncio.sleep(FRAME)
        await layer.idle()
        stats = layer.stats
        sent = [exchange.stop - exchange.start for exchange in origin.log[1:]]
        assert stats.speculative_bytes == stats.wasted_bytes == sum(sent)
        assert stats.idle_bytes - opened.idle_bytes == sum(sent)
        assert stats.speculative_bytes == stats.bytes_received - opened.bytes_received
        assert stats.wanted_seconds == opened.wanted_seconds
        drawn = nodes[3::3]  # not the first, of which the opening brought a part
        layer.end_frame([], pinned=drawn)
        layer.end_frame([], pinned=drawn)
        used = sum(layer.index.size[drawn].tolist())
        assert layer.stats.wasted_bytes == stats.speculative_bytes - used

    over_line(large_model, check)


@pytest.mark.parametrize("seed", range(3))
def test_a_run_of_random_frames_is_counted_to_the_byte(
    large_model: bytes, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against the requests themselves, and a set of what was ever drawn."""
    asked: list[Request] = []
    issue = Scheduler.issue

    def spy(self: Scheduler, *args: Any, **named: Any) -> list[Request]:
        requests = issue(self, *args, **named)
        asked.extend(request for request in requests if request.ahead)
        return requests

    monkeypatch.setattr(Scheduler, "issue", spy)
    draw = np.random.default_rng(seed)

    async def check(layer: AccessLayer, origin: Origin) -> None:
        drawn: set[int] = set()
        for _ in range(90):
            pinned = draw.permutation(np.flatnonzero(layer.resident))[: draw.integers(0, 8)]
            wants = draw.permutation(len(layer.index))[: draw.integers(0, 3) * draw.integers(0, 2)]
            layer.end_frame(wants[~layer.resident[wants]], pinned=pinned)
            layer.prefetch(draw.permutation(len(layer.index))[: draw.integers(0, 10)])
            drawn |= set(pinned.tolist())
            await asyncio.sleep(FRAME)
        await layer.idle()
        came = used = 0
        sent = {exchange.stop: exchange.start for exchange in origin.log}
        for request in asked:
            start = sent[request.range.stop]  # later than asked for where the opening had brought the beginning
            came += request.range.stop - start
            for item in request.items:
                nodes = {item.key} if item.key >= 0 else set(range(~item.key * 64, (~item.key + 1) * 64))
                used += (item.stop - max(item.start, start)) * bool(nodes & drawn)
        stats = layer.stats
        assert stats.speculative_bytes == came > 50_000
        assert stats.wasted_bytes == stats.speculative_bytes - used > 0
        assert 0 < stats.idle_bytes < stats.bytes_received

    over_line(large_model, check)


def test_a_want_under_way_is_waited_for_and_its_bytes_are_used(large_model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        await layer.idle()
        layer.end_frame([], pinned=[0])
        node = int(np.flatnonzero(~layer.resident)[7])
        idle = layer.stats.idle_bytes
        layer.prefetch([node])
        await asyncio.sleep(0.03)
        assert not layer.resident[node]
        layer.end_frame([node], pinned=[0])
        assert layer.wanting
        await layer.idle()
        assert layer.resident[node]
        assert len(origin.log) == 2
        layer.end_frame([], pinned=[node])
        assert layer.stats.speculative_bytes == layer.index.size[node]
        assert layer.stats.wasted_bytes == 0
        assert layer.stats.idle_bytes - idle < layer.index.size[node]

    over_line(large_model, check)


def test_an_empty_call_withdraws_what_was_said(large_model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        await layer.idle()
        layer.end_frame([], pinned=[0])
        layer.prefetch(np.flatnonzero(~layer.resident))
        layer.prefetch([])
        await layer.idle()
        before = len(origin.log)
        assert before <= 4  # the opening, and a round trip of bytes
        for _ in range(10):
            layer.end_frame([], pinned=[0])
            await asyncio.sleep(FRAME)
        assert len(origin.log) == before

    over_line(large_model, check)


def test_memory_that_is_full_takes_nothing_ahead(large_model: bytes) -> None:
    header = parse_header(large_model)

    async def check(layer: AccessLayer, origin: Origin) -> None:
        await layer.idle()
        here = np.flatnonzero(layer.resident)
        for _ in range(200):
            layer.end_frame([], pinned=here[:2])
            layer.prefetch(np.flatnonzero(~layer.resident))
            await asyncio.sleep(FRAME)
        await layer.idle()
        stats = layer.stats
        assert layer.resident[here].all()
        assert 0 < stats.speculative_bytes < 0.8 * header.bytes
        assert stats.evicted == stats.over_bytes == 0
        # What is wanted takes the room of what came ahead, not of what was drawn.
        layer.end_frame(np.flatnonzero(~layer.resident)[:20], pinned=here)
        await layer.idle()
        assert layer.resident[here].all()

    over_line(large_model, check, capacity=900_000)


def test_damage_ahead_is_waste_and_a_want_still_gets_through(large_model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        await layer.idle()
        node = int(np.flatnonzero(~layer.resident)[7])
        layer.end_frame([], pinned=[0])
        layer.prefetch([node])
        await layer.idle()
        assert layer.stats.wasted_bytes == layer.index.size[node]
        while not layer.resident[node]:
            layer.end_frame([node], pinned=[0])
            await layer.idle()
        layer.end_frame([], pinned=[node])
        assert layer.stats.wasted_bytes == layer.index.size[node]

    over_line(large_model, check, fault={1: Flip(at=100)})
