"""The schedule: what holds after any sequence of events, and how it fares on a simulated line."""

from __future__ import annotations

import random
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from support.fifo import Fifo

from pointstream.goodput import Goodput
from pointstream.offers import Request
from pointstream.scheduler import LinkState, Scheduler, SchedulerOptions

ADSL = LinkState(156_250.0, 0.05, measured=True)

HEAD = 375
"""Bytes of a reply's head: what `pointstream serve` sends."""


def offer(scheduler: Scheduler, items: list[tuple[int, int, int]]) -> None:
    table = np.array(items, dtype=np.int64).reshape(-1, 3)
    scheduler.offer(table[:, 0], table[:, 1], table[:, 2])


def spans(requests: list[Request]) -> list[tuple[int, int, tuple[int, ...]]]:
    return [(r.range.start, r.range.stop, tuple(item.key for item in r.items)) for r in requests]


def test_neighbours_travel_together_and_strangers_do_not() -> None:
    scheduler = Scheduler()
    # 3 is most urgent; 2 and 4 touch it; 9 lies behind a gap of 300 bytes, 20 far away
    offer(scheduler, [(3, 3000, 4000), (20, 90_000, 91_000), (2, 2000, 3000), (9, 5300, 6000), (4, 4000, 5000)])
    busy = ADSL._replace(rtt=0.0)  # no idle time to save: only headers count
    assert spans(scheduler.issue(0.0, busy)) == [(2000, 6000, (2, 3, 4, 9)), (90_000, 91_000, (20,))]


def test_a_gap_is_worth_the_time_in_which_the_link_would_run_dry() -> None:
    wants = [(0, 0, 1000), (1, 1000 + 5000, 7000)]
    scheduler = Scheduler()
    offer(scheduler, wants)
    assert spans(scheduler.issue(0.0, ADSL)) == [(0, 7000, (0, 1))]
    scheduler = Scheduler()
    offer(scheduler, [(99, 500_000, 512_000), *wants])
    assert spans(scheduler.issue(0.0, ADSL)) == [(500_000, 512_000, (99,)), (0, 1000, (0,)), (6000, 7000, (1,))]


def test_requests_are_short_but_hold_one_object() -> None:
    scheduler = Scheduler()
    offer(scheduler, [(k, k * 4000, k * 4000 + 4000) for k in range(100)])
    (request,) = scheduler.issue(0.0, ADSL)[:1]
    assert request.range.size <= SchedulerOptions().request_seconds * ADSL.rate
    assert len(request.items) == 3
    scheduler = Scheduler()
    offer(scheduler, [(0, 0, 5_000_000)])
    assert spans(scheduler.issue(0.0, ADSL)) == [(0, 5_000_000, (0,))]


def test_what_comes_along_is_nearly_as_urgent() -> None:
    """Neighbours in the file whose turn would come much later wait for it: the line carries urgent bytes first."""
    near = [(k, k * 4000, k * 4000 + 4000) for k in range(3)]
    between = [(k, k * 100_000, k * 100_000 + 20_000) for k in range(10, 13)]  # 0.38 s of the line
    for reach, keys in ((0.25, (0,)), (0.5, (0, 1, 2))):
        scheduler = Scheduler(SchedulerOptions(reach_seconds=reach))
        offer(scheduler, [near[0], *between, *near[1:]])
        assert spans(scheduler.issue(0.0, ADSL))[0][2] == keys
    scheduler = Scheduler()
    offer(scheduler, [near[0], *between, *near[1:]])
    assert spans(scheduler.issue(0.0, None))[0][2] == (0, 1, 2)  # a file: nothing waits


def test_what_is_not_issued_is_forgotten() -> None:
    scheduler = Scheduler()
    offer(scheduler, [(k, k * 100_000, k * 100_000 + 5000) for k in range(50)])
    first = scheduler.issue(0.0, ADSL)
    assert scheduler.outstanding <= scheduler.window(ADSL)
    offer(scheduler, [(77, 9_000_000, 9_005_000)])
    for request in first:
        scheduler.landed(request, request.range.size)
        scheduler.ended(request)
    assert [r.items[0].key for r in scheduler.issue(1.0, ADSL)] == [77]
    assert scheduler.waiting == 0


def test_the_bucket_carries_over_and_is_capped() -> None:
    scheduler = Scheduler()
    sent = 0
    for frame in range(300):  # a window guessed far too large would ask again at once: everything lands at once
        now = frame / 30
        offer(scheduler, [(frame * 100 + k, k * 50_000, k * 50_000 + 5000) for k in range(40)])
        for request in scheduler.issue(now, ADSL):
            sent += request.range.size
            scheduler.landed(request, request.range.size)
            scheduler.ended(request)
    spent = sent / 10.0 / ADSL.rate
    assert 1.2 < spent < 1.35  # gain 1.25, one window at the start, one overdraft at the end
    offer(scheduler, [(k, k * 50_000, k * 50_000 + 5000) for k in range(40)])
    burst = sum(request.range.size for request in scheduler.issue(1000.0, ADSL))
    assert burst <= scheduler.window(ADSL) + 5000


def test_slow_start_doubles_until_measured() -> None:
    prior = LinkState(131_072.0, 0.05, measured=False)
    scheduler = Scheduler(SchedulerOptions(most_requests=1000))
    rounds = []
    for turn in range(6):
        offer(scheduler, [(turn * 1000 + k, k * 50_000, k * 50_000 + 5000) for k in range(1000)])
        requests = scheduler.issue(float(turn), prior)
        rounds.append(sum(request.range.size for request in requests))
        for request in requests:
            scheduler.landed(request, request.range.size)
            scheduler.ended(request)
    assert rounds[0] < 40_000
    assert all(1.7 < after / before < 2.2 for before, after in pairwise(rounds))


class Client:
    """The scheduler over a simulated line, as the access layer drives it: a look per frame and per landed object."""

    def __init__(self, link: Fifo, objects: list[tuple[int, int, int]], *, fps: float = 30.0) -> None:
        self.link, self.meter, self.scheduler = link, Goodput(), Scheduler()
        self.wants = objects
        self.here: dict[int, float] = {}
        self.payload = 0
        self.most_outstanding = 0
        self.frame = 1 / fps
        self.link.at(0.0, self.look)

    def look(self) -> None:
        self.wants = [want for want in self.wants if want[0] not in self.here]
        offer(self.scheduler, self.wants)
        self.issue()
        self.link.at(self.link.now + self.frame, self.look)

    def issue(self) -> None:
        now = self.link.now
        state = LinkState(self.meter.admission(now), self.meter.rtt, self.meter.measured)
        for request in self.scheduler.issue(now, state):
            self.ask(request)
        if now > 2.0:  # the slow start is over
            self.most_outstanding = max(self.most_outstanding, self.scheduler.outstanding)

    def ask(self, request: Request) -> None:
        transfer = self.meter.begin(self.link.now, request.range.size)
        waiting = list(request.items)

        def piece(nbytes: int, last: bool) -> None:
            self.meter.received(transfer, self.link.now, nbytes)
            self.scheduler.landed(request, nbytes)
            while waiting and waiting[0].stop <= request.range.start + request.landed:
                item = waiting.pop(0)
                self.here[item.key] = self.link.now
                self.payload += item.stop - item.start
                if not last:
                    self.issue()
            if last:
                self.meter.end(transfer, self.link.now)
                self.scheduler.ended(request)
                self.issue()

        self.link.request(request.range.size, piece)


def model(count: int, seed: int = 5) -> list[tuple[int, int, int]]:
    """Clouds of about 5 KB in file order."""
    draw, place, objects = random.Random(seed), 70_000, []
    for key in range(count):
        size = draw.randint(3500, 6500)
        objects.append((key, place, place + size))
        place += size
    return objects


def scattered(count: int) -> list[tuple[int, int, int]]:
    """Pairs of siblings from everywhere, in an order of priority that has nothing to do with place."""
    objects = model(count * 4)
    pairs = [objects[k : k + 2] for k in range(0, len(objects), 8)]
    random.Random(3).shuffle(pairs)
    return [item for pair in pairs for item in pair]


@pytest.mark.parametrize("wants", [model(800), scattered(800)], ids=["in file order", "scattered pairs"])
@pytest.mark.parametrize("fps", [30.0, 5.0])
def test_the_line_carries_payload_while_anything_is_wanted(wants: list[tuple[int, int, int]], fps: float) -> None:
    link = Fifo(ADSL.rate, 0.05, header=HEAD)
    client = Client(link, wants, fps=fps)
    link.run(15.0)
    assert len(client.wants) > 0
    # A long frame looks seldom, so arrivals refill the line: they come every 30 ms.
    assert client.payload / (link.now * ADSL.rate) >= 0.95
    assert client.most_outstanding <= 1.35 * client.scheduler.window(ADSL)


@pytest.mark.parametrize("when", [3.0, 3.011, 3.02, 4.5, 7.7])
def test_an_urgent_cloud_is_not_stuck_behind_the_bulk(when: float) -> None:
    link = Fifo(ADSL.rate, 0.05, header=HEAD)
    client = Client(link, model(800))

    def turn() -> None:  # seen by the next frame
        client.wants = [(-1, 9_000_000, 9_005_000), *client.wants]

    link.at(when, turn)
    link.run(when + 2.0)
    assert client.here[-1] - when <= 0.4


def test_a_fast_line_is_found_quickly() -> None:
    link = Fifo(12_500_000.0, 0.001, header=260)
    client = Client(link, model(20_000))
    link.run(1.0)
    assert client.payload > 0.5 * link.rate


def test_a_jumping_camera_wastes_little() -> None:
    """New wants every 100 ms for 20 s: what arrives was wanted when asked, and no queue of the past builds up."""
    link = Fifo(ADSL.rate, 0.05, header=HEAD)
    objects = model(40_000)
    client = Client(link, objects[:40])
    draw = random.Random(2)

    def jump() -> None:
        first = draw.randrange(len(objects) - 40)
        client.wants = objects[first : first + 40]
        link.at(link.now + 0.1, jump)

    link.at(0.1, jump)
    link.run(20.0)
    assert client.payload >= 0.9 * client.meter.received_bytes
    assert client.payload >= 0.9 * link.now * ADSL.rate


class Machine(RuleBasedStateMachine):
    """Any order of events: nothing is in flight twice, nothing is lost, no more is outstanding than allowed."""

    def __init__(self) -> None:
        super().__init__()
        self.scheduler = Scheduler(SchedulerOptions(most_requests=4))
        self.now = 0.0
        self.link: LinkState | None = ADSL
        self.flying: list[Request] = []
        self.wants: set[int] = set()

    @rule(rate=st.floats(1000, 1e8), rtt=st.floats(0, 1), measured=st.booleans(), local=st.booleans())
    def link_changes(self, rate: float, rtt: float, measured: bool, local: bool) -> None:
        self.link = None if local else LinkState(rate, rtt, measured)

    @rule(keys=st.lists(st.integers(0, 60), unique=True, max_size=30))
    def frame(self, keys: list[int]) -> None:
        self.wants = set(keys)
        offer(self.scheduler, [(key, key * 6000, key * 6000 + 1000 + 80 * key) for key in keys])

    @rule(wait=st.floats(0, 2))
    def look(self, wait: float) -> None:
        self.now += wait
        idle = self.scheduler.outstanding == 0
        waiting = self.scheduler.waiting
        new = self.scheduler.issue(self.now, self.link)
        if idle and waiting and not self.flying and (self.link is None or wait * self.link.rate > 1e6):
            assert new, "an idle link must be used"
        for request in new:
            assert {item.key for item in request.items} <= self.wants
            one = len(request.items) == 1
            assert one or request.range.size <= self.scheduler.longest(self.link)
        if len(self.flying) + len(new) > 1 and new:
            assert self.scheduler.outstanding <= self.scheduler.window(self.link)
        self.flying += new

    @precondition(lambda self: self.flying)
    @rule(which=st.integers(0, 3), part=st.floats(0, 1))
    def arrives(self, which: int, part: float) -> None:
        request = self.flying[which % len(self.flying)]
        self.scheduler.landed(request, int(part * (request.range.size - request.landed)))

    @precondition(lambda self: self.flying)
    @rule(which=st.integers(0, 3), whole=st.booleans())
    def ends(self, which: int, whole: bool) -> None:
        request = self.flying.pop(which % len(self.flying))
        if whole:
            self.scheduler.landed(request, request.range.size)
        self.scheduler.ended(request)
        assert not any(self.scheduler.flies(item.key) for item in request.items)

    @invariant()
    def books_balance(self) -> None:
        keys = [item.key for request in self.flying for item in request.items]
        assert len(keys) == len(set(keys)), "a key is in flight twice"
        assert all(self.scheduler.flies(key) for key in keys)
        assert self.scheduler.outstanding == sum(r.range.size - r.landed for r in self.flying)
        assert self.scheduler.in_flight == len(self.flying) <= 4
        for request in self.flying:
            ends = [item.stop for item in request.items]
            assert ends == sorted(ends)
            assert request.range.start == request.items[0].start
            assert request.range.stop == ends[-1]


Machine.TestCase.settings = settings(max_examples=40, stateful_step_count=30, deadline=None)
TestMachine = Machine.TestCase
