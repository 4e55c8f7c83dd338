"""The catalogue tells what is in the folder now, for people and for programs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from typing import TYPE_CHECKING, Any

from support.rawhttp import RawConnection
from support.servers import serve_in_loop
from support.shelf import HEADER, make_model

from pointserve.pages import byte_size, count, crs_name

if TYPE_CHECKING:
    from pathlib import Path

WriteModel = Callable[..., bytes]


async def listed(connection: RawConnection) -> dict[str, dict[str, Any]]:
    reply = await connection.ask("/catalogue.json")
    assert reply.headers["content-type"].startswith("application/json")
    return {entry["name"]: entry for entry in json.loads(reply.body)["models"]}


async def test_json_says_what_the_header_says(models: Path, model: WriteModel) -> None:
    model("a folder/david's.lpc")
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        (entry,) = (await listed(connection)).values()
        assert entry["name"] == "a folder/david's.lpc"
        assert entry["path"] == "/a%20folder/david%27s.lpc"
        assert entry["bytes"] == 10_000
        assert entry["complete"] is True
        assert entry["samples"] == HEADER.samples
        assert entry["clouds"] == HEADER.nodes
        assert entry["attributes"] == ["color"]
        assert entry["bounds"] == [0.0, 0.5, 1.0, 2.0, 3.0, 4.0]
        assert entry["crs"] == HEADER.crs
        reply = await connection.ask(entry["path"], method="HEAD")
        assert reply.headers["etag"].startswith(f'"{entry["digest"]}')


async def test_new_replaced_removed_cut_and_broken_models_are_seen_at_once(models: Path, model: WriteModel) -> None:
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        assert await listed(connection) == {}
        assert b"No models" in (await connection.ask("/")).body
        data = model()
        first = (await listed(connection))["david.lpc"]
        make_model(models / "next", size=20_000, seed=5)
        (models / "next").rename(models / "david.lpc")
        second = (await listed(connection))["david.lpc"]
        assert (second["bytes"], second["digest"] != first["digest"]) == (20_000, True)
        (models / "david.lpc").write_bytes(data[:9000])
        assert (await listed(connection))["david.lpc"]["complete"] is False
        (models / "david.lpc").write_bytes(data[:100])
        (models / "noise.lpc").write_bytes(b"PK\3\4 something else")
        (models / "empty.lpc").write_bytes(b"")
        make_model(models / "sub" / "whole.lpc")
        entries = await listed(connection)
        assert entries["sub/whole.lpc"]["samples"] == HEADER.samples
        for name in ("david.lpc", "noise.lpc", "empty.lpc"):
            assert entries[name]["problem"]
            assert "samples" not in entries[name]
        page = (await connection.ask("/")).body.decode()
        assert page.count("Not a model") == 3
        shutil.rmtree(models / "sub")
        assert "sub/whole.lpc" not in await listed(connection)


class Text(HTMLParser):
    """The tags and the text that a browser would see."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page.decode())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


async def test_the_copy_of_a_part_is_not_served(models: Path, model: WriteModel) -> None:
    data = model()
    (models / "david.lpc.present").write_bytes(b"which parts are here")
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        assert await listed(connection) == {}
        assert (await connection.ask("/david.lpc", "Range: bytes=0-9")).status == 404
        (models / "david.lpc.present").unlink()  # the rest has come
        assert list(await listed(connection)) == ["david.lpc"]
        assert (await connection.ask("/david.lpc", "Range: bytes=0-9")).body == data[:10]


async def test_page_has_the_facts_a_link_and_a_line_to_copy(models: Path, model: WriteModel) -> None:
    model("a folder/<script>alert(1)&.lpc")
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        reply = await connection.ask("/")
        assert reply.headers["content-type"] == "text/html; charset=utf-8"
        seen = Text(reply.body)
        path = "/a%20folder/%3Cscript%3Ealert%281%29%26.lpc"
        assert f"pointstream view http://test{path}" in seen.text
        assert any(tag == "a" and attributes["href"] == path for tag, attributes in seen.tags)
        assert not any(tag == "script" for tag, _ in seen.tags)
        for fact in (
            "1\u202f234\u202f567",
            "10 kB",
            "color",
            "(0, 0.5, 1) to (2, 3, 4)",
            "OSGB36 / <British> National Grid",
        ):
            assert fact in seen.text
        connection.writer.write(b'GET / HTTP/1.1\r\nHost: x"><script>\r\n\r\n')
        assert not any(tag == "script" for tag, _ in Text((await connection.read()).body).tags)


async def test_health_fails_when_the_folder_is_gone(models: Path, model: WriteModel) -> None:
    model()
    away = models.with_name("away")
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        assert (await connection.ask("/healthz")).body == b"ok, 1 models\n"
        models.rename(away)  # noqa: ASYNC240
        assert (await connection.ask("/healthz")).status == 503
        assert (await connection.ask("/david.lpc")).status == 404
        away.rename(models)
        assert (await connection.ask("/healthz")).status == 200
        assert (await connection.ask("/david.lpc")).status == 200


def test_numbers_for_people() -> None:
    assert [byte_size(number) for number in (0, 999, 1000, 10_000, 123_456_789, 999_600, 5 << 40)] == [
        "0 bytes", "999 bytes", "1 kB", "10 kB", "123 MB", "1 MB", "5.5 TB",
    ]  # fmt: skip
    assert count(1_234_567) == "1\u202f234\u202f567"
    assert crs_name('GEOGCRS["WGS 84",DATUM["x"]]') == "WGS 84"
    assert crs_name(None) is None
