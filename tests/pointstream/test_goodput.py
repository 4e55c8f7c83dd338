"""The meter reads the link, not the replies."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.fifo import Fifo

from pointstream.goodput import Goodput, GoodputOptions

ADSL = 156_250.0


class Traffic:
    """Keep `parallel` requests of random sizes going over a link, as the meter sees them."""

    def __init__(self, link: Fifo, meter: Goodput, parallel: int, sizes: tuple[int, int], seed: int = 1) -> None:
        self.link, self.meter, self.sizes, self.random = link, meter, sizes, random.Random(seed)
        self.going = True
        for _ in range(parallel):
            self.ask()

    def ask(self) -> None:
        size = self.random.randint(*self.sizes)
        transfer = self.meter.begin(self.link.now, size)

        def piece(nbytes: int, last: bool) -> None:
            self.meter.received(transfer, self.link.now, nbytes)
            if last:
                self.meter.end(transfer, self.link.now)
                if self.going:
                    self.ask()

        self.link.request(size, piece)


@pytest.mark.parametrize("parallel", [1, 2, 4, 8])
@pytest.mark.parametrize(("rate", "rtt"), [(ADSL, 0.05), (12.5e6, 0.001), (20_000.0, 0.3)])
def test_reads_the_link_whatever_is_in_flight(parallel: int, rate: float, rtt: float) -> None:
    link, meter = Fifo(rate, rtt, header=0), Goodput()
    sizes = (2048, 65_536) if rate < 1e6 else (65_536, 1 << 20)
    Traffic(link, meter, parallel, sizes)
    link.run(20.0)
    assert 0.95 <= meter.rate(link.now) / rate <= 1.01
    assert 0.95 <= meter.admission(link.now) / rate <= 1.01
    assert meter.rtt == pytest.approx(rtt, rel=0.35, abs=0.012 if rate > 1e5 else 0.1)


def test_follows_a_link_that_changes() -> None:
    link, meter = Fifo(ADSL, 0.04), Goodput()
    Traffic(link, meter, 4, (8192, 16_384))
    link.run(10.0)
    for rate in (ADSL / 10, ADSL):
        link.rate = rate
        link.run(link.now + 10.0)
        assert meter.rate(link.now) == pytest.approx(rate, rel=0.25)


def test_idle_gaps_do_not_count() -> None:
    link, meter = Fifo(ADSL, 0.05, header=0), Goodput()
    for _ in range(10):
        traffic = Traffic(link, meter, 3, (16_384, 32_768))
        link.run(link.now + 0.5)
        traffic.going = False
        link.run(link.now + 5.0)
    assert meter.in_flight == 0
    assert 0.95 <= meter.rate(link.now) / ADSL <= 1.01


def test_tiny_bins_say_nothing() -> None:
    link, meter = Fifo(ADSL, 0.05), Goodput()
    for _ in range(50):
        Traffic(link, meter, 1, (4096, 4096)).going = False
        link.run(link.now + 0.2)
    assert not meter.measured
    assert meter.rate(link.now) == meter.options.prior
    assert meter.rtt == pytest.approx(0.05 + (300 + 1448) / ADSL, rel=0.01)


def test_silence_returns_to_the_prior() -> None:
    options = GoodputOptions(prior=10_000.0)
    link, meter = Fifo(ADSL, 0.05), Goodput(options)
    traffic = Traffic(link, meter, 2, (16_384, 16_384))
    link.run(5.0)
    traffic.going = False
    link.run(6.0)
    before = meter.rate(link.now)
    assert meter.rate(link.now + 29.0) == before
    assert 10_000 < meter.rate(link.now + 60.0) < before / 1.5
    assert meter.rate(link.now + 900.0) == pytest.approx(10_000, rel=0.01)


def test_own_queue_is_no_round_trip() -> None:
    """The first byte behind 250 KB of our own bytes comes after 1.6 s; the round trip stays 50 ms."""
    link, meter = Fifo(ADSL, 0.05), Goodput()
    Traffic(link, meter, 1, (32_768, 32_768)).going = False
    link.run(1.0)
    for _ in range(8):
        Traffic(link, meter, 1, (32_768, 32_768)).going = False
    link.run(5.0)
    assert meter.rtt < 0.08


@given(st.lists(st.tuples(st.floats(0.0, 2.0), st.integers(0, 2), st.integers(1, 70_000)), max_size=80))
def test_any_events_leave_it_sane(events: list[tuple[float, int, int]]) -> None:
    meter, now, going = Goodput(), 0.0, []
    for wait, kind, size in events:
        now += wait
        if kind == 0 or not going:
            going.append(meter.begin(now, size))
        elif kind == 1:
            meter.received(going[0], now, size)
        else:
            meter.end(going.pop(0), now)
        assert meter.rate(now) > 0
        assert meter.admission(now) > 0
        assert meter.rtt >= 0
        assert meter.in_flight == len(going)
        assert meter.outstanding >= 0
