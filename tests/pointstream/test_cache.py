"""The disk cache under the access layer: fetched once, gone on without a host, and never a wrong byte."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import sys
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.frames import check_clouds, fill, frame
from support.hosts import ADDRESS, PATH, origin_of, virtual_store

import pointstream
from lpc.header import parse_header
from pointlink import virtual
from pointlink.faults import Reset
from pointlink.resources import Resource
from pointstream.cache import Cache
from pointstream.layer import AccessLayer
from pointstream.stores import open_store
from pointstream.stores.cached import CachedStore
from pointstream.stores.sparse import map_path

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from pointlink.origin import Origin


@asynccontextmanager
async def session(origin: Origin, cache: Cache) -> AsyncIterator[AccessLayer]:
    """A layer with a cache, as one run of a program has it."""
    async with virtual_store(origin) as http:
        layer = await AccessLayer.open(CachedStore(http, cache))
        try:
            yield layer
        finally:
            await layer.close()


def run(origin: Origin, cache: Cache, check: Callable[[AccessLayer], Any]) -> None:
    async def main() -> None:
        async with session(origin, cache) as layer:
            await check(layer)

    virtual.run(main())


async def everything(layer: AccessLayer) -> None:
    await fill(layer)
    assert layer.resident.all()


def entry(cache: Cache) -> Path:
    """The one file of a cache."""
    (file,) = cache.folder.glob("*/model.lpc")
    return file


def filled(folder: Path, data: bytes, **options: int) -> Cache:
    cache = Cache(folder, **options)
    run(origin_of(data), cache, everything)
    return cache


def test_what_was_fetched_once_is_not_fetched_again(model: bytes, tmp_path: Path) -> None:
    cache = filled(tmp_path, model)
    assert entry(cache).read_bytes() == model, "a fully fetched model is simply the model"
    assert not map_path(entry(cache)).exists()
    origin = origin_of(model)

    async def check(layer: AccessLayer) -> None:
        await everything(layer)
        check_clouds(layer, model)
        header = parse_header(model)
        assert [(exchange.start, exchange.stop) for exchange in origin.log] == [(0, header.page0)]
        assert layer.stats.bytes_received == header.page0, "hits count in the meter"
        assert not layer.stats.measured
        assert layer.stats.errors == ()

    run(origin, cache, check)


def test_a_part_is_kept_and_the_rest_comes_from_the_host(model: bytes, tmp_path: Path) -> None:
    cache = Cache(tmp_path)

    async def part(layer: AccessLayer) -> None:
        await layer.idle()
        layer.end_frame(np.arange(40, 60), pinned=[0])
        while layer.wanting:
            await asyncio.sleep(0.01)
            layer.end_frame(np.arange(40, 60), pinned=[0])
        held.append(layer.resident.copy())

    held: list[Any] = []
    first = origin_of(model)
    run(first, cache, part)
    origin = origin_of(model)

    async def rest(layer: AccessLayer) -> None:
        await layer.idle()
        await everything(layer)
        check_clouds(layer, model)
        index = layer.index
        own = index.offset[held[0]]
        for exchange in origin.log[1:]:
            inside = (own >= exchange.start) & (own + index.size[held[0]] <= exchange.stop)
            assert index.size[held[0]][inside].sum() <= 4096, "fetched again"

    run(origin, cache, rest)
    assert entry(cache).read_bytes() == model


def test_without_a_network_what_is_held_is_shown_at_once(model: bytes, tmp_path: Path) -> None:
    cache = filled(tmp_path, model)
    origin = origin_of(model, lambda _: Reset())

    async def check(layer: AccessLayer) -> None:
        await everything(layer)
        check_clouds(layer, model)
        assert asyncio.get_running_loop().time() < 10
        (report,) = layer.stats.errors
        assert "does not answer" in report.text

    run(origin, cache, check)


def test_a_host_that_comes_back_gives_the_rest(model: bytes, tmp_path: Path) -> None:
    cache = Cache(tmp_path)

    async def little(layer: AccessLayer) -> None:
        await layer.idle()

    run(origin_of(model), cache, little)
    origin = origin_of(model)
    origin.fault = lambda _: Reset() if asyncio.get_running_loop().time() < 20 else None

    async def check(layer: AccessLayer) -> None:
        frame(layer)
        await asyncio.sleep(1.0)
        frame(layer)
        assert layer.resident[0]
        assert not layer.resident.all()
        await everything(layer)
        check_clouds(layer, model)

    run(origin, cache, check)


def test_another_build_at_the_address_takes_a_file_of_its_own(model: bytes, other_model: bytes, tmp_path: Path) -> None:
    cache = filled(tmp_path, model)

    async def check(layer: AccessLayer) -> None:
        assert layer.header == parse_header(other_model)
        await everything(layer)
        check_clouds(layer, other_model)

    run(origin_of(other_model), cache, check)
    assert sorted(file.read_bytes() for file in tmp_path.glob("*/model.lpc")) == sorted([model, other_model])


def test_a_build_that_changes_while_the_host_was_away_is_noticed(
    model: bytes, other_model: bytes, tmp_path: Path
) -> None:
    cache = Cache(tmp_path)

    async def little(layer: AccessLayer) -> None:
        await layer.idle()

    run(origin_of(model), cache, little)
    origin = origin_of(other_model)
    origin.fault = lambda _: Reset() if asyncio.get_running_loop().time() < 20 else None

    async def check(layer: AccessLayer) -> None:
        assert layer.header == parse_header(model)
        await everything(layer)
        assert layer.header == parse_header(other_model)
        check_clouds(layer, other_model)

    run(origin, cache, check)


def test_a_build_that_changes_under_a_session_is_kept_apart(model: bytes, other_model: bytes, tmp_path: Path) -> None:
    cache, origin = Cache(tmp_path), origin_of(model)

    async def check(layer: AccessLayer) -> None:
        await layer.idle()
        origin.resources = {PATH: Resource.from_bytes(other_model)}
        await everything(layer)
        check_clouds(layer, other_model)
        assert layer.stats.build == 2

    run(origin, cache, check)
    whole, part = sorted(tmp_path.glob("*/model.lpc"), key=lambda path: map_path(path).exists())
    assert whole.read_bytes() == other_model
    with pointstream.open(str(part)) as opened:
        assert not opened.info["complete"]
        assert len(opened.read()) > 0


@pytest.mark.parametrize("seed", range(4))
def test_damage_on_the_disk_is_found_dropped_and_made_good(seed: int, model: bytes, tmp_path: Path) -> None:
    cache = filled(tmp_path, model)
    file, draw = entry(cache), np.random.default_rng(seed)
    page0 = parse_header(model).page0
    damaged = bytearray(model)
    for place in draw.integers(page0, len(model), 6).tolist():
        damaged[place] ^= 1 << int(draw.integers(8))
    file.write_bytes(damaged)

    async def check(layer: AccessLayer) -> None:
        await everything(layer)
        check_clouds(layer, model)
        assert layer.stats.errors == ()

    run(origin_of(model), cache, check)
    assert file.read_bytes() == model


@pytest.mark.parametrize("what", ["header", "short", "empty", "folder", "address", "map"])
def test_a_useless_cache_is_no_worse_than_none(what: str, model: bytes, tmp_path: Path) -> None:
    cache = filled(tmp_path, model)
    file = entry(cache)
    match what:
        case "header":
            file.write_bytes(b"x" * 100 + model[100:])
        case "short":
            os.truncate(file, 3000)
        case "empty":
            os.truncate(file, 0)
        case "folder":
            file.unlink()
            file.mkdir()
        case "address":
            (place,) = (cache.folder / "addresses").iterdir()
            place.write_bytes(b"\xff../../etc")
        case "map":
            map_path(file).mkdir()

    async def check(layer: AccessLayer) -> None:
        await everything(layer)
        check_clouds(layer, model)
        assert len(layer.stats.errors) <= 1

    for _ in range(2):
        run(origin_of(model), cache, check)


def test_a_folder_that_cannot_be_written_is_told_once(model: bytes, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")

    async def check(layer: AccessLayer) -> None:
        await everything(layer)
        (report,) = layer.stats.errors
        assert "cannot be used" in report.text

    run(origin_of(model), Cache(tmp_path / "file"), check)


def test_a_full_disk_is_told_once_and_the_next_session_uses_what_fitted(
    model: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pointstream.stores.sparse import SparseFile

    keep, left = SparseFile.keep, [30]

    def full(self: SparseFile, *arguments: Any) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        keep(self, *arguments)

    monkeypatch.setattr(SparseFile, "keep", full)

    async def check(layer: AccessLayer) -> None:
        await everything(layer)
        check_clouds(layer, model)
        (report,) = layer.stats.errors
        assert "No space left" in report.text

    cache = Cache(tmp_path)
    run(origin_of(model), cache, check)
    monkeypatch.undo()
    origin = origin_of(model)
    run(origin, cache, everything)
    assert sum(exchange.stop - exchange.start for exchange in origin.log) < len(model)


def test_the_least_recently_used_models_make_room(tmp_path: Path) -> None:
    from oracles.build import build_bytes

    from .conftest import samples

    files = [build_bytes(samples(6000, seed=seed), cloud_size=256, page_nodes=16) for seed in range(4)]
    limit = sum(map(len, files[:2])) + 40_000
    cache = Cache(tmp_path, limit=limit)
    for number in (0, 1, 0, 2, 3):
        run(origin_of(files[number]), cache, everything)
        for age, path in enumerate(sorted(tmp_path.glob("*/model.lpc"), key=lambda path: path.parent.stat().st_mtime)):
            os.utime(path.parent, (age, age))  # clocks of file systems are coarse
    kept = [path.read_bytes() for path in tmp_path.glob("*/model.lpc")]
    assert files[3] in kept
    assert files[1] not in kept
    assert sum(path.stat().st_blocks * 512 for path in tmp_path.glob("*/*")) <= limit


def test_one_model_stops_growing_at_the_limit(model: bytes, tmp_path: Path) -> None:
    filled(tmp_path, model, limit=60_000)
    assert sum(path.stat().st_blocks * 512 for path in tmp_path.glob("*/*")) <= 60_000 + 16_384


def test_hosts_do_not_share_what_they_call_the_same_build(model: bytes, tmp_path: Path) -> None:
    cache = filled(tmp_path, model)
    header = parse_header(model)
    assert cache.find(ADDRESS + "?signed=1", header.digest) is not None
    assert cache.find("http://elsewhere.test/model.lpc", header.digest) is None


KILLED = """
import asyncio, os, signal, sys, time
from pathlib import Path
from pointstream.cache import Cache
from pointstream.layer import AccessLayer
from pointstream.stores import open_store
import numpy as np

async def main():
    layer = await AccessLayer.open(open_store(sys.argv[1], clock=time.monotonic, cache=Cache(Path(sys.argv[2]))))
    while int(layer.resident.sum()) < int(sys.argv[3]):
        layer.end_frame(np.flatnonzero(~layer.resident), pinned=[])
        await asyncio.sleep(0.001)
    os.kill(os.getpid(), signal.SIGKILL)

asyncio.run(main())
"""


def test_processes_that_are_killed_leave_no_wrong_byte(model: bytes, tmp_path: Path) -> None:
    from support.servers import REPOSITORY, serve_in_thread

    (tmp_path / "www").mkdir()
    (tmp_path / "www" / "model.lpc").write_bytes(model)
    paths = os.pathsep.join(str(REPOSITORY / room) for room in ("common", "client"))
    with serve_in_thread(tmp_path / "www") as url:
        address = f"{url}/model.lpc"
        command = [sys.executable, "-c", KILLED, address, str(tmp_path / "cache")]
        started = [
            subprocess.Popen([*command, str(clouds)], env={**os.environ, "PYTHONPATH": paths}) for clouds in (20, 70)
        ]
        assert [process.wait() for process in started] == [-9, -9]
        cache = Cache(tmp_path / "cache")
        with pointstream.open(address, cache=cache) as opened:
            assert len(opened.read()) == parse_header(model).samples
    assert entry(cache).read_bytes() == model
    with pointstream.open(address, cache=cache) as opened:  # the host is gone
        assert len(opened.read()) == parse_header(model).samples


def test_an_entry_that_is_cleared_in_use_does_no_harm(model: bytes, tmp_path: Path) -> None:
    cache = Cache(tmp_path / "cache")

    async def check(layer: AccessLayer) -> None:
        await layer.idle()
        shutil.rmtree(cache.folder)
        await everything(layer)
        check_clouds(layer, model)

    run(origin_of(model), cache, check)
    store = open_store("http://host.test/x.lpc", clock=lambda: 0.0, cache=cache)
    assert isinstance(store, CachedStore)
