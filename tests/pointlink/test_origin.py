"""The origin's replies, over in-memory connections without limit."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lpc.errors import NotFound
from pointlink.memory import Network
from pointlink.origin import Origin
from pointlink.profiles import NONE
from pointlink.resources import Resource, select_range
from pointlink.virtual import run

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

BODY = bytes(range(256)) * 600
MODEL = Resource.from_bytes(BODY)


def ask(
    *requests: tuple[str, str, Mapping[str, str]], resource: Resource = MODEL, connections: int = 1
) -> list[httpx.Response]:
    """Send requests one after another over one connection."""

    async def main() -> list[httpx.Response]:
        network = Network(Origin(resources={"/m.lpc": resource, "/a b": resource}), NONE)
        async with httpx.AsyncClient(transport=network.transport(max_connections=connections)) as client:
            replies = [await client.request(how, f"http://o{path}", headers=dict(h)) for how, path, h in requests]
        await network.aclose()
        return replies

    return run(main())


def get(**headers: str) -> tuple[str, str, Mapping[str, str]]:
    return ("GET", "/m.lpc", {name.replace("_", "-"): value for name, value in headers.items()})


@pytest.mark.parametrize(
    ("text", "start", "stop"),
    [("bytes=0-0", 0, 1), ("bytes=100-199", 100, 200), ("bytes=153599-", 153599, 153600), ("bytes=-7", 153593, 153600)],
)
def test_a_range_gives_206_and_exactly_its_bytes(text: str, start: int, stop: int) -> None:
    (reply,) = ask(get(range=text))
    assert reply.status_code == 206
    assert reply.content == BODY[start:stop]
    assert reply.headers["content-range"] == f"bytes {start}-{stop - 1}/{len(BODY)}"
    assert reply.headers["content-length"] == str(stop - start)
    assert reply.headers["etag"] == MODEL.etag


@pytest.mark.parametrize("text", ["bytes=0-1,5-6", "bytes=5-4", "bytes=a-b", "items=0-1", "bytes=-", "bytes 0-1"])
def test_what_is_no_single_range_gives_the_whole(text: str) -> None:
    (reply,) = ask(get(range=text))
    assert (reply.status_code, reply.content) == (200, BODY)
    assert "content-range" not in reply.headers
    assert reply.headers["accept-ranges"] == "bytes"


@pytest.mark.parametrize("text", [f"bytes={len(BODY)}-", f"bytes={len(BODY)}-{len(BODY) + 9}", "bytes=-0"])
def test_a_range_outside_gives_416_and_the_length(text: str) -> None:
    (reply,) = ask(get(range=text))
    assert (reply.status_code, reply.content) == (416, b"")
    assert reply.headers["content-range"] == f"bytes */{len(BODY)}"


@given(st.integers(0, 60), st.integers(0, 60), st.integers(0, 60))
def test_ranges_are_python_slices(first: int, last: int, length: int) -> None:
    data = bytes(length)
    if last >= first:
        try:
            selected = select_range(f"bytes={first}-{last}", length)
        except IndexError:
            assert not data[first : last + 1]
        else:
            assert selected is not None
            assert selected == (first, first + len(data[first : last + 1]))
    if first:
        expected = (length - min(first, length), length)
        if length:
            assert select_range(f"bytes=-{first}", length) == expected


def test_conditions() -> None:
    matched, changed, fresh, old_range, same_range, date_range = ask(
        get(if_match=f'"other", {MODEL.etag}', range="bytes=0-3"),
        get(if_match='"other"', range="bytes=0-3"),
        get(if_none_match=MODEL.etag),
        get(if_range='"other"', range="bytes=0-3"),
        get(if_range=MODEL.etag, range="bytes=0-3"),
        get(if_range="Wed, 21 Oct 2015 07:28:00 GMT", range="bytes=0-3"),
    )
    assert [matched.status_code, changed.status_code, fresh.status_code] == [206, 412, 304]
    assert [old_range.status_code, same_range.status_code, date_range.status_code] == [200, 206, 200]
    assert fresh.content == changed.content == b""


def test_head_methods_and_paths_on_one_connection() -> None:
    head, post, missing, escaped, after = ask(
        ("HEAD", "/m.lpc", {"range": "bytes=0-3"}),
        ("POST", "/m.lpc", {}),
        ("GET", "/none", {}),
        ("GET", "/a%20b?query", {"range": "bytes=1-2"}),
        get(range="bytes=0-0"),
    )
    assert (head.status_code, head.content, head.headers["content-length"]) == (200, b"", str(len(BODY)))
    assert (post.status_code, post.headers["allow"]) == (405, "GET, HEAD")
    assert missing.status_code == 404
    assert (escaped.status_code, escaped.content) == (206, BODY[1:3])
    assert after.content == BODY[:1]


def test_an_asynchronous_resource_and_an_empty_one() -> None:
    async def read(start: int, stop: int) -> bytes:
        return BODY[start:stop]

    (reply,) = ask(get(range="bytes=9-99"), resource=Resource(length=len(BODY), etag='"x"', read=read))
    assert reply.content == BODY[9:100]
    whole, outside = ask(get(), get(range="bytes=0-5"), resource=Resource.from_bytes(b""))
    assert (whole.status_code, whole.content, outside.status_code) == (200, b"", 416)


def test_a_file_cut_short_while_served_breaks_the_connection_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "m.lpc"
    path.write_bytes(BODY)
    resource = Resource.from_path(path)
    (whole,) = ask(get(), resource=resource)
    assert whole.content == BODY
    path.write_bytes(BODY[:100_000])
    with pytest.raises(httpx.RemoteProtocolError, match="without sending complete message body"):
        ask(get(), resource=resource)
    with pytest.raises(NotFound, match="cannot be read"):
        Resource.from_path(tmp_path / "none.lpc")


def test_the_log_says_what_was_asked_and_sent() -> None:
    async def main() -> list[tuple[int, str, int, int, int]]:
        network = Network(origin := Origin(resources={"/m.lpc": MODEL}), NONE)
        async with httpx.AsyncClient(transport=network.transport()) as client:
            await client.get("http://o/m.lpc", headers={"range": "bytes=10-19"})
            await client.get("http://o/none")
        return [(item.number, item.path, item.status, item.start, item.stop) for item in origin.log]

    assert run(main()) == [(0, "/m.lpc", 206, 10, 20), (1, "/none", 404, 0, 0)]


@pytest.mark.parametrize("garbage", [b"\x00\x01garbage\r\n\r\n", b"GET / HTTP/1.1\r\n\r\n", b"GET /" + b"x" * 200_000])
def test_garbage_gets_400_or_so_and_the_end(garbage: bytes) -> None:
    async def main() -> bytes:
        network = Network(Origin(resources={}), NONE)
        stream = await network.open_connection()
        stream.write(garbage)
        reply = b""
        while data := await stream.read():
            reply += data
        return reply

    assert run(main()).startswith(b"HTTP/1.1 4")


def test_an_idle_connection_is_closed_when_asked_to() -> None:
    async def main() -> tuple[bytes, float]:
        network = Network(Origin(resources={}, idle_timeout=4.0), NONE)
        stream = await network.open_connection()
        return await stream.read(), asyncio.get_running_loop().time()

    assert run(main()) == (b"", 4.0)
