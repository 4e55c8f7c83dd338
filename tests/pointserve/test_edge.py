"""The edge of docker-compose.yml: the very nginx.conf of the tree, run by a real nginx before our server."""

from __future__ import annotations

import asyncio
import random
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest
from support.rawhttp import RawConnection, ask_once
from support.servers import REPOSITORY, serve_in_thread
from support.shelf import make_model

from pointserve.guard import Guard, sign_address

if TYPE_CHECKING:
    from pathlib import Path

WriteModel = Callable[..., bytes]
NGINX = shutil.which("nginx", path="/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin:/opt/homebrew/bin")
CONFIGURATION = REPOSITORY / "server" / "nginx.conf"

pytestmark = pytest.mark.skipif(NGINX is None, reason="nginx is not installed")


@contextmanager
def edge_before(origin: str, folder: Path) -> Iterator[str]:
    """Run nginx with only addresses and folders of its configuration changed; gives its URL."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    text = CONFIGURATION.read_text()
    for old, new in (
        ("server server:8080;", f"server {origin.removeprefix('http://')};"),
        ("listen 8080;", f"listen 127.0.0.1:{port};"),
        ("/var/cache/nginx/", f"{folder}/cache/"),
        ("/tmp/nginx.pid", f"{folder}/nginx.pid"),
        ("/dev/stdout", f"{folder}/access.log"),
        ("worker_processes auto;", "worker_processes 1;\ndaemon off;\nmaster_process off;"),
    ):
        assert old in text, f"nginx.conf no longer says {old}"
        text = text.replace(old, new)
    (folder / "cache").mkdir(parents=True)
    (folder / "nginx.conf").write_text(text)
    with subprocess.Popen(
        [str(NGINX), "-p", str(folder), "-c", str(folder / "nginx.conf"), "-e", "stderr"],
        stderr=subprocess.PIPE, text=True,
    ) as nginx:  # fmt: skip
        try:
            _wait_for(port, nginx)
            yield f"http://127.0.0.1:{port}"
        finally:
            nginx.terminate()
            nginx.communicate()


def _wait_for(port: int, nginx: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 10
    while nginx.poll() is None and time.monotonic() < deadline:
        with socket.socket() as sock:
            if sock.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.01)
    nginx.kill()
    raise RuntimeError(f"nginx did not start: {nginx.communicate()[1]}")


def test_ranges_through_the_edge(tmp_path: Path, models: Path, model: WriteModel) -> None:
    data = model(size=1_500_000)
    chance = random.Random(3)

    async def run(origin: str, edge: str) -> None:
        async with RawConnection(edge) as connection, RawConnection(origin) as direct:
            tag = (await direct.ask("/david.lpc", method="HEAD")).headers["etag"]
            first = await connection.ask("/david.lpc", "Range: bytes=0-65535", "Accept-Encoding: gzip")
            again = await connection.ask("/david.lpc", "Range: bytes=1000-66000", "Accept-Encoding: gzip")
            assert (first.status, first.headers["x-cache"], again.headers["x-cache"]) == (206, "MISS", "HIT")
            assert first.body == data[:65_536]
            assert again.body == data[1000:66_001]
            for reply in (first, again):
                assert reply.headers["etag"] == tag
                assert "content-encoding" not in reply.headers
            assert again.headers["content-range"] == "bytes 1000-66000/1500000"
            for _ in range(60):
                start = chance.randrange(len(data))
                size = chance.choice([1, 5000, 65_536, 400_000, 2_000_000])
                reply = await connection.ask(
                    "/david.lpc", f"Range: bytes={start}-{start + size - 1}", f"If-Match: {tag}"
                )
                assert reply.status == 206
                assert reply.headers["content-range"] == f"bytes {start}-{min(start + size, len(data)) - 1}/{len(data)}"
                assert reply.body == data[start : start + size]
            assert (await connection.ask("/david.lpc")).body == data
            head = await connection.ask("/david.lpc", method="HEAD")
            assert (head.status, head.headers["content-length"]) == (200, "1500000")
            assert (await connection.ask("/david.lpc", "Range: bytes=-10")).body == data[-10:]
        assert (await ask_once(edge, "/david.lpc", "Range: bytes=1500000-")).status == 416
        assert (await ask_once(edge, "/david.lpc", f"If-None-Match: {tag}")).status == 304
        assert (await ask_once(edge, "/david.lpc", 'If-Match: "other"')).status == 412
        assert (await ask_once(edge, "/nothing.lpc")).status == 404
        assert (await ask_once(edge, "/%2e%2e/david.lpc")).status in (400, 404)
        assert b"david.lpc" in (await ask_once(edge, "/catalogue.json")).body
        assert b"pointstream view http://test/david.lpc" in (await ask_once(edge, "/")).body, "the visitor's own host"

    with serve_in_thread(models) as origin, edge_before(origin, tmp_path / "edge") as edge:
        asyncio.run(run(origin, edge))


def test_the_edge_never_joins_two_builds(tmp_path: Path, models: Path, model: WriteModel) -> None:
    old = model(size=1_500_000, seed=1)

    async def run(edge: str) -> None:
        first = await ask_once(edge, "/david.lpc", "Range: bytes=0-9999")
        assert first.body == old[:10_000]
        new = make_model(models / "next", size=1_500_000, seed=2)
        (models / "next").rename(models / "david.lpc")
        # nginx 1.22 drops a connection after its own 412, whatever it says about keeping it: one connection each.
        # The visitor that knows the old build is told; one that knows the new build gets it whole.
        pinned = await ask_once(edge, "/david.lpc", "Range: bytes=600000-700000", f"If-Match: {first.headers['etag']}")
        assert pinned.status == 412
        tag = first.headers["etag"].replace(first.headers["etag"][1:33], _digest(new))
        fresh = await ask_once(edge, "/david.lpc", "Range: bytes=0-799999", f"If-Match: {tag}")
        assert fresh.status == 206
        assert fresh.body == new[:800_000]
        async with RawConnection(
            edge
        ) as connection:  # names no build, over slices kept of the old and not yet of the new
            try:
                mixed = await connection.ask("/david.lpc", "Range: bytes=0-799999")
            except (ConnectionError, asyncio.IncompleteReadError) as error:
                got = error.partial if isinstance(error, asyncio.IncompleteReadError) else b""
                assert got in (old[: len(got)], b"")
            else:
                assert mixed.body in (old[:800_000], new[:800_000])

    with serve_in_thread(models, max_age=3600) as origin, edge_before(origin, tmp_path / "edge") as edge:
        asyncio.run(run(edge))


def test_the_edge_outlives_the_server(tmp_path: Path, models: Path, model: WriteModel) -> None:
    shelf = {name: model(name, size=300_000, seed=seed) for seed, name in enumerate(("david.lpc", "dawn.lpc"))}

    async def ask(edge: str, name: str, until: set[str]) -> None:
        async with asyncio.timeout(20), RawConnection(edge) as connection:
            state = None
            while state not in until:
                reply = await connection.ask(f"/{name}", "Range: bytes=100-999")
                assert reply.body == shelf[name][100:1000]
                state = reply.headers["x-cache"]
                await asyncio.sleep(0.05)

    with ExitStack() as server_side, ExitStack() as edge_side:
        origin = server_side.enter_context(serve_in_thread(models, max_age=1))
        edge = edge_side.enter_context(edge_before(origin, tmp_path / "edge"))
        asyncio.run(ask(edge, "dawn.lpc", {"MISS"}))
        asyncio.run(ask(edge, "david.lpc", {"REVALIDATED"}))  # an old slice is asked for by its tag, and stays
        server_side.close()
        asyncio.run(ask(edge, "dawn.lpc", {"STALE"}))  # nobody to ask: better an old slice than none


def test_the_edge_keeps_nothing_that_only_some_may_read(tmp_path: Path, models: Path, model: WriteModel) -> None:
    data = model(size=300_000)
    token, key = b"a token of some length", b"a key of some length too"

    async def run(origin: str, edge: str) -> None:
        query = urlsplit(sign_address(f"{origin}/david.lpc", key, 4_000_000_000)).query
        for target, *lines in (
            ("/david.lpc", f"Authorization: Bearer {token.decode()}"),
            (f"/david.lpc?{query}",),
        ):
            reply = await ask_once(edge, target, *lines, "Range: bytes=0-999")
            assert reply.body == data[:1000]
            assert (await ask_once(edge, "/david.lpc", "Range: bytes=0-999")).status == 401
        assert (await ask_once(edge, "/metrics", f"Authorization: Bearer {token.decode()}")).status == 404

    with (
        serve_in_thread(models, guard=Guard(tokens=(token,), key=key)) as origin,
        edge_before(origin, tmp_path / "edge") as edge,
    ):
        asyncio.run(run(origin, edge))
    log = (tmp_path / "edge" / "access.log").read_text()
    assert '"/david.lpc" 206 1000 range="bytes=0-999"' in log
    assert "signature" not in log
    assert token.decode() not in log


def _digest(data: bytes) -> str:
    from lpc.header import parse_header

    return parse_header(data).digest
