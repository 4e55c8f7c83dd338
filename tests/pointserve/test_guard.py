"""Who may read: nothing is told to a stranger, a signature opens what it names until its moment, secrets stay so."""

from __future__ import annotations

import base64
import logging
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl, urlsplit

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from support.rawhttp import RawConnection
from support.servers import serve_in_loop
from support.shelf import make_model

from lpc.errors import StoreError
from pointserve.cli import sign
from pointserve.guard import Guard, read_key, read_tokens, sign_address
from pointserve.paths import is_plain_name, url_path
from pointstream import command

if TYPE_CHECKING:
    from pathlib import Path

WriteModel = Callable[..., bytes]
TOKEN, OTHER, KEY = b"a token of some length", b"another token, as long", b"a key of thirty-two bytes or so."
BEARER = f"Authorization: Bearer {TOKEN.decode()}"
NOW = 1_800_000_000


def signed(path: str, *, expires: int = NOW + 60, key: bytes = KEY) -> str:
    """Path and query of a signed address."""
    parts = urlsplit(sign_address(f"http://test{path}", key, expires))
    return f"{parts.path}?{parts.query}"


def admitted(target: str, *, at: str | None = None, now: float = NOW, guard: Guard | None = None) -> bool:
    parts = urlsplit(target)
    query = dict(parse_qsl(parts.query))
    return (guard or Guard(key=KEY)).admits(at or parts.path, None, query, now=now)


def test_a_signature_opens_what_it_names_and_nothing_else() -> None:
    model, folder, everything = signed("/a/david.lpc"), signed("/a/"), signed("/")
    alone = {"/a/david.lpc", "/a/david.lpc.png", "/a/%64avid.lpc"}
    below = alone | {"/a/", "/a/catalogue.json", "/a/b/deep.lpc", "/a/b/", "/a/other.lpc", "/a/david.lpc/"}
    for target, opens in ((model, alone), (folder, below)):
        for path in (
            "/", "/a/", "/a", "/a/david.lpc", "/a/%64avid.lpc", "/a/david.lpc.png", "/a/david.lpc/", "/a/other.lpc",
            "/a/catalogue.json", "/a/b/deep.lpc", "/a/b/", "/b/david.lpc", "/ab/david.lpc", "/a/../b/david.lpc",
            "/a/%2e%2e/b/david.lpc", "/metrics", "/catalogue.json",
        ):  # fmt: skip
            assert admitted(target, at=path) == (path in opens), (target, path)
    assert admitted(everything, at="/any/where.lpc")


def test_a_signature_is_bound_to_moment_scope_and_key() -> None:
    target = signed("/a/david.lpc", expires=NOW)
    assert admitted(target, now=NOW - 0.001)
    assert not admitted(target, now=NOW)
    assert not admitted(target.replace(f"expires={NOW}", f"expires={NOW + 1}"), now=NOW - 1)
    assert not admitted(target + "&scope=/", now=NOW - 1)
    assert not admitted(signed("/a/", key=KEY + b"x"), at="/a/david.lpc")
    assert not admitted(signed("/a/"), at="/a/david.lpc", guard=Guard(tokens=(TOKEN,)))
    assert not admitted("/a/david.lpc?expires=99999999999&signature=")
    for broken in ("expires=", "expires=-1", "expires=1e99", "expires=" + "9" * 400, "expires=٣"):
        assert not admitted(f"/a/david.lpc?{broken}&signature=00")


names = st.text(min_size=1, max_size=12).filter(is_plain_name)


@given(st.lists(names, max_size=3), names, st.integers(0, 2))
def test_every_model_can_be_signed_alone_or_by_any_folder_above(folders: list[str], name: str, up: int) -> None:
    model = (*folders, name + ".lpc")
    path = url_path(model)
    assert admitted(signed(path), at=path)
    above = folders[: max(0, len(folders) - up)]
    scope = url_path(tuple(above)) + "/" if above else "/"
    assert admitted(signed(scope), at=path)


@given(st.text(max_size=40), st.text(max_size=40))
def test_no_text_breaks_the_guard(text: str, more: str) -> None:
    guard = Guard(tokens=(TOKEN,), key=KEY)
    query = {"expires": "9" * 10, "signature": text, "scope": more}
    assert not guard.admits("/" + more, text, query, now=0)
    assert not guard.admits(text, f"Basic {text}", {}, now=0)
    assert not guard.admits(text, f"Bearer {more}", {}, now=0)


async def test_a_stranger_learns_nothing(models: Path, model: WriteModel, caplog: pytest.LogCaptureFixture) -> None:
    data = model("a/david.lpc")
    make_model(models / ".hidden.lpc")
    caplog.set_level(logging.INFO)
    guard = Guard(tokens=(OTHER, TOKEN), key=KEY)
    basic = "Authorization: Basic " + base64.b64encode(b"anybody:" + TOKEN).decode()
    async with serve_in_loop(models, guard=guard, cors=("*",)) as url, RawConnection(url) as connection:
        strangers = [
            await connection.ask(target, *lines)
            for target in ("/a/david.lpc", "/nothing.lpc", "/.hidden.lpc", "/", "/catalogue.json", "/metrics", "/a/")
            for lines in ((), ("Authorization: Bearer " + "x" * len(TOKEN),), ("Authorization: Basic !",))
        ]
        for reply in strangers:
            assert (reply.status, reply.body) == (401, strangers[0].body)
            assert reply.headers["www-authenticate"].startswith("Bearer ")
        for line in (BEARER, basic, BEARER.replace("Bearer", "bearer")):
            reply = await connection.ask("/a/david.lpc", line)
            assert reply.body == data
            assert reply.headers["cache-control"].startswith("private")
        hidden, absent = [await connection.ask(f"/{name}", BEARER) for name in (".hidden.lpc", "absent.lpc")]
        assert (hidden.status, absent.status) == (404, 404)
        assert hidden.body == absent.body
        assert (await connection.ask("/healthz")).body == b"ok\n", "anybody may ask, and hears nothing of the models"
        preflight = await connection.ask("/a/david.lpc", "Origin: https://x.example", method="OPTIONS")
        assert "Authorization" in preflight.headers["access-control-allow-headers"]

        soon = 4_000_000_000
        target = signed("/a/", expires=soon)
        page = await connection.ask(target)
        assert page.status == 200
        query = target.partition("?")[2]
        assert f'href="/a/david.lpc?{query.replace("&", "&amp;")}"' in page.body.decode()
        assert (await connection.ask(f"/a/david.lpc?{query}", "Range: bytes=1-2")).body == data[1:3]
        assert (await connection.ask(f"/?{query}")).status == 401
        assert (await connection.ask(signed("/a/david.lpc", expires=1))).status == 401
    assert "/a/david.lpc" in caplog.text
    for secret in (TOKEN.decode(), "signature", query, basic):
        assert secret not in caplog.text
    assert TOKEN.decode() not in repr(guard)
    assert KEY.decode() not in repr(replace(guard, tokens=()))


def test_secrets_from_files(tmp_path: Path) -> None:
    file = tmp_path / "tokens"
    file.write_bytes(b"# for the museum\n\n" + TOKEN + b"  \n" + OTHER)
    assert read_tokens(file) == (TOKEN, OTHER)
    for content in (b"", b"# only a comment\n", b"short\n", TOKEN + b"\nshort"):
        file.write_bytes(content)
        with pytest.raises(StoreError, match="at least 16"):
            read_tokens(file)
    file.write_bytes(KEY + b"\n")
    assert read_key(file) == KEY
    with pytest.raises(StoreError, match="cannot be read"):
        read_key(tmp_path / "nowhere")


def test_sign_prints_an_address_that_the_server_admits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "key").write_bytes(KEY)
    arguments = ["--sign-key", str(tmp_path / "key")]
    result = CliRunner().invoke(sign, ["https://host/a folder/david's.lpc", *arguments, "--expires", "30m"])
    assert result.exit_code == 0
    parts = urlsplit(result.output.strip())
    assert (parts.scheme, parts.netloc, parts.path) == ("https", "host", "/a%20folder/david%27s.lpc")
    expires = int(dict(parse_qsl(parts.query))["expires"])
    target = f"{parts.path}?{parts.query}"
    assert admitted(target, now=expires - 1800)
    assert not admitted(target, now=expires)
    for wrong in ("ftp://host/x.lpc", "https://host/x.png", "https://host/a/../x.lpc", "host/x.lpc"):
        assert command.run(["sign", wrong, *arguments]) == 2, "the arguments are wrong"
        said = capsys.readouterr()
        assert (said.out, said.err.count("\n")) == ("", 1)
    assert command.run(["sign", "https://host/x.lpc", "--sign-key", str(tmp_path / "absent")]) == 1
    for wrong in ("7", "0d", "-1d", "d", "1y"):
        assert CliRunner().invoke(sign, ["https://host/x.lpc", *arguments, "--expires", wrong]).exit_code == 2
