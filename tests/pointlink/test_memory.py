"""httpx over the in-memory link: exact times, identical runs."""

from __future__ import annotations

import asyncio

import httpx
import pytest

from pointlink.memory import Network, transport
from pointlink.origin import Origin, Reader, Writer
from pointlink.profiles import ADSL, NONE, Profile
from pointlink.resources import Resource
from pointlink.stream import MemoryStream
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


def test_connections_share_the_one_link() -> None:
    async def main() -> tuple[float, float]:
        loop = asyncio.get_running_loop()
        network = Network(origin(), ADSL)
        clients = [httpx.AsyncClient(transport=network.transport(), timeout=None) for _ in range(3)]
        await asyncio.gather(*(client.get("http://o/model.lpc", headers=asked(0, 200_000)) for client in clients))
        for client in clients:
            await client.aclose()
        return loop.time(), network.line.down.link.carried * 8 / 1.25e6

    seconds, in_theory = run(main())
    assert in_theory + 0.1 < seconds < in_theory + 0.15


@pytest.mark.parametrize("queue", [8 * 1024, 128 * 1024])
def test_an_urgent_request_waits_for_the_queue_before_it(queue: int) -> None:
    async def main() -> float:
        loop = asyncio.get_running_loop()
        network = Network(origin(), Profile(down_rate=1.25e6, up_rate=1.25e6, rtt=0.05, queue=queue))
        async with httpx.AsyncClient(transport=network.transport(), timeout=None) as client:
            await asyncio.gather(*(client.get("http://o/model.lpc", headers=asked(0, 1)) for _ in range(2)))
            bulk = asyncio.create_task(client.get("http://o/model.lpc"))
            await asyncio.sleep(3)
            began = loop.time()
            await client.get("http://o/model.lpc", headers=asked(0, 4096))
            took = loop.time() - began
            assert not bulk.done()
            await bulk
        return took

    # A round trip on an open connection, the queue, and 4 KB of which every second piece is the bulk's.
    expected = 0.05 + (queue + 2 * 4096) * 8 / 1.25e6
    assert run(main()) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("left_at", [0.3, 0.55, 0.75, 1.0])
def test_a_client_that_leaves_stops_the_server_but_not_what_is_queued(left_at: float) -> None:
    async def main() -> tuple[int, float]:
        loop = asyncio.get_running_loop()
        network = Network(origin(), ADSL)
        async with httpx.AsyncClient(transport=network.transport(), timeout=None) as client:
            async with client.stream("GET", "http://o/model.lpc") as reply:
                async for _ in reply.aiter_raw():
                    if loop.time() > left_at:
                        break
            await asyncio.sleep(10)
        return network.line.down.link.carried, network.line.down.link.windows[-1][1]

    carried, busy_until = run(main())
    # The server starts one and a half round trips after the client and hears half of one later that it left.
    heard = left_at + 0.025 + 0.01
    assert carried <= (heard - 0.075) * 1.25e6 / 8 + ADSL.queue
    assert left_at < busy_until <= heard + ADSL.queue * 8 / 1.25e6


def test_a_reader_that_rests_holds_the_sender_back() -> None:
    def read(start: int, stop: int) -> bytes:
        nonlocal asked_for
        asked_for = stop
        return BODY[start:stop]

    async def main() -> tuple[int, int, bytes]:
        source = Origin(resources={"/model.lpc": Resource(length=len(BODY), etag='"x"', read=read)})
        network = Network(source, Profile(down_rate=100e6, up_rate=100e6, rtt=0.001, queue=64 * 1024))
        stream = await network.open_connection()
        stream.write(b"GET /model.lpc HTTP/1.1\r\nHost: o\r\nConnection: close\r\n\r\n")
        await asyncio.sleep(60)
        carried, read_ahead = network.line.down.link.carried, asked_for
        data = b""
        while part := await stream.read(1000):
            data += part
        return carried, read_ahead, data

    asked_for = 0
    carried, read_ahead, data = run(main())
    assert 0 < carried <= 256 * 1024
    assert read_ahead <= carried + 2 * 64 * 1024
    assert data.endswith(BODY)


def test_half_a_connection_may_end_before_the_other() -> None:
    class Reverse(Origin):
        async def handle(self, reader: object, writer: object) -> None:
            assert isinstance(reader, MemoryStream)
            asked = b""
            while data := await reader.read():
                asked += data
            reader.write(asked[::-1])
            reader.close()

    async def main() -> bytes:
        stream = await Network(Reverse(resources={}), ADSL).open_connection()
        stream.write(b"abc" * 5000)
        stream.write_eof()
        answer = b""
        while data := await stream.read(777):
            answer += data
        return answer

    assert run(main()) == b"cba" * 5000


def test_patience_is_virtual_too() -> None:
    async def main() -> float:
        slow = Profile(down_rate=8e3, up_rate=8e6, rtt=1.0, queue=32 * 1024)
        async with httpx.AsyncClient(transport=transport(origin(), slow), timeout=httpx.Timeout(0.5)) as client:
            with pytest.raises(httpx.ConnectTimeout):
                await client.get("http://o/model.lpc")
            client.timeout = httpx.Timeout(1.25, read=1.1)
            with pytest.raises(httpx.ReadTimeout):
                await client.get("http://o/model.lpc", headers=asked(0, 100_000))
        return asyncio.get_running_loop().time()

    # Half a second; one to connect; the first piece would come after one and 1448 ms.
    assert run(main()) == pytest.approx(0.5 + 1.0 + 1.1, abs=0.01)


def test_there_is_no_tls_and_it_says_so() -> None:
    async def main() -> None:
        async with httpx.AsyncClient(transport=transport(origin(), NONE)) as client:
            with pytest.raises(httpx.ConnectError, match="no TLS"):
                await client.get("https://o/model.lpc")

    run(main())


def test_cancelled_requests_leave_nothing_behind() -> None:
    class Counting(Origin):
        serving = 0

        async def handle(self, reader: Reader, writer: Writer) -> None:
            self.serving += 1
            await super().handle(reader, writer)
            self.serving -= 1

    async def main() -> tuple[bytes, int]:
        source = Counting(resources=origin().resources)
        network = Network(source, ADSL)
        for number in range(100):
            client = httpx.AsyncClient(transport=network.transport(), timeout=None)
            task = asyncio.create_task(client.get("http://o/model.lpc", headers=asked(0, 50_000)))
            await asyncio.sleep(0.013 * (number % 20))
            task.cancel()
            await asyncio.wait([task])
            await client.aclose()
        async with httpx.AsyncClient(transport=network.transport(), timeout=None) as client:
            reply = await client.get("http://o/model.lpc", headers=asked(7, 77))
        await asyncio.sleep(1)
        return reply.content, source.serving

    assert run(main()) == (BODY[7:77], 0)
