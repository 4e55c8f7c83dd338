"""Nothing leaves the served folder: in any spelling, by any link, of any kind of file."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.rawhttp import RawConnection
from support.servers import serve_in_loop
from support.shelf import make_model

from pointserve.paths import is_plain_name, model_names, url_path

if TYPE_CHECKING:
    from pathlib import Path

WriteModel = Callable[..., bytes]

CLIMBS = [
    "/../secret.lpc", "/../../secret.lpc", "/sub/../david.lpc", "/./david.lpc", "//david.lpc", "/sub//deep.lpc",
    "/%2e%2e/secret.lpc", "/%2E%2E/secret.lpc", "/.%2e/secret.lpc", "/%2e./secret.lpc", "/..%2fsecret.lpc",
    "/..%2Fsecret.lpc", "/sub%2fdeep.lpc", "/%2fetc%2fpasswd.lpc", "/..%5csecret.lpc",
    "/..\\secret.lpc", "/sub\\deep.lpc",
    "/%252e%252e/secret.lpc", "/%c0%ae%c0%ae/secret.lpc", "/..%00/secret.lpc", "/david.lpc%00", "/david.lpc%00.lpc",
    "/%00.lpc", "/david.lpc/", "/david.lpc/x.lpc", "/david.lpc;a.lpc", "/.hidden.lpc",
    "/.secret/x.lpc", "/david.lpc%20",
    "/david.lpc.", "/DAVID.LPC", "/david", "/notes.txt", "/david.lpc.bak", "/david.lpc%0a",
    "/%0d%0aX:%20y.lpc", "/%ff.lpc", "/%.lpc",
    "/~root/x.lpc", "/" + "a" * 300 + ".lpc", "/" + "%61" * 1200 + ".lpc",
    "/" + "a/" * 400 + "x.lpc", "/%e2%80%ae.lpc", "/.lpc",
    "/folder.lpc", "/pipe.lpc", "/out.lpc", "/outdir/secret.lpc", "/loop.lpc", "/dangling.lpc",
    "/hidden-by-link.lpc", "/socket.lpc",
]  # fmt: skip


@pytest.fixture
def forest(tmp_path: Path, models: Path, model: WriteModel) -> bytes:
    """Fill the folder with everything that must not be served, and two models that are."""
    make_model(tmp_path / "secret.lpc")
    make_model(models / ".hidden.lpc")
    make_model(models / ".secret" / "x.lpc")
    make_model(models / "sub" / "deep.lpc", seed=1)
    (models / "notes.txt").write_text("private")
    (models / "folder.lpc").mkdir()
    os.mkfifo(models / "pipe.lpc")
    (models / "out.lpc").symlink_to(tmp_path / "secret.lpc")
    (models / "outdir").symlink_to(tmp_path)
    (models / "loop.lpc").symlink_to(models / "loop.lpc")
    (models / "dangling.lpc").symlink_to(models / "nothing.lpc")
    (models / "hidden-by-link.lpc").symlink_to(models / ".hidden.lpc")
    (models / "inside.lpc").symlink_to("sub/deep.lpc")
    return model()


async def test_no_spelling_leaves_the_folder(models: Path, forest: bytes) -> None:
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        for target in CLIMBS:
            for method in ("GET", "HEAD"):
                reply = await connection.ask(target, method=method)
                assert reply.status == 404, target
                assert b"\n" not in reply.body[:-1]
            assert (await connection.ask("/david.lpc", "Range: bytes=7-9")).body == forest[7:10], target


async def test_models_in_folders_and_behind_links_that_stay_inside(models: Path, forest: bytes) -> None:
    deep = (models / "sub" / "deep.lpc").read_bytes()
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        for target in ("/david.lpc", "/%64avid.lpc", "/david.lpc?../../x", "/david.lpc?"):
            assert (await connection.ask(target)).body == forest
        for target in ("/sub/deep.lpc", "/inside.lpc"):
            assert (await connection.ask(target)).body == deep
        (models / "other.lpc").write_bytes(forest)
        (models / "switch").symlink_to("other.lpc")
        (models / "switch").rename(models / "inside.lpc")  # how a link is switched without a moment of absence
        assert (await connection.ask("/inside.lpc")).body == forest


async def test_the_catalogue_lists_exactly_what_can_be_read(models: Path, forest: bytes) -> None:
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        listed = [entry["path"] for entry in json.loads((await connection.ask("/catalogue.json")).body)["models"]]
        assert listed == ["/david.lpc", "/inside.lpc", "/sub/deep.lpc"]
        for path in listed:
            assert (await connection.ask(path, method="HEAD")).status == 200


async def test_a_folder_exchanged_for_a_link_outside_is_noticed(tmp_path: Path, models: Path, forest: bytes) -> None:
    make_model(tmp_path / "elsewhere" / "deep.lpc", seed=9)
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        assert (await connection.ask("/sub/deep.lpc")).status == 200
        (models / "sub").rename(tmp_path / "moved")
        (models / "sub").symlink_to(tmp_path / "elsewhere")
        assert (await connection.ask("/sub/deep.lpc")).status == 404


async def test_the_picture_beside_a_model_belongs_to_it(models: Path, model: WriteModel) -> None:
    model()
    (models / "david.lpc.png").write_bytes(b"\x89PNG")
    (models / "other.png").write_bytes(b"\x89PNG")
    async with serve_in_loop(models) as url, RawConnection(url) as connection:
        reply = await connection.ask("/david.lpc.png")
        assert (reply.status, reply.headers["content-type"], reply.body) == (200, "image/png", b"\x89PNG")
        assert (await connection.ask("/other.png")).status == 404
        assert b'src="/david.lpc.png"' in (await connection.ask("/")).body


plain = st.text(min_size=1, max_size=40).filter(is_plain_name)


@given(st.lists(plain, max_size=4), plain)
def test_names_survive_the_way_into_a_url_and_back(folders: list[str], stem: str) -> None:
    names = (*folders, stem + ".lpc")
    path = url_path(names)
    assert model_names(path) == names
    assert path.isascii()
    assert not set(path) & set(" \"'<>&;$`()|\\*?#")


@given(st.one_of(st.text(), st.text("/.%2eE\\fFcC05", min_size=1).map(lambda text: f"/{text}.lpc")))
def test_whatever_is_asked_only_plain_names_come_through(raw: str) -> None:
    names = model_names(raw)
    if names is not None:
        assert all(name not in ("", ".", "..") and not set(name) & {"/", "\\", "\0"} for name in names)
        assert names[-1].endswith((".lpc", ".lpc.png"))
