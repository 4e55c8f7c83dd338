"""The first request is the first picture, and any prefix of a file is a coarser model."""

from __future__ import annotations

import asyncio
import json
import threading
import zlib
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import pytest
from oracles import surfaces
from PIL import Image
from support.built import Built, build_points, numbered
from support.hosts import origin_of, virtual_store

from lpc.header import HEADER_PROBE, parse_header
from lpc.index import IndexTree
from pointlink import virtual
from pointlink.origin import serve_origin
from pointlink.profiles import parse_profile
from pointstream.command import run as command
from pointstream.layer import AccessLayer
from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style, open_backend

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from pointlink.origin import Origin


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Built]:
    """A real build of 60,000 numbered samples in many pages, more than three times as long as the first request."""
    points = numbered(surfaces.bumpy(60_000).xyz, color=surfaces.bumpy(60_000, color=True).attributes["color"])
    path = tmp_path_factory.mktemp("built") / "field.lpc"
    model = build_points(points, path, cloud_size=512, page_nodes=32)
    assert model.header.bytes > 3 * HEADER_PROBE
    assert model.header.pages >= 5
    return path, model


def call(capsys, *arguments: object) -> tuple[int, str, str]:
    status = command([str(argument) for argument in arguments])
    said = capsys.readouterr()
    return status, said.out, said.err


def test_info_and_the_first_frame_take_one_request_of_64_kib(built):
    """`info` needs header and first page; the frame is drawn from the clouds behind them in the same reply."""
    origin = origin_of(built[0].read_bytes())

    async def first_frame():
        async with virtual_store(origin, parse_profile("adsl")) as store:
            layer = await AccessLayer.open(store)
            await asyncio.sleep(0.5)  # virtual; no frame has turned yet, so nothing else was asked for
            camera = Camera.frame_model(layer.header, width=160, height=120)
            cut = refine(layer.index, camera, 1.0, layer.resident)
            backend = open_backend("cpu", layer.header)
            frame = backend.draw(cut, layer.take, camera, Style())
            log = list(origin.log)
            await layer.close()
            return frame, log

    frame, log = virtual.run(first_frame())
    assert frame.splats >= 512
    assert (frame.node >= 0).mean() > 0.05
    assert [(exchange.method, exchange.start, exchange.stop) for exchange in log] == [("GET", 0, HEADER_PROBE)]
    assert HEADER_PROBE <= 65_536


@contextmanager
def on_a_socket(origin: Origin) -> Iterator[str]:
    """Run an origin in a thread; gives the address of its model."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        server = asyncio.run_coroutine_threadsafe(serve_origin(origin), loop).result()
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/model.lpc"
        loop.call_soon_threadsafe(server.close)
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


def test_info_of_an_address_is_one_request(built, capsys):
    origin = origin_of(built[0].read_bytes())
    with on_a_socket(origin) as address:
        status, out, _ = call(capsys, "info", address, "--json")
    assert status == 0
    facts = json.loads(out)
    assert facts["complete"] is True
    assert facts["samples"] == 60_000
    assert [(exchange.start, exchange.stop) for exchange in origin.log] == [(0, HEADER_PROBE)]


def lengths(model: Built) -> list[int]:
    """Lengths that matter: around the ends of header, pages and clouds, and some anywhere."""
    index, header = model.index, model.header
    ends = [int(index.offset[node] + index.size[node]) for node in (0, 1, 40, header.nodes - 2)]
    pages = [index.page_range(page).stop for page in (0, 1, header.pages - 1)]
    near = [place + by for place in (*ends, *pages) for by in (-1, 0, 1)]
    anywhere = np.random.default_rng(4).integers(pages[0], header.bytes, 12).tolist()
    return sorted({*near, *anywhere})


def whole_clouds(model: Built, length: int) -> list[int]:
    """Nodes whose page and cloud end within a length: an oracle with loops."""
    data, header = model.data[:length], model.header
    index, found = IndexTree(header), []
    for page in range(header.pages):
        if index.page_offset[page] == 0 or index.page_range(page).stop > length:
            break
        where = index.page_range(page)
        index.add_page(page, data[where.start : where.stop])
        first = page * header.page_nodes
        for node in range(first, min(first + header.page_nodes, header.nodes)):
            cloud = index.cloud_range(node)
            if cloud.stop <= length:
                assert zlib.crc32(data[cloud.start : cloud.stop]) == index.crc[node]
                found.append(node)
    return found


def test_every_prefix_is_a_coarser_model(built, tmp_path, capsys):
    _, model = built
    members, before = model.members(), -1
    for length in lengths(model):
        prefix, out = tmp_path / "prefix.lpc", tmp_path / "samples.npz"
        prefix.write_bytes(model.data[:length])
        nodes = whole_clouds(model, length)
        status, text, _ = call(capsys, "info", prefix, "--json")
        assert status == 0
        facts = json.loads(text)
        assert facts["complete"] is (length >= model.header.bytes)
        assert facts["samples"] == 60_000  # of the whole model

        status, _, said = call(capsys, "export", prefix, out)
        assert status == 0
        assert ("cut short" in said) is (length < model.header.bytes)
        with np.load(out) as samples:
            here = set(samples["place"].tolist()) if nodes else set()
            assert len(samples["xyz"]) == len(here)  # every one once
        expected = set().union(*(members[node] for node in nodes))
        assert here == expected, f"{length} of {model.header.bytes} bytes"
        assert len(here) >= before
        before = len(here)


@pytest.mark.parametrize("share", [0.999, 0.6, 0.2])
def test_verify_says_how_much_is_missing(built, tmp_path, capsys, share):
    _, model = built
    length = int(share * model.header.bytes)
    prefix = tmp_path / "prefix.lpc"
    prefix.write_bytes(model.data[:length])
    status, out, _ = call(capsys, "verify", prefix, "--json")
    assert status == 1
    report = json.loads(out)
    assert report["ok"] is False
    assert report["clouds_checked"] == len(whole_clouds(model, length))
    (problem,) = report["problems"]
    assert f"{length} of {model.header.bytes} bytes are here" in problem
    missing = model.header.nodes - report["clouds_checked"]
    assert f"{missing} of {model.header.nodes} clouds are missing" in problem


@pytest.mark.parametrize("share", [0.9, 0.3, 0.05])
def test_a_prefix_is_drawn(built, tmp_path, capsys, share):
    _, model = built
    prefix, out = tmp_path / "prefix.lpc", tmp_path / "out.png"
    prefix.write_bytes(model.data[: int(share * model.header.bytes)])
    status, text, _ = call(capsys, "render", prefix, out, "--size", "160x120", "--tolerance", 0.1, "--json")
    assert status == 0
    report = json.loads(text)
    assert report["starved_clouds"] > 0
    with Image.open(out) as picture:
        rgb = np.asarray(picture)
    assert (rgb != rgb[0, 0]).any(axis=2).mean() > 0.05


def test_what_ends_before_the_first_page_is_no_model_yet(built, tmp_path, capsys):
    _, model = built
    prefix = tmp_path / "prefix.lpc"
    for length in (0, 7, 100, model.header.page0 - 9):
        prefix.write_bytes(model.data[:length])
        for name in ("info", "verify"):
            status, out, said = call(capsys, name, prefix)
            assert (status, out, said.count("\n")) == (1, "", 1), (name, length, said)


def test_the_whole_header_comes_with_the_first_request(built):
    header = parse_header(built[0].read_bytes()[:HEADER_PROBE])
    assert IndexTree(header).page_range(0).stop < HEADER_PROBE
