"""The front over real sockets: every byte, in order, to the right connection; ends and failures pass through."""

from __future__ import annotations

import asyncio
import contextlib
import random
import shutil
import socket
import ssl
import struct
import subprocess
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import TYPE_CHECKING

import pytest

from lpc.errors import Unavailable
from pointlink.front import Front, Upstream, check_upstream, parse_upstream, serve_front
from pointlink.origin import Origin, serve_origin
from pointlink.profiles import Profile
from pointlink.resources import Resource

if TYPE_CHECKING:
    from pathlib import Path

QUICK = Profile(down_rate=400e6, up_rate=400e6, rtt=0.002, queue=32 * 1024)
Handler = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@contextlib.asynccontextmanager
async def front_of(handler: Handler, scheme: str = "tcp", profile: Profile = QUICK) -> AsyncIterator[Front]:
    server = await asyncio.start_server(handler, "127.0.0.1", 0)
    upstream = Upstream(scheme=scheme, host="127.0.0.1", port=server.sockets[0].getsockname()[1], path="/")
    async with server, await serve_front(upstream, profile) as front:
        yield front


async def connect(front: Front) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    upstream = parse_upstream(front.url)
    return await asyncio.open_connection(upstream.host, upstream.port)


async def hang_up(writer: asyncio.StreamWriter) -> None:
    writer.close()
    with contextlib.suppress(ConnectionError):
        await writer.wait_closed()


async def test_large_exchanges_pass_identical_on_several_connections_at_once() -> None:
    async def echo_reversed(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        data = await reader.read()
        writer.write(data[::-1])
        await writer.drain()
        await hang_up(writer)

    async def exchange(front: Front, seed: int) -> None:
        data = random.Random(seed).randbytes(700_000 + seed)
        reader, writer = await connect(front)
        writer.write(data)
        writer.write_eof()  # the answer comes only after this half of the connection has ended
        assert await reader.read() == data[::-1]
        await hang_up(writer)

    async with front_of(echo_reversed) as front:
        await asyncio.gather(*(exchange(front, seed) for seed in range(4)))


async def test_a_reset_by_the_server_is_a_reset_for_the_client() -> None:
    async def reset(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readexactly(4)
        linger_not = struct.pack("ii", 1, 0)
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger_not)
        writer.transport.abort()

    async with front_of(reset) as front:
        reader, writer = await connect(front)
        writer.write(b"ask, and more that nobody reads")
        with pytest.raises(ConnectionResetError):
            await reader.readexactly(1)
        await hang_up(writer)


async def test_a_client_that_goes_away_is_noticed_by_the_server_and_frees_the_link() -> None:
    noticed = asyncio.Event()

    async def endless(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while True:
                writer.write(bytes(4096))
                await writer.drain()
        except ConnectionError:
            noticed.set()
        await hang_up(writer)

    slow = Profile(down_rate=100e3, up_rate=400e6, rtt=0.002, queue=32 * 1024)
    async with front_of(endless, profile=slow) as front:
        reader, writer = await connect(front)
        await reader.readexactly(1)
        assert front.line.down.link.next_room is not None
        writer.transport.abort()
        await noticed.wait()
        # What is in the queue takes seconds more; what stood before it is gone.
        assert front.line.down.link.next_room is None


async def test_a_client_that_does_not_read_holds_the_server_back() -> None:
    sent = 0
    stuck = asyncio.Event()

    async def endless(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal sent
        with contextlib.suppress(ConnectionError):
            while True:
                writer.write(bytes(65536))
                await asyncio.wait_for(writer.drain(), 0.5)
                sent += 65536
        await hang_up(writer)

    async def watched(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(TimeoutError):
            await endless(reader, writer)
        stuck.set()

    async with front_of(watched) as front:
        _, writer = await connect(front)
        await stuck.wait()
        writer.transport.abort()
    assert 0 < sent < 64 * 1024 * 1024


async def test_the_server_hears_its_own_name_and_gets_bodies_unchanged() -> None:
    heads: list[bytes] = []

    async def record(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for _ in range(2):
            heads.append(await reader.readuntil(b"\r\n\r\n"))
            assert await reader.readexactly(5) == b"Host:"
            writer.write(b"HTTP/1.1 204 No Content\r\n\r\n")
        await hang_up(writer)

    async with front_of(record, scheme="http") as front:
        reader, writer = await connect(front)
        writer.write(b"POST /x HTTP/1.1\r\nHost: wrong\r\nContent-Length: 5\r\n\r\nHost:" * 2)
        assert (await reader.read()).count(b"204") == 2
        await hang_up(writer)
    own = f"Host: {front.upstream.authority}\r\n".encode()
    assert all(own in head and b"wrong" not in head for head in heads)


async def test_half_a_head_is_not_lost_when_the_client_stops() -> None:
    got: list[bytes] = []

    async def record(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        got.append(await reader.read())
        await hang_up(writer)

    async with front_of(record, scheme="http") as front:
        reader, writer = await connect(front)
        writer.write(b"GET /never/ended HTT")
        writer.write_eof()
        assert await reader.read() == b""
        await hang_up(writer)
    assert got == [b"GET /never/ended HTT"]


async def test_connecting_costs_a_round_trip_and_asking_another() -> None:
    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(await reader.readexactly(1))
        await hang_up(writer)

    async with front_of(echo) as front:
        loop = asyncio.get_running_loop()
        began = loop.time()
        reader, writer = await connect(front)
        writer.write(b"x")
        await reader.readexactly(1)
        # Not earlier is certain on any machine; how much later is benchmarks/link.py's to measure.
        assert loop.time() - began >= 2 * QUICK.rtt - 1e-6
        await hang_up(writer)


async def test_ranges_of_a_real_origin_come_through() -> None:
    body = random.Random(5).randbytes(300_000)
    server = await serve_origin(Origin(resources={"/m.lpc": Resource.from_bytes(body)}))
    upstream = Upstream(scheme="http", host="127.0.0.1", port=server.sockets[0].getsockname()[1], path="/m.lpc")
    async with server, await serve_front(upstream, QUICK) as front:
        assert front.url.endswith("/m.lpc")
        reader, writer = await connect(front)
        for start, stop in [(0, 65536), (299_999, 300_000), (1000, 200_000)]:
            writer.write(f"GET /m.lpc HTTP/1.1\r\nHost: x\r\nRange: bytes={start}-{stop - 1}\r\n\r\n".encode())
            head = await reader.readuntil(b"\r\n\r\n")
            assert head.startswith(b"HTTP/1.1 206")
            assert await reader.readexactly(stop - start) == body[start:stop]
        await hang_up(writer)
    assert front.line.down.link.carried > 264_000


async def test_an_encrypted_upstream_is_spoken_to_in_its_own_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("no openssl command to make a certificate with")
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    make = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj /CN=localhost"
    names = ["-addext", "subjectAltName=DNS:localhost", "-keyout", key, "-out", certificate]
    subprocess.run([*make.split(), *names], check=True, capture_output=True)  # noqa: ASYNC221
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    body = random.Random(6).randbytes(150_000)
    hosts: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # One connection comes only to see whether somebody listens, and asks nothing.
        with contextlib.suppress(asyncio.IncompleteReadError):
            hosts.append(await reader.readuntil(b"\r\n\r\n"))
            writer.write(body)
            await writer.drain()
        await hang_up(writer)

    server = await asyncio.start_server(serve, "127.0.0.1", 0, ssl=context)
    port = server.sockets[0].getsockname()[1]
    upstream = parse_upstream(f"https://localhost:{port}/")
    async with server:
        with pytest.raises(Unavailable, match="self-signed certificate"):
            await check_upstream(upstream)
        async with await serve_front(upstream, QUICK) as front:
            reader, writer = await connect(front)
            writer.write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            with pytest.raises(ConnectionResetError):
                await reader.read()
            await hang_up(writer)
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        await check_upstream(upstream)
        async with await serve_front(upstream, QUICK) as front:
            reader, writer = await connect(front)
            writer.write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert await reader.read() == body
            await hang_up(writer)
    assert len(hosts) == 1
    assert f"Host: localhost:{port}\r\n".encode() in hosts[0]


async def test_nobody_upstream_is_said_at_once_and_resets_clients() -> None:
    server = await asyncio.start_server(lambda r, w: None, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    server.close()
    await server.wait_closed()
    upstream = Upstream(scheme="http", host="127.0.0.1", port=port, path="")
    with pytest.raises(Unavailable, match=f"cannot connect to 127.0.0.1:{port}"):
        await check_upstream(upstream)
    async with await serve_front(upstream, QUICK) as front:
        reader, writer = await connect(front)
        with pytest.raises(ConnectionResetError):
            await reader.readexactly(1)
        await hang_up(writer)


async def test_a_port_in_use_is_said() -> None:
    server = await asyncio.start_server(lambda r, w: None, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with server:
        with pytest.raises(Unavailable, match=f"cannot listen on 127.0.0.1:{port}"):
            await serve_front(parse_upstream("http://127.0.0.1:1/"), QUICK, port=port)


@pytest.mark.parametrize(
    ("text", "scheme", "host", "port", "path", "authority"),
    [
        ("http://127.0.0.1:8080", "http", "127.0.0.1", 8080, "", "127.0.0.1:8080"),
        ("127.0.0.1:8080/a.lpc", "http", "127.0.0.1", 8080, "/a.lpc", "127.0.0.1:8080"),
        ("https://models.example/x?y", "https", "models.example", 443, "/x?y", "models.example"),
        ("http://[::1]:81/", "http", "::1", 81, "/", "[::1]:81"),
        ("tcp://host:5", "tcp", "host", 5, "", "host:5"),
    ],
)
def test_upstream_addresses(text: str, scheme: str, host: str, port: int, path: str, authority: str) -> None:
    upstream = parse_upstream(text)
    assert upstream == Upstream(scheme=scheme, host=host, port=port, path=path)
    assert upstream.authority == authority


@pytest.mark.parametrize("text", ["", "ftp://host/", "http://", "http://host:99999", "tcp://host", "http://[::1"])
def test_what_is_no_address_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ValueError, match="is no server address") as refused:
        parse_upstream(text)
    assert "\n" not in str(refused.value)
