"""The Host header is replaced, and nothing else, however the stream is divided."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointlink.hosts import LONGEST_HEAD, HostRewriter


def rewritten(stream: bytes, cuts: list[int] | None = None) -> bytes:
    rewriter = HostRewriter("models.example:81")
    places = sorted({0, len(stream), *(cut % (len(stream) + 1) for cut in cuts or [])})
    out = b"".join(rewriter.feed(stream[a:b]) for a, b in itertools.pairwise(places))
    return out + rewriter.finish()


REQUESTS = (
    b"GET /a HTTP/1.1\r\nhost: 127.0.0.1:5\r\nRange: bytes=0-9\r\n\r\n",
    b"POST /b HTTP/1.1\r\nContent-Length: 41\r\nHost:wrong\r\n\r\nGET /in/body HTTP/1.1\r\nHost: kept\r\n\r\n1234",
    b"HEAD /c HTTP/1.0\r\nX-Forwarded-Host: kept\r\n\r\n",
)
EXPECTED = (
    b"GET /a HTTP/1.1\r\nHost: models.example:81\r\nRange: bytes=0-9\r\n\r\n",
    (
        b"POST /b HTTP/1.1\r\nHost: models.example:81\r\nContent-Length: 41\r\n\r\n"
        b"GET /in/body HTTP/1.1\r\nHost: kept\r\n\r\n1234"
    ),
    b"HEAD /c HTTP/1.0\r\nHost: models.example:81\r\nX-Forwarded-Host: kept\r\n\r\n",
)


@given(st.lists(st.integers(0, 2), max_size=6), st.lists(st.integers(0, 10_000), max_size=30))
def test_requests_in_any_division(order: list[int], cuts: list[int]) -> None:
    stream = b"".join(REQUESTS[i] for i in order)
    assert rewritten(stream, cuts) == b"".join(EXPECTED[i] for i in order)


def test_a_body_of_unknown_length_is_the_last() -> None:
    head = b"PUT /x HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\nConnection: keep-alive\r\n\r\n"
    body = b"3\r\nabc\r\n0\r\n\r\n" + REQUESTS[0]
    out = rewritten(head + body)
    assert out.endswith(body)
    assert b"Connection: close" in out
    assert b"keep-alive" not in out
    assert b"Host: models.example:81" in out


def test_after_an_upgrade_everything_passes() -> None:
    head = b"GET /x HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n"
    out = rewritten(head + REQUESTS[0])
    assert out.endswith(REQUESTS[0])
    assert b"Connection: Upgrade" in out


@given(st.binary(max_size=300), st.lists(st.integers(0, 300), max_size=5))
def test_what_is_no_http_passes_untouched(data: bytes, cuts: list[int]) -> None:
    assert rewritten(b"\x16" + data, cuts) == b"\x16" + data


@pytest.mark.parametrize(
    "stream", [b"GET / HTTP/1.1\r\nHost: a", b"SSH-2.0-x\r\n", b"GET /" + b"x" * (LONGEST_HEAD + 1)]
)
def test_no_byte_is_lost_of_what_never_becomes_a_head(stream: bytes) -> None:
    assert rewritten(stream, [7]) == stream


def test_what_cannot_be_a_request_is_not_held_back() -> None:
    assert HostRewriter("x").feed(b"EHLO there\r\n") == b"EHLO there\r\n"


def test_a_host_name_beyond_ascii() -> None:
    assert b"Host: xn--mller-kva.example\r\n" in HostRewriter("müller.example").feed(REQUESTS[0])
