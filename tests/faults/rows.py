"""The table of faults: what goes wrong, what is shown, what is reported. docs/faults.md is made of it."""

from __future__ import annotations

import asyncio
import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from support.frames import whole_index
from support.wicked import Reply, fault

from lpc.page import PAGE_HEADER

if TYPE_CHECKING:
    from collections.abc import Callable

Shown = Literal["everything", "all but the damaged", "what had come", "nothing", "the new build"]
SHOWN = {
    "everything": "everything, in the end",
    "all but the damaged": "everything but the damaged clouds and what only they lead to",
    "what had come": "what had come before",
    "nothing": "nothing: opening fails",
    "the new build": "the new build, whole",
}


@dataclass(frozen=True, kw_only=True)
class Row:
    """A fault and its outcome.

    `act` gives the fault of a request by its number; `connect` what happens to connections by time; `data` the file
    made of the sound one; `later` changes the host a little later. `report` is a pattern, None: there is none.
    """

    name: str
    shown: Shown
    report: str | None = None
    act: Callable[[int], Any] = lambda _: None
    connect: Callable[[float], str | None] = lambda _: None
    data: Callable[[bytes], bytes] = lambda data: data
    etag: str | None = None
    later: str | None = None


def some(what: Any) -> Callable[[int], Any]:
    """At two requests."""
    return {2: what, 5: what}.get


def ever(what: Any, after: int = 2) -> Callable[[int], Any]:
    """At all requests from some number on."""
    return lambda number: what if number >= after else None


def until(seconds: float, what: Any) -> Callable[[int], Any]:
    """At all requests but the first, until some time."""
    return lambda number: what if number and asyncio.get_running_loop().time() < seconds else None


def head(**changes: Any) -> Callable[[Reply], bytes]:
    return lambda reply: reply.head(**changes)


def body(start: int | None = None, stop: int | None = None) -> Callable[[Reply], bytes]:
    return lambda reply: reply.body[start:stop]


HEAD, BODY = head(), body()
HALF_HEAD = lambda reply: reply.head()[:60]  # noqa: E731
EMPTY = {"content_range": None, "content_length": "0"}


def status(code: int, **more: str) -> Any:
    return fault(head(status=code, **EMPTY, **more), keep=True)


def flipped(reply: Reply) -> bytes:
    damaged = bytearray(reply.body)
    damaged[len(damaged) // 2] ^= 0x10
    return bytes(damaged)


def drip(reply: Reply) -> Any:
    return fault(HEAD, *[part for byte in reply.body[:100] for part in (bytes([byte]), 1.0)])


async def dripping(reply: Reply) -> bool:
    return bool(await drip(reply)(reply))


def other_range(by: int = 0, total: int | None = None) -> Any:
    def moved(reply: Reply) -> bytes:
        first, stop = reply.start + by, reply.start + by + len(reply.body)
        length = total or int(dict(reply.headers)["content-range"].rpartition("/")[2])
        return reply.head(content_range=f"bytes {first}-{stop - 1}/{length}")

    return moved


async def shorter(reply: Reply) -> bool:
    size = max(1, len(reply.body) // 2)
    total = dict(reply.headers)["content-range"].rpartition("/")[2]
    place = f"bytes {reply.start}-{reply.start + size - 1}/{total}"
    await reply.send(reply.head(content_range=place, content_length=str(size)), reply.body[:size])
    return True


async def star(reply: Reply) -> bool:
    place = f"bytes {reply.start}-{reply.start + len(reply.body) - 1}/*"
    await reply.send(reply.head(content_range=place), reply.body)
    return True


PORTAL = b"<!doctype html><title>Please sign in</title>" * 40
PAGE = {"content_range": None, "content_type": "text/html", "content_length": str(len(PORTAL))}
portal = fault(head(status=200, etag=None, **PAGE), PORTAL, keep=True)


def forged(data: bytes, node: int, change: Callable[[Any], None] | None = None, cloud: bytes | None = None) -> bytes:
    """The file with a record or a cloud of our own, under right checksums (but the digest's, which takes the whole)."""
    index, out = whole_index(data), bytearray(data)
    if cloud is not None:
        place = index.cloud_range(node)
        out[place.start : place.stop] = cloud[: place.size].ljust(place.size, b"\0")
    page = node // index.header.page_nodes
    where = index.page_range(page)
    at = where.start + PAGE_HEADER + 48 * (node % index.header.page_nodes)
    if cloud is not None:
        out[at + 36 : at + 40] = struct.pack("<I", zlib.crc32(out[place.start : place.stop]))
    if change is not None:
        record = out[at : at + 48]
        change(record)
        out[at : at + 48] = record
    text = out[where.start : where.stop]
    crc = zlib.crc32(text[24:], zlib.crc32(text[:20]))
    out[where.start + 20 : where.start + 24] = struct.pack("<I", crc)
    return bytes(out)


def record(offset: int, layout: str, value: Any, node: int = 60) -> Callable[[bytes], bytes]:
    def change(bytes_of_record: Any) -> None:
        struct.pack_into(layout, bytes_of_record, offset, *(value if isinstance(value, tuple) else (value,)))

    return lambda data: forged(data, node, change)


def header(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    """Another text in the header, of the same length, under a right checksum."""

    def change(data: bytes) -> bytes:
        length = int.from_bytes(data[12:16], "little")
        text = data[24 : 24 + length]
        place = text.index(old)
        text = text[:place] + new + text[place + len(new) :]
        assert len(text) == length
        return data[:16] + struct.pack("<I", zlib.crc32(text)) + data[20:24] + text + data[24 + length :]

    return change


def bitten(seed: int) -> Callable[[bytes], bytes]:
    """Bytes inverted at random places behind the first page."""

    def change(data: bytes) -> bytes:
        index, out = whole_index(data), bytearray(data)
        for place in np.random.default_rng(seed).integers(index.page_range(0).stop, len(data), 5).tolist():
            out[place] ^= 0xFF
        return bytes(out)

    return change


def bomb(data: bytes) -> bytes:
    """A cloud that says that it holds a tebibyte."""
    return forged(data, 30, cloud=bytes.fromhex("28b52ffde4") + struct.pack("<Q", 1 << 40) + bytes(100))


def other_frame(data: bytes) -> bytes:
    """A cloud in the place of another one of other size and samples."""
    index = whole_index(data)
    place = index.cloud_range(31)
    return forged(data, 30, cloud=data[place.start : place.stop])


OUTAGE = r"host.test.*(gave up|fails again|too many)"
DAMAGE = r"(cloud|page) \d+.*stays missing"

CONNECTIONS = [
    Row(
        name="connection refused for 10 s",
        shown="everything",
        report=OUTAGE,
        act=until(1, fault(reset=True)),
        connect=lambda now: "refused" if 0.05 < now < 10 else None,
    ),
    Row(name="connection refused always", shown="nothing", report="refused", connect=lambda _: "refused"),
    Row(
        name="connections vanish for 10 s",
        shown="everything",
        report=None,
        connect=lambda now: "hole" if 0.05 < now < 10 else None,
    ),
    Row(name="connections vanish always", shown="nothing", report="gave up", connect=lambda _: "hole"),
    Row(name="name not found", shown="nothing", report="not known", connect=lambda _: "nowhere"),
    Row(name="FIN before the head", shown="everything", act=some(fault())),
    Row(name="RST before the head", shown="everything", act=some(fault(reset=True))),
    Row(name="FIN inside the head", shown="everything", act=some(fault(HALF_HEAD))),
    Row(name="RST inside the head", shown="everything", act=some(fault(HALF_HEAD, reset=True))),
    Row(name="FIN after the head", shown="everything", act=some(fault(HEAD))),
    Row(name="RST after the head", shown="everything", act=some(fault(HEAD, reset=True))),
    Row(name="FIN inside the body", shown="everything", act=some(fault(HEAD, body(0, 900)))),
    Row(name="RST inside the body", shown="everything", act=some(fault(HEAD, body(0, 900), reset=True))),
    Row(name="FIN after the body", shown="everything", act=ever(fault(HEAD, BODY), 0)),
    Row(name="RST after the body", shown="everything", act=some(fault(HEAD, BODY, reset=True))),
    Row(name="FIN before every head", shown="what had come", report=OUTAGE, act=ever(fault())),
    Row(name="stall before the head", shown="everything", act=some(fault(90.0))),
    Row(name="stall inside the head", shown="everything", act=some(fault(HALF_HEAD, 90.0))),
    Row(name="stall inside the body", shown="everything", act=some(fault(HEAD, body(0, 50), 90.0))),
    Row(name="a byte a second", shown="everything", act=some(dripping)),
    Row(name="30 s outage", shown="everything", report=OUTAGE, act=until(30, fault(reset=True))),
    Row(name="server restart", shown="everything", report=None, later="restart"),
    Row(name="the machine sleeps for an hour", shown="everything", report=None, later="sleep"),
]
REPLIES = [
    Row(name="surplus bytes after the body", shown="everything", act=some(fault(HEAD, BODY, b"x" * 999, keep=True))),
    Row(name="garbage for a status line", shown="everything", act=some(fault(b"\x16\x03\x01 hello\r\n\r\n"))),
    Row(name="a header line of 200 KB", shown="everything", act=some(fault(b"HTTP/1.1 206 x\r\nA: " + b"a" * 200_000))),
    Row(name="5000 headers", shown="everything", act=some(fault(b"HTTP/1.1 206 x\r\n" + b"A: a\r\n" * 5000))),
    Row(
        name="two lengths",
        shown="everything",
        act=some(fault(lambda reply: reply.head()[:-2] + b"content-length: 3\r\n\r\n", BODY)),
    ),
    Row(name="negative length", shown="everything", act=some(fault(head(content_length="-5"), BODY))),
    Row(
        name="bad chunk size",
        shown="everything",
        act=some(fault(head(content_length=None, transfer_encoding="chunked"), b"zz\r\n")),
    ),
    Row(name="no length, cut by FIN", shown="everything", act=some(fault(head(content_length=None), body(0, 900)))),
    Row(name="no Content-Range", shown="everything", act=some(fault(head(content_range=None), BODY, keep=True))),
    Row(
        name="garbage for Content-Range",
        shown="everything",
        act=some(fault(head(content_range="bytes 9-1/2"), BODY, keep=True)),
    ),
    Row(name="shifted range", shown="everything", act=some(fault(other_range(7), BODY, keep=True))),
    Row(
        name="another length of the file",
        shown="everything",
        act={3: fault(other_range(total=10**6), BODY, keep=True)}.get,
        report="another build",
    ),
    Row(name="shorter range", shown="everything", act=ever(shorter)),
    Row(name="length unknown to the host", shown="everything", act=ever(star)),
    Row(
        name="multipart",
        shown="everything",
        act=some(fault(head(content_type="multipart/byteranges"), BODY, keep=True)),
    ),
    Row(
        name="200 with the whole file",
        shown="everything",
        act=some(fault(head(status=200, content_range=None, content_length="99999999"), b"x" * 5000)),
    ),
    Row(name="204", shown="what had come", report="status 204", act=ever(status(204))),
    Row(
        name="301 to another host",
        shown="what had come",
        report="open that address if you trust it",
        act=ever(status(301, location="http://evil.test/model.lpc")),
    ),
    Row(name="301 in circles", shown="what had come", report="circles", act=ever(status(301, location="/model.lpc"))),
    *(
        Row(name=str(code), shown="what had come", report=f"status {code}", act=ever(status(code)))
        for code in (400, 401, 403, 404, 410, 418)
    ),
    Row(name="416 inside the file", shown="everything", act=some(status(416))),
    *(
        Row(name=f"{code}, twice", shown="everything", act=some(status(code)))
        for code in (408, 425, 429, 500, 502, 503)
    ),
    Row(name="429 with Retry-After 2", shown="everything", act=some(status(429, retry_after="2"))),
    Row(name="503 with an absurd Retry-After", shown="everything", act=some(status(503, retry_after="9" * 40))),
    Row(name="503 to everything", shown="what had come", report=OUTAGE, act=ever(status(503))),
    Row(name="412 to everything", shown="what had come", report="another build|inconsistent", act=ever(status(412), 2)),
    Row(name="captive portal from the start", shown="nothing", report="no .lpc|not a", act=ever(portal, 0)),
    Row(name="captive portal later", shown="what had come", report=OUTAGE, act=ever(portal)),
    Row(
        name="gzip on 206",
        shown="what had come",
        report="compresses",
        act=ever(fault(head(content_encoding="gzip"), BODY)),
    ),
]
MODELS = [
    Row(
        name="bits flipped in a tenth of the replies",
        shown="everything",
        act=lambda number: fault(HEAD, flipped, keep=True) if number % 10 == 3 else None,
    ),
    Row(
        name="bits flipped in every reply",
        shown="what had come",
        report=DAMAGE,
        act=ever(fault(HEAD, flipped, keep=True)),
    ),
    Row(name="republished by rename", shown="the new build", report="another build", later="republish"),
    Row(
        name="republished under an equal tag",
        shown="the new build",
        report="another build",
        later="republish",
        etag='"same"',
    ),
    Row(
        name="republished in place, equal length and tag",
        shown="the new build",
        report="another build",
        later="in place",
        etag='"same"',
    ),
    Row(
        name="a tag of its own in every reply",
        shown="everything",
        report="another build",
        act=lambda number: fault(head(etag=f'"{number}"'), BODY, keep=True),
    ),
    Row(name="two builds in turns", shown="what had come", report="inconsistent", later="in turns"),
    Row(name="weak tags", shown="everything", etag='W/"1"'),
    Row(
        name="cut off in the middle", shown="all but the damaged", report=None, data=lambda data: data[: len(data) // 2]
    ),
]
HOSTILE = [
    Row(name="empty file", shown="nothing", report="ends inside its header", data=lambda _: b""),
    Row(name="header: not one", shown="nothing", report="no .lpc|not a", data=lambda data: b"\0" * 100_000),
    Row(
        name="header: newer version", shown="nothing", report="version", data=lambda data: data[:8] + b"\x03" + data[9:]
    ),
    Row(name="header: damaged", shown="nothing", report="header", data=lambda data: data[:60] + b"?" + data[61:]),
    Row(name="header: negative length", shown="nothing", report="header", data=header(b'"bytes":1', b'"bytes":-')),
    Row(
        name="header: absurd page size",
        shown="nothing",
        report="header|page",
        data=header(b'"page_nodes":16', b'"page_nodes":0,'),
    ),
    Row(
        name="page: children before parents",
        shown="all but the damaged",
        report=DAMAGE,
        data=lambda data: forged(data, 16, lambda record: record.__setitem__(44, 0)),
    ),
    Row(
        name="page: radius not a number",
        shown="all but the damaged",
        report=DAMAGE,
        data=record(12, "<f", float("nan")),
    ),
    Row(name="page: negative radius", shown="all but the damaged", report=DAMAGE, data=record(12, "<f", -1.0)),
    Row(
        name="page: a child far from its parent",
        shown="all but the damaged",
        report=DAMAGE,
        data=record(0, "<IIIf", (0, 0, 0, 0.0)),
    ),
    Row(name="page: 2^32 - 1 samples", shown="all but the damaged", report=DAMAGE, data=record(20, "<I", 2**32 - 1)),
    Row(name="page: subtree overflows", shown="all but the damaged", report=DAMAGE, data=record(24, "<Q", 2**63 + 5)),
    Row(name="page: cloud beyond the file", shown="all but the damaged", report=DAMAGE, data=record(32, "<I", 2**31)),
    Row(name="page: cloud of no bytes", shown="all but the damaged", report=DAMAGE, data=record(32, "<I", 0)),
    Row(name="cloud: bomb", shown="all but the damaged", report=DAMAGE, data=bomb),
    Row(name="cloud: another one's bytes", shown="all but the damaged", report=DAMAGE, data=other_frame),
    *(
        Row(name=f"bytes inverted, seed {seed}", shown="all but the damaged", report=DAMAGE, data=bitten(seed))
        for seed in range(4)
    ),
]
CACHES = {
    "disk full": "the cache .* cannot be used",
    "read-only": "the cache .* cannot be used",
    "corrupted": None,
    "map torn": None,
    "gone": None,
}
GROUPS = {"connections": CONNECTIONS, "replies": REPLIES, "models": MODELS, "hostile bytes": HOSTILE}
ROWS = [row for rows in GROUPS.values() for row in rows]
