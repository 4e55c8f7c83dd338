"""Nothing is fetched twice: a whole model costs its bytes."""

from __future__ import annotations

import json
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from oracles.build import build_bytes
from support.frames import check_clouds, fill, whole_index
from support.hosts import origin_of, virtual_store
from support.servers import serve_in_thread

from lpc.errors import Corrupt
from lpc.header import HEADER_PROBE
from pointlink import virtual
from pointlink.faults import Flip
from pointlink.profiles import ADSL
from pointstream import command
from pointstream.layer import AccessLayer
from pointstream.reading import EVERYTHING, Reader

if TYPE_CHECKING:
    from pathlib import Path

    from lpc.points import PointBatch
    from pointlink.origin import Origin


@pytest.fixture(scope="module")
def one_page(scan: PointBatch) -> bytes:
    """A model whose clouds follow each other without pages between, so that nothing is read along."""
    return build_bytes(scan, cloud_size=256, page_nodes=4096, seed=3)


def straddling(data: bytes) -> int:
    """The cloud that the opening cuts in two."""
    index = whole_index(data)
    across = (index.offset < HEADER_PROBE) & (index.offset + index.size > HEADER_PROBE)
    return int(np.flatnonzero(across)[0])


def asked_for(origin: Origin) -> list[tuple[int, int]]:
    return sorted((exchange.start, exchange.stop) for exchange in origin.log)


def test_a_frame_loop_receives_each_byte_once(one_page: bytes) -> None:
    async def run() -> None:
        origin = origin_of(one_page)
        async with virtual_store(origin, ADSL) as store:
            layer = await AccessLayer.open(store)
            await fill(layer)
            assert layer.resident.all()
            assert layer.resident[straddling(one_page)]
            check_clouds(layer, one_page)
            assert layer.stats.bytes_received == layer.stats.payload_bytes == len(one_page)
            await layer.close()

    virtual.run(run())


def test_bulk_reading_receives_each_byte_once(one_page: bytes) -> None:
    async def run() -> None:
        origin = origin_of(one_page)
        async with virtual_store(origin, ADSL) as store:
            reader = await Reader.open(store)
            nodes = await reader.select(EVERYTHING)
            clouds = [cloud async for _, cloud in reader.clouds(nodes)]
            assert len(clouds) == reader.index.header.nodes
            assert not any(isinstance(cloud, Corrupt) for cloud in clouds)
            assert store.meter is not None
            assert store.meter.received_bytes == len(one_page)
            asked = asked_for(origin)
            assert asked[0] == (0, HEADER_PROBE)
            assert all(before[1] <= after[0] for before, after in pairwise(asked))

    virtual.run(run())


def test_a_first_half_that_was_damaged_is_not_used_again(one_page: bytes) -> None:
    """The last bytes of the opening are a cloud's first; its checksum is right only when they have come anew."""

    async def run() -> None:
        origin = origin_of(one_page, {0: Flip(at=HEADER_PROBE - 3)})
        async with virtual_store(origin, ADSL) as store:
            layer = await AccessLayer.open(store)
            await fill(layer)
            assert layer.resident.all()
            check_clouds(layer, one_page)
            node = straddling(one_page)
            assert layer.stats.bytes_received == len(one_page) + int(layer.index.size[node])
            assert layer.stats.errors == ()
            await layer.close()

    virtual.run(run())


def test_bulk_reading_does_not_keep_damage(one_page: bytes) -> None:
    async def run() -> None:
        origin = origin_of(one_page, {0: Flip(at=HEADER_PROBE - 3)})
        async with virtual_store(origin, ADSL) as store:
            reader = await Reader.open(store)
            clouds = [cloud async for _, cloud in reader.clouds(await reader.select(EVERYTHING))]
            assert not any(isinstance(cloud, Corrupt) for cloud in clouds)

    virtual.run(run())


@pytest.mark.parametrize("size", [(64, 48), (800, 600)])
def test_a_picture_of_a_small_model_costs_no_more_than_the_model(
    size: tuple[int, int], one_page: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "m.lpc").write_bytes(one_page)
    with serve_in_thread(tmp_path) as url:
        shape = f"{size[0]}x{size[1]}"
        words = ["render", f"{url}/m.lpc", str(tmp_path / "m.png"), "--size", shape, "--cache", "none", "--json"]
        assert command.run([*words, "--tolerance", "0.01", "--two-sided"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["bytes_read"] <= len(one_page)
