"""Verdicts on hosts from what was seen of them, and a look at hosts that misbehave."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import httpx
import pytest
from support.hosts import reply
from support.servers import serve_in_thread
from support.shelf import HEADER

from lpc.errors import StoreError, Unavailable
from pointstream import command
from pointstream.doctor import Finding, Observations, Seen, advisable, can_serve, diagnose
from pointstream.probe import ProbeOptions, probe
from pointstream.remedies import RECIPES, recipes_for

if TYPE_CHECKING:
    from pathlib import Path

LENGTH = HEADER.bytes
CORS = {
    "access-control-allow-origin": "*",
    "access-control-expose-headers": "Content-Range, ETag",
    "access-control-allow-headers": "Range, If-Match",
}
HEAD = {"etag": '"a"', "keep-alive": "timeout=75", **CORS}


def part(start: int, stop: int, **headers: str) -> Seen:
    """The right reply to a range."""
    end = min(stop, LENGTH)
    fields = {**HEAD, "content-range": f"bytes {start}-{end - 1}/{LENGTH}", **headers}
    return Seen(status=206, headers=fields, body=bytes(end - start), start=start, stop=stop)


GOOD = Observations(
    address="http://host/x.lpc",
    first=part(0, 65_536),
    header=HEADER,
    inside=part(5000, 9096),
    coded=part(0, 1024),
    stranger=Seen(status=412, headers={}),
    beyond=Seen(status=416, headers={"content-range": f"bytes */{LENGTH}"}),
    preflight=Seen(status=204, headers=CORS),
    kept=True,
    rested=3.0,
    rest_tried=3.0,
    rtts=(0.05, 0.04),
    goodput=125_000.0,
    goodput_bytes=1_000_000,
)


def about(topic: str, seen: Observations) -> Finding:
    (finding,) = [finding for finding in diagnose(seen) if finding.topic == topic]
    return finding


def without(reply: Seen, *names: str, **changes: str) -> Seen:
    return replace(reply, headers={n: v for n, v in {**reply.headers, **changes}.items() if n not in names})


def test_a_good_host_has_only_good() -> None:
    findings = diagnose(GOOD)
    assert {finding.level for finding in findings} == {"good"}
    assert can_serve(findings)
    assert about("round trip", GOOD).text.startswith("40.0 ms")
    assert about("goodput", GOOD).text == "1 Mbit/s over 1 MB"
    assert about("idle limit", GOOD).text == "75 s, says the host"


@pytest.mark.parametrize(
    ("first", "words"),
    [
        (Seen(status=200, headers={"content-length": "77"}), "whole file comes (77 bytes)"),
        (without(GOOD.first, **{"content-encoding": "gzip"}), "coded as gzip"),
        (without(GOOD.first, "content-range"), "no Content-Range"),
        (without(GOOD.first, **{"content-range": "bytes nonsense"}), "means nothing"),
        (without(GOOD.first, **{"content-range": f"bytes 0-{LENGTH - 1}/*"}), "how long"),
        (without(GOOD.first, **{"content-range": f"bytes 1-{LENGTH - 1}/{LENGTH}"}), "another than"),
        (without(GOOD.first, **{"content-type": "multipart/byteranges; boundary=x"}), "multipart"),
        (replace(GOOD.first, body=b"short"), "has 5 bytes"),
    ],
)
def test_what_stands_in_the_way_is_a_failure(first: Seen, words: str) -> None:
    findings = diagnose(replace(GOOD, first=first))
    assert not can_serve(findings)
    assert [finding.topic for finding in findings if finding.level == "failure"] == ["ranges"]
    assert words in findings[0].text


@pytest.mark.parametrize(
    ("status", "words"), [(404, "nothing stands there"), (401, "token"), (302, "elsewhere"), (503, "it fails")]
)
def test_where_nothing_is_served_nothing_is_advised(status: int, words: str) -> None:
    findings = diagnose(Observations(address="http://host/x.lpc", first=Seen(status=status, headers={})))
    assert not can_serve(findings)
    assert not advisable(findings)
    (finding,) = findings
    assert (finding.topic, finding.level) == ("address", "failure")
    assert words in finding.text


def test_a_missing_model_brings_no_lines_of_configuration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serve_in_thread(tmp_path) as url:
        assert command.run(["doctor", f"{url}/no.lpc"]) == 1
    out = capsys.readouterr().out
    assert "404: nothing stands there" in out
    assert "address of one" in out
    assert "Access-Control" not in out


@pytest.mark.parametrize("url", ["foo", "ftp://host/x.lpc", "http://", "http://host:port/x"])
def test_what_is_no_address_is_a_wrong_argument(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.run(["doctor", url]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_file_that_is_no_model_is_a_failure_of_its_own() -> None:
    seen = replace(GOOD, header=None, problem="it is a picture")
    assert about("ranges", seen).level == "good"
    assert about("model", seen) == Finding("model", "failure", "the file is no model: it is a picture")


@pytest.mark.parametrize(
    ("change", "topic", "words"),
    [
        ({"first": without(GOOD.first, "etag")}, "tags", "no ETag"),
        ({"first": without(GOOD.first, etag='W/"a"')}, "tags", "weak"),
        ({"inside": without(part(5000, 9096), etag='"b"')}, "tags", "changes from reply to reply"),
        ({"stranger": part(0, 1024)}, "tags", "206, not 412"),
        ({"coded": part(0, 1024, **{"content-encoding": "br"})}, "compression", "br"),
        ({"beyond": Seen(status=200, headers={})}, "end of file", "200"),
        ({"first": without(GOOD.first, *CORS)}, "browsers", "Access-Control-Allow-Origin"),
        ({"first": without(GOOD.first, "access-control-expose-headers")}, "browsers", "content-range, etag"),
        ({"preflight": Seen(status=405, headers={})}, "browsers", "405"),
        ({"kept": False}, "connections", "keep-alive"),
        ({"first": without(GOOD.first, **{"keep-alive": "timeout=5, max=100"})}, "idle limit", "after 5 s"),
        ({"rested": None}, "idle limit", "within 3 s"),
        ({"header": replace(HEADER, bytes=LENGTH + 1)}, "model", "coarser"),
        ({"header": replace(HEADER, bytes=LENGTH - 1)}, "model", "1 bytes follow"),
    ],
)
def test_what_could_be_better_is_advice(change: dict[str, Any], topic: str, words: str) -> None:
    seen = replace(GOOD, **change)
    assert can_serve(diagnose(seen))
    finding = about(topic, seen)
    assert finding.level == "advice"
    assert words in finding.text


def test_what_was_not_measured_is_said() -> None:
    silent = replace(GOOD, first=without(GOOD.first, "keep-alive"))
    assert "longer was not measured" in about("idle limit", silent).text
    assert about("idle limit", replace(silent, rested=None, rest_tried=0.0)).text == "not measured"
    assert about("goodput", replace(GOOD, goodput=None)).level == "unknown"


def test_recipes_follow_the_host() -> None:
    assert list(recipes_for("nginx/1.22.1")) == ["nginx"]
    assert list(recipes_for("AmazonS3")) == ["S3-compatible stores"]
    assert "--cors" in recipes_for("pointstream")["pointstream"]
    assert recipes_for("unheard of") == recipes_for(None) == RECIPES


def look(answer: Any, address: str = "http://host.test/x.lpc") -> Observations:
    """Look at a host that a function plays."""
    options = ProbeOptions(rest=0, patience=1, total=5)
    transport = httpx.MockTransport(answer)
    return asyncio.run(probe(address, clock=time.perf_counter, options=options, transport=transport))


def test_never_more_is_read_than_asked() -> None:
    read = 0

    class Endless(httpx.AsyncByteStream):
        async def __aiter__(self) -> Any:
            nonlocal read
            while True:
                read += 65_536
                yield bytes(65_536)

    seen = look(lambda request: httpx.Response(200, stream=Endless()))
    assert not can_serve(diagnose(seen))
    assert read <= 3 * 65_536


def test_redirects_are_followed_on_the_same_host_only() -> None:
    def moved(request: httpx.Request) -> httpx.Response:
        if request.url.path == "/x.lpc":
            return reply(301, location="/y.lpc")
        return reply(404, b"no")

    assert look(moved).address == "http://host.test/y.lpc"
    with pytest.raises(StoreError, match=r"other\.test"):
        look(lambda request: reply(302, location="http://other.test/x.lpc"))
    with pytest.raises(StoreError, match="circles"):
        look(lambda request: reply(302, location="/x.lpc"))


def test_secrets_of_the_address_are_not_repeated() -> None:
    seen = look(lambda request: reply(404), "http://me:word@host.test/x.lpc?signature=abc")
    assert seen.address == "http://host.test/x.lpc"


def test_nobody_there_is_one_line() -> None:
    def refuse(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("connection refused")

    with pytest.raises(Unavailable, match="refused"):
        look(refuse)
    for address in ("ftp://host/x.lpc", "http://", "x.lpc", "http://[/x"):
        with pytest.raises(StoreError):
            look(refuse, address)
