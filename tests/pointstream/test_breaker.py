"""When a host is left alone, and how many retries it gets; and what is dialled ahead."""

from __future__ import annotations

import asyncio
import random

import pytest
from support.hosts import honest, origin_of, reply, scripted, virtual_store

from lpc.errors import LpcError, Unavailable
from lpc.ranges import ByteRange
from pointlink import virtual
from pointlink.profiles import parse_profile
from pointstream.stores.breaker import Breaker, BreakerOptions
from pointstream.stores.dialling import OneConnection

DATA = random.Random(4).randbytes(300_000)


def tripped(now: float = 0.0) -> Breaker:
    breaker = Breaker("host.test")
    for _ in range(8):
        assert breaker.check(now) == 0.0
        breaker.failed(now, "reset")
    return breaker


def test_failures_in_a_row_open_it_and_a_good_reply_closes_it() -> None:
    breaker = Breaker("host.test")
    for _ in range(7):
        breaker.failed(0.0, "reset")
    breaker.answered()
    for _ in range(7):
        breaker.failed(0.0, "reset")
    assert breaker.check(0.0) == 0.0
    breaker.failed(0.0, "reset")
    with pytest.raises(Unavailable, match=r"host\.test fails again and again \(reset\): not asked for 1\.0 s"):
        breaker.check(0.0)
    assert breaker.check(1.0) == 0.0
    breaker.answered()
    assert breaker.check(1.0) == breaker.check(1.0) == 0.0


def test_one_request_tries_while_others_wait_and_pauses_double() -> None:
    breaker, now, pauses = tripped(), 1.0, []
    for _ in range(6):
        assert breaker.check(now) == 0.0
        assert breaker.check(now) > 0.0
        breaker.failed(now, "reset")
        left = 0.0
        while True:
            try:
                breaker.check(now + left)
            except Unavailable:
                left += 0.5
            else:
                break
        pauses.append(left)
        now += left
        breaker.abandoned(now)
    assert pauses == [2.0, 4.0, 8.0, 10.0, 10.0, 10.0]


def test_a_try_that_was_cut_off_leaves_its_place_to_the_next() -> None:
    breaker = tripped()
    assert breaker.check(1.0) == 0.0
    breaker.abandoned(1.2)
    assert breaker.check(1.2) == 0.0


def test_retries_are_a_tenth_of_the_requests() -> None:
    breaker = Breaker("host.test", BreakerOptions(saved=2.0))
    granted = 0
    for _ in range(1000):
        breaker.check(0.0)
        granted += breaker.may_retry()
        breaker.answered()
    assert granted == pytest.approx(102, abs=2)


def test_a_host_that_fails_at_random_is_asked_little_more_often() -> None:
    """Half of all replies are 503: without a budget every range would cost two requests."""
    draw = random.Random(2)

    async def main() -> None:
        store, script = scripted(
            lambda _, request: reply(503) if draw.random() < 0.5 else honest(DATA, request), lanes=8
        )
        good = 0
        for number in range(600):
            try:
                assert await store.read(ByteRange(number, number + 9)) == DATA[number : number + 9]
                good += 1
            except LpcError:
                await asyncio.sleep(1.0)
        assert len(script.requests) <= 600 * 1.25
        assert good >= 300
        await store.close()

    virtual.run(main())


def test_a_dead_host_is_asked_rarely_by_however_many_readers() -> None:
    async def main() -> None:
        store, script = scripted(lambda _, request: reply(503))
        loop = asyncio.get_running_loop()

        async def reader(number: int) -> None:
            while loop.time() < 60.0:
                with pytest.raises(Unavailable):
                    await store.read(ByteRange(number, number + 10))
                await asyncio.sleep(0.5)

        await asyncio.gather(*(reader(number) for number in range(20)))
        assert len(script.requests) < 60
        script.answer = lambda _, request: honest(DATA, request)
        await asyncio.sleep(10.0)
        assert await store.read(ByteRange(0, 10)) == DATA[:10]
        await store.close()

    virtual.run(main())


def test_connections_are_ready_when_the_first_bytes_make_more_wanted() -> None:
    async def main() -> None:
        async with virtual_store(origin_of(DATA), parse_profile("100M,200ms")) as store:
            loop = asyncio.get_running_loop()
            await store.read(ByteRange(0, 1000))
            start = loop.time()
            await asyncio.gather(*(store.read(ByteRange(k, k + 1000)) for k in range(4)))
            assert loop.time() - start < 0.25, "one round trip, not two"

    virtual.run(main())


def test_a_connection_dialled_long_ago_or_hung_up_is_not_used() -> None:
    from pointlink.memory import Network

    async def main() -> None:
        import httpx

        origin = origin_of(DATA)
        origin.idle_timeout = 2.0
        network = Network(origin, parse_profile("lan"))
        for wait in (0.1, 3.0, 30.0):
            transport = OneConnection(backend=network, keep_alive=None)
            transport.dial("host.test", 80)
            await asyncio.sleep(wait)
            request = httpx.Request("GET", "http://host.test/model.lpc", headers={"Range": "bytes=0-9"})
            response = await transport.handle_async_request(request)
            assert await response.aread() == DATA[:10]
            await response.aclose()
            assert transport.connections == 1
            await transport.aclose()
            assert transport.connections == 0
        unused = OneConnection(backend=network, keep_alive=None)
        unused.dial("host.test", 80)
        await unused.aclose()
        await network.aclose()

    virtual.run(main())
