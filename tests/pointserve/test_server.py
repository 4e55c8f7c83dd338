"""The server over real sockets: every byte right, every connection usable or closed, whatever happens to the file."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import re
import socket
from collections.abc import Callable, Iterator
from email.parser import BytesParser
from pathlib import Path

import numpy as np
import pytest
import uvloop
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.rawhttp import RawConnection, ask_once
from support.servers import serve_in_loop, serve_in_thread
from support.shelf import make_model

from pointserve.listener import Connection
from pointserve.preconditions import http_date
from pointserve.ranges import MAX_OVERHEAD, FileFacts, judge

WriteModel = Callable[..., bytes]
LOOPS = pytest.mark.parametrize("loop_factory", [asyncio.SelectorEventLoop, uvloop.new_event_loop])


@pytest.fixture(scope="module", params=[asyncio.SelectorEventLoop, uvloop.new_event_loop], ids=["asyncio", "uvloop"])
def shelf(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[str, bytes, bytes]]:
    """A served model, and a smaller one that tells whether a connection is still in step."""
    folder = tmp_path_factory.mktemp("shelf")
    large, small = make_model(folder / "large.lpc", 700_000), make_model(folder / "small.lpc", 2000)
    with serve_in_thread(folder, recheck=3600, loop_factory=request.param) as url:
        yield url, large, small


places = st.one_of(st.integers(0, 9), st.integers(0, 700_100), st.integers(699_990, 700_010), st.just(2**64))
specs = st.one_of(
    st.tuples(places, places).map(lambda pair: f"{min(pair)}-{max(pair)}"),
    places.map("{}-".format),
    places.map("-{}".format),
    st.sampled_from(["9-3", "x", "", "0-0"]),
)
ETAG = "<etag>"
requests = st.fixed_dictionaries(
    {"Range": st.lists(specs, min_size=1, max_size=6).map(lambda texts: "bytes=" + ",".join(texts))},
    optional={
        "If-Range": st.sampled_from([ETAG, '"other"', f"W/{ETAG}", "nonsense"]),
        "If-Match": st.sampled_from([ETAG, '"other"', "*", f'"other", {ETAG}']),
        "If-None-Match": st.sampled_from([ETAG, '"other"', f"W/{ETAG}"]),
        "If-Modified-Since": st.sampled_from([http_date(0), http_date(4_000_000_000), "?"]),
        "Accept-Encoding": st.sampled_from(["gzip", "gzip;q=0", "identity;q=0", "br, *"]),
    },
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(fields=requests, method=st.sampled_from(["GET", "GET", "HEAD", "POST"]))
def test_reply_is_the_verdict_and_the_connection_stays_in_step(
    shelf: tuple[str, bytes, bytes], fields: dict[str, str], method: str
) -> None:
    url, large, small = shelf

    async def run() -> None:
        async with RawConnection(url) as connection:
            head = await connection.ask("/large.lpc", method="HEAD")
            etag = head.headers["etag"]
            sent = {name: value.replace(ETAG, etag) for name, value in fields.items()}
            reply = await connection.ask(
                "/large.lpc", *(f"{name}: {value}" for name, value in sent.items()), method=method
            )
            facts = FileFacts(length=len(large), etag=etag, modified=1)
            verdict = judge(method, sent.get, facts, now=2e9)
            assert reply.status == verdict.status
            assert "content-encoding" not in reply.headers
            for name, value in verdict.headers:
                if name != "Last-Modified":
                    assert reply.headers[name.lower()] == value
            if verdict.length is not None:
                assert int(reply.headers["content-length"]) == verdict.length
                wanted = b"".join(part.head + large[part.start : part.stop] for part in verdict.parts) + verdict.tail
                assert reply.body == (wanted if method == "GET" else b"")
                assert len(reply.body) <= len(large) + MAX_OVERHEAD
            assert not reply.closes
            assert (await connection.ask("/small.lpc")).body == small

    asyncio.run(run())


async def test_multipart_is_read_by_another_parser(models: Path, model: WriteModel) -> None:
    data = model()
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        reply = await connection.ask("/david.lpc", "Range: bytes=100-199,-50,0-9")
    message = BytesParser().parsebytes(f"Content-Type: {reply.headers['content-type']}\r\n\r\n".encode() + reply.body)
    parts = [(part["Content-Range"], part.get_payload(decode=True)) for part in message.get_payload()]
    assert parts == [
        ("bytes 100-199/10000", data[100:200]),
        ("bytes 9950-9999/10000", data[9950:]),
        ("bytes 0-9/10000", data[:10]),
    ]


async def test_many_connections_each_get_their_own_bytes(models: Path, model: WriteModel) -> None:
    data = model(size=3_000_000)
    chance = random.Random(1)
    async with serve_in_loop(models, recheck=0.01) as url:

        async def visitor() -> None:
            async with RawConnection(url) as connection:
                for _ in range(25):
                    start = chance.randrange(len(data))
                    size = chance.choice([1, 1000, 65_536, 262_144, 262_145, 900_000])
                    reply = await connection.ask("/david.lpc", f"Range: bytes={start}-{start + size - 1}")
                    assert reply.status == 206
                    assert reply.body == data[start : start + size]

        await asyncio.gather(*(visitor() for _ in range(8)))


async def test_pipelined_requests_are_answered_in_order(models: Path, model: WriteModel) -> None:
    data = model(size=600_000)
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        wanted = [(0, 10), (5, 400_000), (599_999, 600_000), (100, 300_100)]
        for start, stop in wanted:
            connection.writer.write(
                f"GET /david.lpc HTTP/1.1\r\nHost: t\r\nRange: bytes={start}-{stop - 1}\r\n\r\n".encode()
            )
        for start, stop in wanted:
            assert (await connection.read()).body == data[start:stop]


async def test_five_gigabytes(models: Path) -> None:
    length = 5 << 30
    places = [0, 2**31 - 1, 2**31, 2**32 - 1, 2**32, length - 4]
    with (models / "huge.lpc").open("wb") as file:
        file.truncate(length)
        for number, place in enumerate(places):
            file.seek(place)
            file.write(bytes([number + 1]))
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        assert (await connection.ask("/huge.lpc", method="HEAD")).headers["content-length"] == str(length)
        for number, place in enumerate(places):
            reply = await connection.ask("/huge.lpc", f"Range: bytes={place}-{place}")
            assert reply.headers["content-range"] == f"bytes {place}-{place}/{length}"
            assert reply.body == bytes([number + 1])
        across = await connection.ask("/huge.lpc", f"Range: bytes={2**32 - 300_000}-{2**32 + 299_999}")
        assert across.body == bytes(299_999) + b"\4\5" + bytes(299_999)
        assert (await connection.ask("/huge.lpc", "Range: bytes=-4")).body == b"\6\0\0\0"


async def test_files_of_no_and_of_one_byte(models: Path) -> None:
    (models / "none.lpc").write_bytes(b"")
    (models / "one.lpc").write_bytes(b"1")
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        for name, wanted, status, body, content_range in (
            ("none", None, 200, b"", None),
            ("none", "bytes=0-", 416, None, "bytes */0"),
            ("none", "bytes=-5", 200, b"", None),
            ("one", "bytes=0-", 206, b"1", "bytes 0-0/1"),
            ("one", "bytes=-9", 206, b"1", "bytes 0-0/1"),
            ("one", "bytes=-0", 416, None, "bytes */1"),
            ("one", "bytes=0-0,0-0", 206, b"1", "bytes 0-0/1"),
        ):
            reply = await connection.ask(f"/{name}.lpc", *([f"Range: {wanted}"] if wanted else []))
            assert (reply.status, reply.headers.get("content-range")) == (status, content_range)
            assert body is None or reply.body == body


async def slow_connection(url: str, target: str, *, behind: str | None = None) -> RawConnection:
    """Ask, read only the head, and leave the rest where it is: small buffers keep nearly all of it at the server."""
    connection = RawConnection(url)
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65_536)
    sock.setblocking(False)
    await asyncio.get_running_loop().sock_connect(sock, (connection.host, connection.port))
    connection.reader, connection.writer = await asyncio.open_connection(sock=sock, limit=4096)
    for path in filter(None, (target, behind)):
        connection.writer.write(f"GET {path} HTTP/1.1\r\nHost: t\r\n\r\n".encode())
    return connection


@LOOPS
def test_a_replaced_model_stays_whole_for_its_readers(
    models: Path, model: WriteModel, loop_factory: Callable[[], asyncio.AbstractEventLoop]
) -> None:
    old = model(size=16_000_000, seed=1)
    small = model("small.lpc", size=3000)

    async def run(url: str) -> None:
        reading = await slow_connection(url, "/david.lpc", behind="/small.lpc")
        status, headers = await reading.read_head()
        assert (status, headers["content-length"]) == (200, "16000000")
        new = make_model(models / "new", size=16_000_000, seed=2)
        (models / "new").rename(models / "david.lpc")
        async with RawConnection(url) as other:
            reply = await other.ask("/david.lpc", "Range: bytes=0-99999")
            assert reply.body == new[:100_000]
            assert reply.headers["etag"] != headers["etag"]
            assert (await other.ask("/david.lpc", f"If-Match: {headers['etag']}")).status == 412
        assert await reading.reader.readexactly(len(old)) == old
        assert (await reading.read()).body == small
        reading.writer.close()

    with serve_in_thread(models, loop_factory=loop_factory) as url:
        asyncio.run(run(url))


@LOOPS
def test_a_model_cut_short_while_being_sent_ends_the_connection(
    models: Path, model: WriteModel, loop_factory: Callable[[], asyncio.AbstractEventLoop]
) -> None:
    data = model(size=32_000_000)
    model("small.lpc", size=3000)

    async def run(url: str) -> None:
        reading = await slow_connection(url, "/david.lpc", behind="/small.lpc")
        await reading.read_head()
        os.truncate(models / "david.lpc", 1_000_000)
        got = b""
        try:
            while piece := await asyncio.wait_for(reading.reader.read(1 << 16), 10):
                got += piece
        except ConnectionError:
            pass
        assert len(got) < len(data)
        kept = min(len(got), 1_000_000)
        assert got[:kept] == data[:kept]
        # What sendfile has under way is the file's own pages, which the cut clears; copies stay as they were.
        differs = np.frombuffer(got, np.uint8) != np.frombuffer(data, np.uint8, len(got))
        assert not np.frombuffer(got, np.uint8)[differs].any(), "nothing but the file's bytes, and no reply inside them"
        assert loop_factory is asyncio.SelectorEventLoop or not differs.any()
        reading.writer.close()
        async with RawConnection(url) as other:
            assert (await other.ask("/david.lpc", method="HEAD")).headers["content-length"] == "1000000"

    with serve_in_thread(models, loop_factory=loop_factory) as url:
        asyncio.run(run(url))


async def test_a_model_cut_short_before_a_small_reply_is_judged_anew(models: Path, model: WriteModel) -> None:
    data = model()
    async with serve_in_loop(models, recheck=3600) as url, RawConnection(url) as connection:
        before = await connection.ask("/david.lpc", "Range: bytes=5000-5999")
        assert before.body == data[5000:6000]
        os.truncate(models / "david.lpc", 5500)
        after = await connection.ask("/david.lpc", "Range: bytes=5000-5999")
        assert after.headers["content-range"] == "bytes 5000-5499/5500"
        assert after.body == data[5000:5500]
        assert after.headers["etag"] != before.headers["etag"]
        assert (await connection.ask("/david.lpc", "Range: bytes=5500-")).status == 416


async def test_a_reader_that_takes_nothing_is_cut_off(models: Path, model: WriteModel) -> None:
    model(size=32_000_000)
    async with serve_in_loop(models, patience=0.05, slowest=1e9) as url, RawConnection(url) as other:
        reading = await slow_connection(url, "/david.lpc")
        await reading.read_head()
        (models / "david.lpc").unlink()
        assert (await other.ask("/david.lpc")).status == 404  # from now on only the stalled reply holds the file open
        await until(lambda: not open_descriptors(models))
        reading.writer.close()


async def until(true: Callable[[], bool]) -> None:
    """Wait for something that has to happen; a test that waits in vain fails after ten seconds."""
    async with asyncio.timeout(10):
        while not true():  # noqa: ASYNC110 - nothing announces it
            await asyncio.sleep(0.01)


def open_descriptors(folder: Path) -> list[str]:
    """What this process holds open below a folder."""
    found = []
    for number in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            found.append(str(number.readlink()))
    return [name for name in found if name.startswith(f"{folder}/")]


async def test_descriptors_follow_the_models(models: Path, model: WriteModel) -> None:
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        for seed in range(20):
            data = make_model(models / "next", seed=seed)
            (models / "next").rename(models / "david.lpc")
            assert (await connection.ask("/david.lpc", "Range: bytes=0-999")).body == data[:1000]
            assert len(open_descriptors(models)) == 1
        (models / "david.lpc").unlink()
        assert (await connection.ask("/david.lpc")).status == 404
        assert open_descriptors(models) == []
        model()
        assert (await connection.ask("/david.lpc")).status == 200
    assert open_descriptors(models) == []


async def test_equal_size_and_time_do_not_make_equal_tags(models: Path, model: WriteModel) -> None:
    tags = set()
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        for seed in range(2):
            make_model(models / "next", seed=seed)
            os.utime(models / "next", (1e9, 1e9))
            (models / "next").rename(models / "david.lpc")
            reply = await connection.ask("/david.lpc", method="HEAD")
            assert reply.headers["last-modified"] == http_date(1_000_000_000)
            tags.add(reply.headers["etag"])
    assert len(tags) == 2
    assert all(re.fullmatch(r'"[0-9a-f]{32}-2710"', tag) for tag in tags)


async def test_small_things_of_http(models: Path, model: WriteModel) -> None:
    data = model()
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        twice = await connection.ask("/david.lpc", "Range: bytes=0-1", "Range: bytes=5-6")
        assert (twice.status, twice.body) == (200, data), "two Range lines are no Range"
        either = await connection.ask("/david.lpc", 'If-None-Match: "x"', f"If-None-Match: {twice.headers['etag']}")
        assert either.status == 304
        posted = await connection.ask("/david.lpc", method="POST", body=b"x" * 5000)
        assert posted.status == 405
        query = await connection.ask("/david.lpc?v=1", "Range: bytes=1-2")
        assert query.body == data[1:3]
        absolute = await connection.ask(f"{url}/david.lpc", "Range: bytes=1-2")
        assert absolute.body == data[1:3]
        assert (await connection.ask("/david.lpc", method="OPTIONS")).headers["allow"] == "GET, HEAD, OPTIONS"
        last = await connection.ask("/david.lpc", "Connection: close", "Range: bytes=1-2")
        assert last.body == data[1:3]
        assert await connection.at_end()


@pytest.mark.parametrize(
    "request_bytes",
    [
        b"nonsense\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nContent-Length: -1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nContent-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\nHost: a\r\n\r\n",
    ],
)
async def test_what_is_not_http_is_refused_without_naming_the_software(models: Path, request_bytes: bytes) -> None:
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        connection.writer.write(request_bytes)
        reply = await connection.read()
        assert reply.status == 400
        assert reply.headers["server"] == "pointstream"
        assert reply.body.count(b"\n") == 1
        assert await connection.at_end()


async def test_no_reply_names_versions(models: Path, model: WriteModel) -> None:
    model()
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        for target in ("/", "/catalogue.json", "/healthz", "/david.lpc", "/nothing", "/nothing.lpc"):
            for method in ("GET", "HEAD", "POST", "OPTIONS"):
                reply = await connection.ask(target, method=method)
                assert reply.headers["server"] == "pointstream"
                assert not re.search(rb"aiohttp|Python", reply.body)


async def test_nothing_else_answers_across_origins_unless_told(models: Path, model: WriteModel) -> None:
    model()
    page = "Origin: https://maps.example"
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        for method in ("GET", "OPTIONS"):
            reply = await connection.ask("/david.lpc", page, method=method)
            assert not [name for name in reply.headers if name.startswith("access-control")]
    async with serve_in_loop(models, cors=("https://maps.example",)) as url, RawConnection(url) as connection:
        reply = await connection.ask("/david.lpc", page, "Range: bytes=0-0")
        assert reply.headers["access-control-allow-origin"] == "https://maps.example"
        assert {"Content-Range", "ETag"} <= set(reply.headers["access-control-expose-headers"].split(", "))
        assert reply.headers["vary"] == "Origin"
        preflight = await connection.ask("/david.lpc", page, "Access-Control-Request-Headers: range", method="OPTIONS")
        assert preflight.status == 204
        assert "Range" in preflight.headers["access-control-allow-headers"]
        foreign = await connection.ask("/david.lpc", "Origin: https://evil.example")
        assert "access-control-allow-origin" not in foreign.headers
        assert foreign.headers["vary"] == "Origin"
    async with serve_in_loop(models, cors=("*",)) as url, RawConnection(url) as connection:
        assert (await connection.ask("/nothing", page)).headers["access-control-allow-origin"] == "*"


@pytest.mark.parametrize("limits", [{"connections": 3}, {"per_address": 3}])
async def test_one_connection_too_many_is_sent_away_and_its_place_given_on(
    models: Path, model: WriteModel, limits: dict[str, int]
) -> None:
    data = model()
    async with serve_in_loop(models, **limits) as url, contextlib.AsyncExitStack() as inside:
        guests = [await inside.enter_async_context(RawConnection(url)) for _ in range(3)]
        for guest in guests:
            assert (await guest.ask("/david.lpc")).body == data
        async with RawConnection(url) as refused:
            reply = await refused.read()
            assert (reply.status, reply.closes) == (503, True)
            assert await refused.at_end()
        assert (await guests[0].ask("/david.lpc")).body == data
        assert (await guests[2].ask("/david.lpc", "Connection: close")).closes
        assert await guests[2].at_end()
        assert (await ask_once(url, "/david.lpc")).body == data


async def test_no_connection_waits_for_more_than_it_sends(models: Path, model: WriteModel) -> None:
    model()
    async with serve_in_loop(models, idle=0.2) as url, RawConnection(url) as half, RawConnection(url) as idle:
        half.writer.write(b"GET /david.lpc HTTP/1.1\r\nHos")
        assert (await idle.ask("/healthz")).status == 200
        assert await half.at_end()
        assert await idle.at_end()


async def test_replies_are_not_held_back_for_more_bytes(models: Path) -> None:
    made: list[asyncio.BaseTransport] = []

    class Seen(Connection):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            made.append(transport)
            super().connection_made(transport)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pointserve.listener.Connection", Seen)
        async with serve_in_loop(models) as url:
            assert (await ask_once(url, "/healthz")).status == 200
            async with RawConnection(url) as connection:
                await connection.ask("/healthz")
                sock = made[-1].get_extra_info("socket")
                assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
