"""Each fault as the client sees it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import httpx

from pointlink.faults import Fault, Flip, IgnoreRange, OtherEtag, Reset, Shift, Short, Stall, Status
from pointlink.memory import Network
from pointlink.origin import Origin
from pointlink.profiles import NONE
from pointlink.resources import Resource
from pointlink.virtual import run

BODY = bytes(range(256)) * 1000
START, STOP = 1000, 151_000


@dataclass
class Seen:
    status: int
    headers: httpx.Headers
    body: bytes
    error: Exception | None
    seconds: float


def fetch(fault: Fault, *, number: int = 1) -> Seen:
    """Ask for a range three times; the second request meets the fault."""

    async def main() -> list[Seen]:
        loop = asyncio.get_running_loop()
        network = Network(Origin(resources={"/m": Resource.from_bytes(BODY)}, fault={number: fault}.get), NONE)
        seen = []
        async with httpx.AsyncClient(transport=network.transport(max_connections=1), timeout=60) as client:
            for _ in range(3):
                one = Seen(0, httpx.Headers(), b"", None, loop.time())
                seen.append(one)
                try:
                    ask = {"range": f"bytes={START}-{STOP - 1}"}
                    async with client.stream("GET", "http://o/m", headers=ask) as reply:
                        one.status, one.headers = reply.status_code, reply.headers
                        async for part in reply.aiter_raw():
                            one.body += part
                except httpx.TransportError as error:
                    one.error = error
                one.seconds = loop.time() - one.seconds
        await network.aclose()
        return seen

    before, spoilt, after = run(main())
    for other in (before, after):
        assert (other.status, other.body, other.error) == (206, BODY[START:STOP], None)
    return spoilt


def test_status() -> None:
    seen = fetch(Status(code=503, retry_after="7"))
    assert (seen.status, seen.body, seen.headers["retry-after"]) == (503, b"", "7")


def test_ignored_range() -> None:
    seen = fetch(IgnoreRange())
    assert (seen.status, seen.body) == (200, BODY)


def test_other_etag() -> None:
    seen = fetch(OtherEtag(etag='"new"'))
    assert (seen.status, seen.headers["etag"], seen.body) == (206, '"new"', BODY[START:STOP])


def test_shift() -> None:
    seen = fetch(Shift(by=3))
    assert seen.headers["content-range"] == f"bytes {START + 3}-{STOP + 2}/{len(BODY)}"
    assert seen.body == BODY[START + 3 : STOP + 3]


def test_reset_in_the_body_after_exactly_so_many_bytes() -> None:
    seen = fetch(Reset(after=100_001))
    assert seen.body == BODY[START : START + 100_001]
    assert isinstance(seen.error, httpx.ReadError)


def test_reset_before_the_head() -> None:
    seen = fetch(Reset())
    assert (seen.status, seen.body) == (0, b"")
    assert isinstance(seen.error, httpx.ReadError)


def test_short_body() -> None:
    seen = fetch(Short(missing=10))
    assert seen.body == BODY[START : STOP - 10]
    assert isinstance(seen.error, httpx.RemoteProtocolError)


def test_stalls() -> None:
    for after in (None, 0, 70_000):
        seen = fetch(Stall(seconds=20, after=after))
        assert (seen.body, seen.error, seen.seconds) == (BODY[START:STOP], None, 20.0)


def test_a_stall_longer_than_the_clients_patience() -> None:
    seen = fetch(Stall(seconds=100, after=5))
    assert isinstance(seen.error, httpx.ReadTimeout)
    assert (seen.body, seen.seconds) == (BODY[START : START + 5], 60.0)


def test_flipped_bits() -> None:
    for at in (0, 65_536, STOP - START - 1):
        seen = fetch(Flip(at=at, mask=0x81))
        wrong = [i for i, (a, b) in enumerate(zip(seen.body, BODY[START:STOP], strict=True)) if a != b]
        assert wrong == [at]
        assert seen.body[at] == BODY[START + at] ^ 0x81
