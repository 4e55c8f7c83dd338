"""Hosts and lines that misbehave: the right bytes in the end, or one error; and nothing is left behind."""

from __future__ import annotations

import asyncio
import http.server
import random
import threading
from typing import TYPE_CHECKING, Any

import httpx
import pytest
from support.hosts import (
    ADDRESS,
    Pieces,
    Script,
    honest,
    origin_of,
    range_of,
    reply,
    scripted,
    socket_store,
    virtual_store,
)

from lpc.errors import LpcError, ModelChanged, NotFound, RangesUnsupported, StoreError, Unavailable
from lpc.ranges import ByteRange
from pointlink import virtual
from pointlink.faults import IgnoreRange, OtherEtag, Reset, Shift, Short, Stall, Status
from pointlink.profiles import ADSL
from pointstream.stores.http import HttpOptions, HttpStore
from pointstream.stores.patience import PatienceOptions

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

DATA = random.Random(9).randbytes(200_000)
FIRST, LATER = ByteRange(0, 10_000), ByteRange(50_000, 90_000)

CURED = {
    "reset before the head": Reset(),
    "reset in the body": Reset(after=20_000),
    "closed before the end": Short(missing=1),
    "closed at once": Short(missing=40_000),
    "another range": Shift(by=1),
    "stalled head": Stall(seconds=60.0, after=None),
    "stalled body": Stall(seconds=60.0, after=5),
    "busy": Status(code=503),
    "too many": Status(code=429, retry_after="3"),
    "gateway": Status(code=502),
    "whole file": IgnoreRange(),
}


CASES = [(name, times, "virtual") for name in CURED for times in (1, 3)]
CASES += [(name, 1, "socket") for name in CURED if name not in ("stalled head", "stalled body", "too many")]
HASTY = HttpOptions(patience=PatienceOptions(backoff_seconds=0.01))


@pytest.mark.parametrize(("name", "times", "place"), CASES)
def test_what_passes_is_waited_for(name: str, times: int, place: str) -> None:
    fault = dict.fromkeys(range(1, 1 + times), CURED[name])

    async def check(store: HttpStore) -> None:
        assert await store.read(FIRST) == DATA[:10_000]
        seen: list[tuple[int, bytes]] = []
        assert await store.read(LATER, lambda offset, chunk: seen.append((offset, chunk))) == DATA[50_000:90_000]
        for offset, chunk in seen:
            assert chunk == DATA[offset : offset + len(chunk)]
        assert await store.read(ByteRange(3, 9)) == DATA[3:9]
        assert store.meter is not None
        assert store.meter.in_flight == 0

    run_on(place, fault, check)


@pytest.mark.parametrize("name", [name for name in CURED if name not in ("whole file", "reset in the body")])
def test_what_does_not_pass_is_told_once(name: str) -> None:
    async def check(store: HttpStore) -> None:
        assert await store.read(FIRST) == DATA[:10_000]
        with pytest.raises(Unavailable, match="gave up after 4 tries"):
            await store.read(LATER)
        assert store.meter is not None
        assert store.meter.in_flight == 0

    run_on("virtual", lambda number: CURED[name] if number else None, check)


def run_on(place: str, fault: Any, check: Callable[[HttpStore], Any]) -> None:
    async def run() -> None:
        origin = origin_of(DATA, fault)
        if place == "virtual":
            async with virtual_store(origin, ADSL) as store:
                await check(store)
        else:
            async with socket_store(origin, HASTY) as store:
                await check(store)

    (virtual.run if place == "virtual" else asyncio.run)(run())


def test_a_new_tag_is_a_new_build() -> None:
    async def check(store: HttpStore) -> None:
        await store.read(FIRST)
        with pytest.raises(ModelChanged):
            await store.read(LATER)
        store.forget()
        assert await store.read(LATER) == DATA[50_000:90_000]

    run_on("virtual", {1: OtherEtag(etag='"other"')}, check)


def test_requests_run_side_by_side_and_one_bad_one_hurts_no_other() -> None:
    async def check(store: HttpStore) -> None:
        await store.read(FIRST)
        ranges = [ByteRange(start, start + 9000) for start in range(0, 180_000, 9000)]
        got = await asyncio.gather(*(store.read(part) for part in ranges))
        assert got == [DATA[part.start : part.stop] for part in ranges]

    run_on("virtual", {4: Reset(after=100), 7: Stall(seconds=99.0), 9: Status(code=500), 11: Short()}, check)


def script(answer: Callable[[int, httpx.Request], httpx.Response], check: Callable[[HttpStore, Any], Any]) -> None:
    async def run() -> None:
        store, host = scripted(answer)
        try:
            await check(store, host)
        finally:
            await store.close()
        assert host.closed

    virtual.run(run())


def test_every_request_is_one_plain_range_without_codings() -> None:
    async def check(store: HttpStore, host: Any) -> None:
        await store.read(FIRST)
        await store.read(LATER)
        first, later = host.requests
        assert (first.headers["range"], later.headers["range"]) == ("bytes=0-9999", "bytes=50000-89999")
        assert first.headers["accept-encoding"] == "identity"
        assert first.headers["host"] == "host.test"
        assert "if-match" not in first.headers
        assert later.headers["if-match"] == '"one"'

    script(lambda _, request: honest(DATA, request), check)


def test_a_host_that_gives_less_is_asked_for_the_rest() -> None:
    def answer(number: int, request: httpx.Request) -> httpx.Response:
        start, stop = range_of(request)
        stop = min(stop, start + 4000)
        return reply(206, DATA[start:stop], content_range=f"bytes {start}-{stop - 1}/{len(DATA)}")

    async def check(store: HttpStore, host: Any) -> None:
        assert await store.read(FIRST) == DATA[:10_000]
        assert len(host.requests) == 3
        with pytest.raises(StoreError, match="circles"):
            await store.read(ByteRange(0, 200_000))

    script(answer, check)


def test_a_host_that_gives_more_is_cut() -> None:
    def answer(number: int, request: httpx.Request) -> httpx.Response:
        start, stop = range_of(request)
        start, stop = start // 8192 * 8192, len(DATA)
        return reply(206, DATA[start:stop], content_range=f"bytes {start}-{stop - 1}/{len(DATA)}")

    async def check(store: HttpStore, host: Any) -> None:
        assert await store.read(LATER) == DATA[50_000:90_000]
        assert await store.read(FIRST) == DATA[:10_000]

    script(answer, check)


def test_a_body_without_length_that_ends_early_is_noticed() -> None:
    """httpx raises nothing here."""

    def answer(number: int, request: httpx.Request) -> httpx.Response:
        right = honest(DATA, request)
        if number == 0:
            right.stream = Pieces(DATA[:5000])
        return right

    async def check(store: HttpStore, host: Any) -> None:
        assert await store.read(FIRST) == DATA[:10_000]
        assert len(host.requests) == 2

    script(answer, check)


def test_a_break_in_the_body_resumes_under_a_strong_tag_and_starts_again_without() -> None:
    for etag, starts in (('"one"', [0, 6000]), ("", [0, 0])):

        def answer(number: int, request: httpx.Request, etag: str = etag) -> httpx.Response:
            right = honest(DATA, request, etag)
            if number == 0:
                right.stream = Pieces(DATA[:6000], httpx.ReadError("gone"))
            return right

        async def check(store: HttpStore, host: Any, starts: list[int] = starts) -> None:
            seen: list[int] = []
            assert await store.read(FIRST, lambda offset, _: seen.append(offset)) == DATA[:10_000]
            assert [range_of(request)[0] for request in host.requests] == starts == seen

        script(answer, check)


@pytest.mark.parametrize("length", [None, 50_000, 200_000])
def test_a_small_file_is_taken_whole_from_a_host_without_ranges(length: int | None) -> None:
    data = DATA[: length or 30_000]

    def answer(number: int, request: httpx.Request) -> httpx.Response:
        return reply(200, data) if length is None else reply(200, data, content_length=str(len(data)))

    async def check(store: HttpStore, host: Any) -> None:
        assert await store.read(ByteRange(0, 65_536)) == data[:65_536]
        assert await store.read(ByteRange(20_000, 40_000)) == data[20_000:40_000]
        assert store.length == len(data)
        assert len(host.requests) == 1

    script(answer, check)


def test_a_large_file_without_ranges_is_refused_at_its_head() -> None:
    def answer(number: int, request: httpx.Request) -> httpx.Response:
        endless = httpx.Response(200, stream=Pieces(*[bytes(65_536)] * 10))
        return endless if number else reply(200, b"never read", content_length="10000000000")

    async def check(store: HttpStore, host: Any) -> None:
        with pytest.raises(RangesUnsupported, match="10000000000 bytes"):
            await store.read(ByteRange(0, 65_536))
        with pytest.raises(RangesUnsupported, match="ignores Range"):
            await store.read(ByteRange(0, 65_536))

    script(answer, check)


@pytest.mark.parametrize(
    ("location", "asked"),
    [
        ("/moved.lpc", "http://host.test/moved.lpc"),
        ("moved.lpc", "http://host.test/moved.lpc"),
        ("https://host.test/model.lpc", "https://host.test/model.lpc"),
        ("http://elsewhere.test/model.lpc", None),
        ("http://host.test:81/model.lpc", None),
        ("ftp://host.test/model.lpc", None),
        ("http://[", None),
    ],
)
def test_redirects_stay_with_the_host(location: str, asked: str | None) -> None:
    def answer(number: int, request: httpx.Request) -> httpx.Response:
        return reply(302, location=location) if request.url == ADDRESS else honest(DATA, request)

    async def check(store: HttpStore, host: Any) -> None:
        if asked is None:
            with pytest.raises(StoreError, match="redirect"):
                await store.read(FIRST)
            assert len(host.requests) == 1
        else:
            assert await store.read(FIRST) == DATA[:10_000]
            assert await store.read(LATER) == DATA[50_000:90_000]
            assert [str(request.url) for request in host.requests] == [ADDRESS, asked, asked]

    script(answer, check)


def test_redirects_never_lead_back_to_plain_text_or_round_in_circles() -> None:
    async def down(store: HttpStore, host: Any) -> None:
        store._url = httpx.URL("https://host.test/model.lpc")
        with pytest.raises(StoreError, match="redirects to http:"):
            await store.read(FIRST)

    script(lambda _, request: reply(301, location="http://host.test/model.lpc"), down)

    async def round_(store: HttpStore, host: Any) -> None:
        with pytest.raises(StoreError, match="circles"):
            await store.read(FIRST)
        assert len(host.requests) <= 7

    script(lambda number, _: reply(307, location=f"/{number % 2}"), round_)


def test_connections_for_plain_text_are_not_used_after_a_change_to_tls() -> None:
    moved = False
    made: list[Script] = []

    def answer(number: int, request: httpx.Request) -> httpx.Response:
        if moved and request.url.scheme == "http":
            return reply(308, location="https://host.test/model.lpc")
        return honest(DATA, request)

    def transport() -> Script:
        made.append(Script(answer))
        return made[-1]

    async def run() -> None:
        nonlocal moved
        store = HttpStore(ADDRESS, clock=asyncio.get_running_loop().time, transports=transport)
        await asyncio.gather(*(store.read(FIRST) for _ in range(3)))
        plain, moved = len(made), True
        for _ in range(4):
            await asyncio.gather(*(store.read(LATER) for _ in range(3)))
        await store.close()
        assert plain >= 1
        for script in made[:plain]:
            assert all(request.url.scheme == "http" for request in script.requests)
        assert all(script.closed == 1 for script in made)

    virtual.run(run())


@pytest.mark.parametrize(("status", "error"), [(403, StoreError), (404, NotFound), (410, NotFound), (400, StoreError)])
def test_refusals_are_not_asked_again(status: int, error: type[LpcError]) -> None:
    async def check(store: HttpStore, host: Any) -> None:
        with pytest.raises(error):
            await store.read(FIRST)
        assert len(host.requests) == 1

    script(lambda *_: reply(status), check)


def test_retry_after_is_kept() -> None:
    async def check(store: HttpStore, host: Any) -> None:
        start = asyncio.get_running_loop().time()
        assert await store.read(FIRST) == DATA[:10_000]
        assert asyncio.get_running_loop().time() - start >= 17.0

    script(lambda n, request: honest(DATA, request) if n else reply(503, retry_after="17"), check)


def test_a_drip_is_cut_off() -> None:
    """One byte a second keeps every read time-out happy."""

    class Drip(httpx.AsyncByteStream):
        async def __aiter__(self) -> Any:
            for place in range(10_000):
                await asyncio.sleep(1.0)
                yield DATA[place : place + 1]

    def answer(number: int, request: httpx.Request) -> httpx.Response:
        right = honest(DATA, request)
        if number == 0:
            right.stream = Drip()
        return right

    async def check(store: HttpStore, host: Any) -> None:
        assert await store.read(FIRST) == DATA[:10_000]
        assert asyncio.get_running_loop().time() < 10.0

    script(answer, check)


def test_a_line_that_is_merely_slow_is_waited_for() -> None:
    """3 KB/s is below every prior and above what is given up."""
    from pointlink.profiles import parse_profile

    async def run() -> None:
        origin = origin_of(DATA)
        async with virtual_store(origin, parse_profile("24k,300ms")) as store:
            assert await store.read(ByteRange(0, 65_536)) == DATA[:65_536]
        assert len(origin.log) == 1

    virtual.run(run())


def test_idle_connections_that_died_are_replaced_at_once() -> None:
    async def run() -> None:
        origin = origin_of(DATA)
        origin.idle_timeout = 1.0
        async with virtual_store(origin, ADSL) as store:
            for _ in range(5):
                start = asyncio.get_running_loop().time()
                assert await store.read(FIRST) == DATA[:10_000]
                assert asyncio.get_running_loop().time() - start < 0.4, "it waited before asking again"
                await asyncio.sleep(3.0)

    virtual.run(run())


def test_a_host_that_is_not_there() -> None:
    async def run() -> None:
        store = HttpStore("http://127.0.0.1:9/x.lpc", clock=asyncio.get_running_loop().time, options=HASTY)
        with pytest.raises(Unavailable, match=r"127\.0\.0\.1:9/x\.lpc: gave up after 4 tries"):
            await store.read(FIRST)
        await store.close()

    asyncio.run(run())


def test_pythons_own_server_ignores_ranges(tmp_path: Path) -> None:
    (tmp_path / "small").write_bytes(DATA[:50_000])
    (tmp_path / "large").write_bytes(DATA * 2)

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args, directory=str(tmp_path))

        def log_message(self, *args: Any) -> None:
            pass

    async def run(port: int) -> None:
        clock = asyncio.get_running_loop().time
        small = HttpStore(f"http://127.0.0.1:{port}/small", clock=clock, options=HttpOptions(lanes=1))
        assert await small.read(ByteRange(0, 65_536)) == DATA[:50_000]
        await small.close()
        large = HttpStore(f"http://127.0.0.1:{port}/large", clock=clock)
        with pytest.raises(RangesUnsupported):
            await large.read(ByteRange(0, 65_536))
        await large.close()

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            asyncio.run(run(server.server_port))
        finally:
            server.shutdown()
            thread.join()
