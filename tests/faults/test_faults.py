"""Every row of the table: what is shown is right, one report says why, others go on loading, and nothing is left."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from faults.rows import CACHES, ROWS, Row
from oracles.build import build_bytes
from support.frames import FRAME, check_clouds, frame, whole_index
from support.hosts import ADDRESS
from support.wicked import Unsteady, Wicked

from lpc.errors import LpcError
from lpc.header import parse_header
from lpc.points import PointBatch
from pointlink import virtual
from pointlink.memory import Network
from pointlink.profiles import LAN
from pointstream.cache import Cache
from pointstream.layer import AccessLayer
from pointstream.stores.cached import CachedStore
from pointstream.stores.dialling import OneConnection
from pointstream.stores.http import HttpStore
from pointstream.stores.sparse import SparseFile, map_path

if TYPE_CHECKING:
    from pathlib import Path

LONGEST = 3000
"""Frames after which everything that can come has come."""


def built(seed: int, samples: int = 36_000) -> bytes:
    draw = np.random.default_rng(seed)
    xyz = draw.normal(size=(samples, 3))
    xyz /= np.linalg.norm(xyz, axis=1)[:, None]
    attributes = {"intensity": draw.integers(0, 60_000, samples).astype(np.uint16)}
    return build_bytes(PointBatch(xyz, attributes), cloud_size=256, page_nodes=16, seed=3)


@pytest.fixture(scope="module")
def sound() -> bytes:
    """Some 150 clouds on ten pages."""
    return built(0)


@pytest.fixture(scope="module")
def fresh() -> bytes:
    """Another build."""
    return built(1, 34_000)


async def loaded(layer: AccessLayer) -> None:
    """Frames until nothing is wanted any more, or for a long time."""
    for _ in range(LONGEST):
        frame(layer)
        if not layer.wanting:
            return
        await asyncio.sleep(FRAME)


async def change(row: Row, host: Wicked, fresh: bytes) -> None:
    """What happens to the host after a while."""
    await asyncio.sleep(0.02)
    match row.later:
        case "republish":
            host.data = fresh
        case "in place":
            host.data = rebuilt(host.data)
        case "in turns":
            builds = [host.data, fresh]
            host.act = lambda number: setattr(host, "data", builds[number % 2])  # type: ignore[func-returns-value]
        case "restart":
            for writer in list(host.open):
                writer.abort()
        case "sleep":
            asyncio.get_running_loop()._clock += 3600.0  # type: ignore[attr-defined]


def rebuilt(data: bytes) -> bytes:
    """Another build of exactly the same length: another digest in header and pages, all else alike."""
    header = parse_header(data)
    digest = header.digest[::-1]
    out = bytearray(data.replace(header.digest.encode(), digest.encode()))
    length = int.from_bytes(data[12:16], "little")
    out[16:20] = zlib.crc32(out[24 : 24 + length]).to_bytes(4, "little")
    index = whole_index(data)
    for page in range(len(index.page_loaded)):
        place = index.page_range(page)
        text = out[place.start : place.stop]
        text[:8] = bytes.fromhex(digest)[:8]
        text[20:24] = zlib.crc32(text[24:], zlib.crc32(text[:20])).to_bytes(4, "little")
        out[place.start : place.stop] = text
    return bytes(out)


def run(row: Row, sound: bytes, fresh: bytes) -> None:
    data = row.data(sound)

    async def main() -> None:
        before = asyncio.all_tasks()
        host = Wicked(data, row.act, row.etag)
        network = Network(host, LAN)  # type: ignore[arg-type]
        backend = Unsteady(network, row.connect)
        clock = asyncio.get_running_loop().time
        store = HttpStore(ADDRESS, clock=clock, transports=lambda: OneConnection(backend=backend, keep_alive=None))
        try:
            layer = await AccessLayer.open(store)
        except LpcError as error:
            refused = str(error)
            assert clock() < 60.0
        else:
            refused = None
            changing = asyncio.create_task(change(row, host, fresh))
            first = layer.resident
            await loaded(layer)
            await changing
            await loaded(layer)
            check(row, layer, host, sound, fresh, first)
            await layer.close()
        assert (refused is not None) == (row.shown == "nothing"), refused
        if refused is not None:
            assert re.fullmatch(f".*({row.report}).*", refused), refused
        assert store.meter is not None
        assert store.meter.in_flight == 0
        assert "0 busy, 0 idle, 0 closing" in repr(store._lanes)
        await network.aclose()
        for _ in range(3):
            await asyncio.sleep(0)
        assert asyncio.all_tasks() <= before, asyncio.all_tasks() - before

    virtual.run(main())


def check(row: Row, layer: AccessLayer, host: Wicked, sound: bytes, fresh: bytes, first: Any) -> None:
    stats, here = layer.stats, layer.resident
    match row.shown:
        case "everything":
            assert here.all()
        case "all but the damaged":
            assert 20 < here.sum() < len(here)
            assert not layer.wanting, "something is waited for that cannot come"
        case "what had come":
            assert here[0]
            assert here.sum() >= first.sum() or stats.build > 1
            assert not here.all()
        case "the new build":
            assert here.all()
            assert layer.header == parse_header(host.data)
            assert stats.build == 2
    if row.later != "in turns":
        check_clouds(layer, host.data if row.shown == "the new build" else sound)
    if row.report is None:
        assert stats.errors == ()
    else:
        assert any(re.search(row.report, report.text) for report in stats.errors), stats.errors
        assert len(stats.errors) <= 2
        assert not any("\n" in report.text for report in stats.errors)
    assert stats.in_flight == stats.outstanding_bytes == 0 or layer.wanting
    assert len(host.log) < 700


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_fault(row: Row, sound: bytes, fresh: bytes) -> None:
    run(row, sound, fresh)


@pytest.mark.parametrize("name", CACHES)
def test_fault_of_the_cache(name: str, sound: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A session with a cache that something happened to; all comes, one report at most, the next is fine."""
    cache = Cache(tmp_path / "cache")

    async def session(clouds: int | None = None) -> tuple[Any, ...]:
        network = Network(Wicked(sound), LAN)  # type: ignore[arg-type]
        clock = asyncio.get_running_loop().time
        http = HttpStore(ADDRESS, clock=clock, transports=lambda: OneConnection(backend=network, keep_alive=None))
        layer = await AccessLayer.open(CachedStore(http, cache))
        if clouds is None:
            await loaded(layer)
            assert layer.resident.all()
            check_clouds(layer, sound)
        else:
            await layer.idle()
        reports = layer.stats.errors
        await layer.close()
        await network.aclose()
        return reports

    virtual.run(session(1))
    (file,) = cache.folder.glob("*/model.lpc")
    keep = SparseFile.keep
    match name:
        case "disk full":
            monkeypatch.setattr(SparseFile, "keep", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
        case "read-only":
            monkeypatch.setattr(
                SparseFile, "__init__", lambda *_, **__: (_ for _ in ()).throw(OSError(30, "Read-only"))
            )
        case "corrupted":
            size = file.stat().st_size
            file.write_bytes(np.random.default_rng(1).bytes(size))
        case "map torn":
            os.truncate(map_path(file), map_path(file).stat().st_size - 7)
        case "gone":
            shutil.rmtree(cache.folder)
    reports = virtual.run(session())
    if CACHES[name] is None:
        assert reports == ()
    else:
        (report,) = reports
        assert re.search(CACHES[name] or "", report.text)
    monkeypatch.undo()
    assert SparseFile.keep is keep
    assert virtual.run(session()) == ()
