"""httpx over the in-memory link: exact times, identical runs."""

from __future__ import annotations

import asyncio

import httpx
import pytest

from pointlink.memory import Network, transport
from pointlink.origin import Origin, Resource
from pointlink.profiles import ADSL, NONE, Profile
from pointlink.virtual import run

BODY = bytes(range(251)) * 5000
SIZES = [100, 1448, 4096, 9000, 20000, 65536]


def origin() -> Origin:
    return Origin(resources={"/model.lpc": Resource.from_bytes(BODY)})


def asked(start: int, stop: int) -> dict[str, str]:
    return {"range": f"bytes={start}-{stop - 1}"}


async def trace_of(requests: int, connections: int, profile: Profile) -> list[tuple[float, int, int]]:
    network = Network(origin(), profile)
    seen: list[tuple[float, int, int]] = []
    times = asyncio.get_running_loop().time

    async def fetch(client: httpx.AsyncClient, number: int) -> None:
        start, size = 1000 * number, SIZES[number % len(SIZES)]
        got = b""
        async with client.stream("GET", "/model.lpc", headers=asked(start, start + size)) as reply:
            assert reply.status_code == 206
            async for part in reply.aiter_raw():
                seen.append((times(), number, len(part)))
                got += part
        assert got == BODY[start : start + size]

    limits = network.transport(max_connections=connections)
    async with httpx.AsyncClient(transport=limits, base_url="http://origin", timeout=None) as client:
        await asyncio.gather(*(fetch(client, number) for number in range(requests)))
    seen.append((times(), -1, network.line.down.link.carried))
    await network.aclose()
    return seen


def test_sixty_requests_over_four_connections_repeat_exactly() -> None:
    first, second = run(trace_of(60, 4, ADSL)), run(trace_of(60, 4, ADSL))
    assert first == second
    assert len(first) > 500


def test_the_link_is_the_only_thing_that_takes_time() -> None:
    seconds, _, carried = run(trace_of(60, 4, ADSL))[-1]
    in_theory = carried * 8 / 1.25e6
    handshake_and_first_request = 2 * ADSL.rtt
    assert in_theory < seconds < (in_theory + handshake_and_first_request) * 1.01


def test_a_first_request_costs_two_round_trips_and_its_bytes() -> None:
    async def main() -> tuple[float, float]:
        loop = asyncio.get_running_loop()
        network = Network(origin(), ADSL)
        async with httpx.AsyncClient(transport=network.transport(), timeout=None) as client:
            reply = await client.get("http://any.host:81/model.lpc", headers=asked(0, 65536))
            assert reply.content == BODY[:65536]
            links = network.line
            bytes_time = links.down.link.carried * 8 / 1.25e6 + links.up.link.carried * 8 / 256e3
            return loop.time(), 2 * 0.05 + bytes_time

    took, expected = run(main())
    assert took == pytest.approx(expected, abs=1e-9)


def test_without_a_limit_nothing_takes_time() -> None:
    async def main() -> float:
        async with httpx.AsyncClient(transport=transport(origin(), NONE)) as client:
            reply = await client.get("http://origin/model.lpc")
            assert reply.content == BODY
        return asyncio.get_running_loop().time()

    assert run(main()) == 0.0
