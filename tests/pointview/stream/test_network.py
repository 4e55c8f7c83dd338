"""The same experiment over memory, sockets, files and hosts, on both clocks."""

from __future__ import annotations

import asyncio
import threading
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING

import pytest
from support.servers import serve_in_thread
from support.streaming import stream

from lpc.errors import NotFound, RangesUnsupported, StoreError, Unavailable
from lpc.ranges import ByteRange
from pointlink.profiles import parse_profile
from pointstream.command import run as command
from pointview.stream import network

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def address(small):
    with serve_in_thread(small.parent) as url:
        yield f"{url}/{small.name}"


def fetch(target: object, link: str, clock: str, wanted: ByteRange) -> bytes:
    async def read() -> bytes:
        async with network.open_link(str(target), parse_profile(link), clock) as connect:
            store = connect()
            try:
                return await store.read(wanted)
            finally:
                await store.close()

    return network.run(clock, read())


@pytest.mark.parametrize("clock", ["real", "virtual"])
@pytest.mark.parametrize("link", ["none", "20M,2ms"])
@pytest.mark.parametrize("target", ["path", "address"])
def test_every_way_gives_the_bytes_of_the_file(small, address, target, link, clock):
    data = small.read_bytes()
    assert fetch(small if target == "path" else address, link, clock, ByteRange(1000, 70_000)) == data[1000:70_000]


def test_a_virtual_link_takes_its_time_in_none(endless):
    async def timed() -> float:
        loop = asyncio.get_running_loop()
        async with network.open_link(str(endless), parse_profile("adsl"), "virtual") as connect:
            store = connect()
            await store.read(ByteRange(0, 1_250_000))
            await store.close()
            return loop.time()

    # two round trips of 50 ms, 8 s at 1.25 Mbit/s, and the head of the reply
    assert network.run("virtual", timed()) == pytest.approx(8.1, abs=0.01)


def test_a_virtual_run_from_a_host_is_that_from_the_file(small, address, tmp_path):
    options = ("--seconds", 1.2)
    remote, local = (stream(target, tmp_path / name, *options) for target, name in ((address, "a"), (small, "b")))
    assert remote["first_picture_s"] == pytest.approx(local["first_picture_s"], abs=0.05)
    assert remote["settled_s"] == pytest.approx(local["settled_s"], abs=0.05)
    assert (remote["samples"], remote["payload_bytes"]) == (local["samples"], local["payload_bytes"])


@pytest.mark.parametrize("target", ["path", "address"])
def test_a_real_clock_over_sockets(small, address, tmp_path, target):
    report = stream(small if target == "path" else address, tmp_path, "--seconds", 2, clock="real")
    assert report["clock"] == "real"
    assert report["errors"] == []
    # The line cannot be quicker than it is; how much slower this machine makes it is not for a test to say.
    assert report["first_picture_s"] > 0.1
    assert all(entry["bytes"] <= 156_250 * entry["t"] for entry in report["curve"])
    assert report["curve"][-1]["splats"] > 0
    assert 0 < report["link_utilisation"] <= 1


def test_without_a_link_there_is_nothing_to_use(small, tmp_path):
    report = stream(small, tmp_path, "--seconds", 1, link="none", clock="real")
    assert report["link"] == "none"
    assert report["link_utilisation"] is None
    assert report["samples"] > 0
    report = stream(small, tmp_path, "--seconds", 0.5, link="none", clock="virtual")
    assert report["link_utilisation"] is None
    assert report["settled_s"] <= 0.2


@contextmanager
def host_without_ranges(folder: Path):
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_hosts_that_do_not_do_on_a_virtual_clock(small, tmp_path):
    wanted = ByteRange(0, 100)
    with host_without_ranges(small.parent) as url:
        with pytest.raises(RangesUnsupported, match="pointstream serve"):
            fetch(f"{url}/{small.name}", "adsl", "virtual", wanted)
        with pytest.raises(Unavailable, match="404"):
            fetch(f"{url}/absent.lpc", "adsl", "virtual", wanted)
    with pytest.raises(Unavailable, match="cannot be read"):
        fetch(f"{url}/{small.name}", "adsl", "virtual", wanted)
    with pytest.raises(NotFound, match="absent"):
        fetch(tmp_path / "absent.lpc", "adsl", "virtual", wanted)


@pytest.mark.parametrize("clock", ["real", "virtual"])
def test_what_is_no_address(clock):
    with pytest.raises(StoreError, match=r"no .*address"):
        fetch("http://[::1/model.lpc", "adsl", clock, ByteRange(0, 100))


def test_who_asks_is_told_through_the_front():
    """User and password of an address go on to the host behind the link."""

    async def through() -> str:
        async with network._front("http://me:word@127.0.0.1:9/a.lpc", parse_profile("adsl")) as address:
            return address

    address = network.run("real", through())
    assert address.startswith("http://me:word@127.0.0.1:")
    assert address.endswith("/a.lpc")


def test_no_host_is_one_line(tmp_path, capsys):
    with host_without_ranges(tmp_path) as url:
        pass
    assert command(["stream", f"{url}/m.lpc", "--link", "adsl", "--clock", "virtual", "--report", str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.splitlines()[-1].startswith("pointstream: http://127.0.0.1")
    assert "Traceback" not in said.err
