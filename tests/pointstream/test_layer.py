"""The access layer: what a frame loop may rely on, over memory, files and a simulated line."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.frames import FRAME, check_clouds, fill, frame, subtrees, whole_index
from support.hosts import KINDS, origin_of, virtual_store, with_store
from support.layers import opened, over_line

from lpc.errors import Corrupt, LpcError, NotAModel, NotFound, RangesUnsupported, Truncated, Unavailable
from lpc.header import HEADER_PROBE, parse_header
from pointlink import virtual
from pointlink.faults import Flip, IgnoreRange, Reset, Short, Stall, Status
from pointlink.profiles import ADSL, LAN
from pointstream.layer import AccessLayer
from pointstream.stores import MemoryStore

if TYPE_CHECKING:
    from pathlib import Path

    from pointlink.origin import Origin
    from pointstream.stores import Store


@pytest.mark.parametrize("kind", KINDS)
def test_everything_wanted_comes_and_is_right(kind: str, model: bytes, tmp_path: Path) -> None:
    async def check(store: Store) -> None:
        async with opened(store) as layer:
            await fill(layer)
            assert layer.resident.all()
            check_clouds(layer, model)
            stats = layer.stats
            assert stats.resident_clouds == len(layer.index)
            assert stats.payload_bytes == len(model)
            assert stats.errors == ()
            assert stats.in_flight == stats.outstanding_bytes == 0

    with_store(kind, model, tmp_path, check)


@pytest.mark.parametrize("share", [0.006, 0.01, 0.1, 0.5])
def test_of_a_file_that_is_cut_short_no_more_is_used_than_came(share: float, model: bytes, tmp_path: Path) -> None:
    async def check(store: Store) -> None:
        async with opened(store) as layer:
            await fill(layer)
            assert parse_header(model).page0 <= layer.stats.payload_bytes <= layer.stats.bytes_received

    with_store("file", model[: int(share * len(model))], tmp_path, check)


def test_opening_and_the_first_picture_take_one_request_of_64_kib(model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        assert layer.header == parse_header(model)
        assert not layer.resident[0]
        await asyncio.sleep(0.02)  # the rest of the reply is still on its way
        assert layer.resident[0]
        assert asyncio.get_running_loop().time() < 0.2
        assert layer.stats.bytes_received < 12_000
        await layer.idle()
        assert [(exchange.start, exchange.stop) for exchange in origin.log] == [(0, HEADER_PROBE)]
        inside = whole_index(model).available(HEADER_PROBE)
        assert (layer.resident == inside).all()
        assert inside.sum() > 20

    over_line(model, check)


def test_a_model_within_the_probe_takes_one_request_in_all(scan: Any) -> None:
    from oracles.build import build_bytes

    data = build_bytes(scan.take(slice(0, 4000)), cloud_size=128, page_nodes=8)
    assert len(data) < HEADER_PROBE

    async def check(layer: AccessLayer, origin: Origin) -> None:
        await fill(layer)
        assert layer.resident.all()
        assert len(origin.log) == 1

    over_line(data, check)


def test_a_long_header_takes_a_second_request(scan: Any) -> None:
    from oracles.build import build_bytes

    data = build_bytes(scan.take(slice(0, 3000)), cloud_size=1, page_nodes=4096, crs="x" * 40_000)

    async def check(layer: AccessLayer, origin: Origin) -> None:
        assert len(layer.header.crs or "") == 40_000
        assert layer.index.page_loaded.all()
        assert len(origin.log) == 2
        assert origin.log[1].start == HEADER_PROBE

    over_line(data, check, LAN)


def test_the_line_is_kept_busy(large_model: bytes) -> None:
    """Payload over what the line could carry, from the first wants to the last cloud."""

    async def check(layer: AccessLayer, origin: Origin) -> None:
        await fill(layer)
        await layer.idle()
        stats, now = layer.stats, asyncio.get_running_loop().time()
        assert layer.resident.all()
        assert stats.wanted_seconds == pytest.approx(now, abs=2 * FRAME)
        rate = (ADSL.down_rate or 0) / 8
        # Opening the connection and asking for the header takes two round trips that cannot be saved.
        assert stats.payload_bytes / rate / (stats.wanted_seconds - 0.1) >= 0.95
        assert stats.payload_bytes >= 0.98 * stats.bytes_received
        assert stats.goodput == pytest.approx(rate, rel=0.06)  # bodies; heads are not counted
        assert stats.rtt == pytest.approx(0.05, abs=0.02)

    over_line(large_model, check)


def test_an_urgent_cloud_overtakes_the_bulk(large_model: bytes) -> None:
    for when in (1.0, 1.37, 2.2):

        async def check(layer: AccessLayer, origin: Origin, when: float = when) -> None:
            loop = asyncio.get_running_loop()
            while loop.time() < when:
                frame(layer)
                await asyncio.sleep(FRAME)
            urgent = int(np.flatnonzero(layer.index.known & ~layer.resident)[-1])
            asked = loop.time()
            while not layer.resident[urgent]:
                wants = np.flatnonzero(~layer.resident)
                layer.end_frame([urgent, *wants.tolist()], pinned=np.flatnonzero(layer.resident))
                await asyncio.sleep(0.01)
            assert loop.time() - asked <= 0.4

        over_line(large_model, check)


@pytest.mark.parametrize("most_orphans", [0, 4 << 20])
def test_clouds_that_come_before_their_ancestors(most_orphans: int, model: bytes) -> None:
    """Wants upside down and soon forgotten: whatever is kept of it, all comes in the end."""

    async def check(layer: AccessLayer, origin: Origin) -> None:
        draw = np.random.default_rng(2)
        for _ in range(40):
            wants = draw.permutation(np.flatnonzero(~layer.resident))[:3]
            layer.end_frame(wants, pinned=np.flatnonzero(layer.resident))
            await asyncio.sleep(FRAME)
        await fill(layer)
        assert layer.resident.all()
        check_clouds(layer, model)

    over_line(model, check, most_orphans=most_orphans)


def test_a_camera_that_jumps_wastes_little_of_the_line(large_model: bytes) -> None:
    """Every 100 ms the view is elsewhere: 30 wants of one region, all others forgotten."""

    async def check(layer: AccessLayer, origin: Origin) -> None:
        await layer.idle()
        draw = np.random.default_rng(7)
        for number in range(90):
            if number % 3 == 0:
                place = int(draw.integers(0, len(layer.index)))
            wants = np.arange(place, min(place + 30, len(layer.index)))
            layer.end_frame(wants[~layer.resident[wants]], pinned=[0])
            await asyncio.sleep(FRAME)
        await layer.idle()
        assert layer.stats.payload_bytes >= 0.9 * layer.stats.bytes_received

    over_line(large_model, check)


def test_wants_that_are_not_repeated_are_forgotten(model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        await layer.idle()
        frame(layer)
        asked = len(origin.log)
        layer.end_frame([], pinned=[0])
        await layer.idle()
        assert len(origin.log) <= asked + 6
        assert not layer.resident.all()
        waited = layer.stats.wanted_seconds
        await asyncio.sleep(5.0)
        assert layer.stats.wanted_seconds == waited

    over_line(model, check)


@pytest.mark.parametrize(
    "fault",
    [Reset(), Reset(after=300), Short(missing=7), Stall(seconds=90.0), Status(code=503), IgnoreRange(), Flip(at=2000)],
    ids=str,
)
def test_faults_on_the_way_are_made_good(fault: Any, model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        await fill(layer)
        assert layer.resident.all()
        check_clouds(layer, model)
        assert layer.stats.errors == ()
        assert layer.stats.payload_bytes == len(model)

    over_line(model, check, fault={2: fault, 5: fault})


def test_flipped_bits_in_a_tenth_of_the_replies_never_become_samples(model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        await fill(layer)
        assert layer.resident.all()
        check_clouds(layer, model)

    over_line(model, check, fault=lambda number: Flip(at=700) if number % 10 == 3 else None)


def test_a_damaged_cloud_is_reported_once_and_costs_what_it_tells(model: bytes) -> None:
    index = whole_index(model)
    damaged = bytearray(model)
    bad = [7, len(index) - 1]
    for node in bad:
        damaged[index.offset[node] + 20] ^= 4

    async def check(layer: AccessLayer, origin: Origin) -> None:
        await fill(layer)
        assert np.flatnonzero(~layer.resident).tolist() == subtrees(index, bad)
        assert np.flatnonzero(layer.absent).tolist() == subtrees(index, bad)
        (report,) = layer.stats.errors
        assert report.cause == "cloud"
        assert report.count == 2
        assert "checksum differs" in report.text
        asked, waited = len(origin.log), layer.stats.wanted_seconds
        for _ in range(100):
            frame(layer)
            await asyncio.sleep(FRAME)
        assert len(origin.log) == asked, "it is asked for again and again"
        assert layer.stats.wanted_seconds == waited

    over_line(bytes(damaged), check)


def test_a_damaged_page_hides_its_nodes_and_nothing_else(model: bytes) -> None:
    index = whole_index(model)
    last = len(index.page_loaded) - 1
    damaged = bytearray(model)
    damaged[index.page_range(last).start + 60] ^= 1

    async def check(layer: AccessLayer, origin: Origin) -> None:
        await fill(layer)
        hidden = np.arange(len(index)) // layer.header.page_nodes == last
        assert (layer.resident == ~hidden).all()
        assert [report.cause for report in layer.stats.errors] == ["page"]
        assert f"page {last}" in layer.stats.errors[0].text

    over_line(bytes(damaged), check)


@pytest.mark.parametrize("kind", ["local", "virtual"])
def test_any_prefix_is_a_coarser_model(kind: str, model: bytes, tmp_path: Path) -> None:
    index = whole_index(model)
    page0 = index.page_range(0)
    lengths = {page0.stop, page0.stop + 1, HEADER_PROBE - 1, HEADER_PROBE, HEADER_PROBE + 1, len(model) - 1, len(model)}
    lengths |= set(np.random.default_rng(1).integers(page0.start, len(model), 12).tolist())
    for length in sorted(lengths):

        async def check(store: Store, length: int = length) -> None:
            async with opened(store) as layer:
                await fill(layer)
                here = index.available(length)
                for page in range(len(index.page_loaded)):
                    if index.page_range(page).stop > length:
                        here[page * layer.header.page_nodes :] = False
                assert (layer.resident == here).all()
                assert layer.stats.errors == ()
                waited = layer.stats.wanted_seconds
                frame(layer)
                await asyncio.sleep(1.0) if kind == "virtual" else None
                assert layer.stats.wanted_seconds == pytest.approx(waited, abs=1e-3 if kind == "local" else 1e-9)

        with_store(kind, model[:length], tmp_path, check)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("length", [0, 1, 7, 8, 23, 24, 400])
def test_a_file_that_ends_in_its_header_is_refused(kind: str, length: int, model: bytes, tmp_path: Path) -> None:
    async def check(store: Store) -> None:
        with pytest.raises(Truncated, match="ends inside its header"):
            await AccessLayer.open(store)

    with_store(kind, model[:length], tmp_path, check)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_model_is_refused(kind: str, model: bytes, tmp_path: Path) -> None:
    async def not_one(store: Store) -> None:
        with pytest.raises(NotAModel):
            await AccessLayer.open(store)

    with_store(kind, b"<!doctype html>" * 1000, tmp_path, not_one)

    async def damaged(store: Store) -> None:
        with pytest.raises(Corrupt, match="header"):
            await AccessLayer.open(store)

    with_store(kind, model[:100] + bytes([model[100] ^ 1]) + model[101:], tmp_path, damaged)


@pytest.mark.parametrize(
    ("fault", "error"),
    [(Status(code=404), NotFound), (IgnoreRange(), RangesUnsupported), (Status(code=500), Unavailable)],
)
def test_a_host_that_cannot_serve_is_told_at_once(fault: Any, error: type[LpcError], model: bytes) -> None:
    async def run() -> None:
        origin = origin_of(model * 3, lambda number: fault)
        async with virtual_store(origin, LAN) as store:
            with pytest.raises(error):
                await AccessLayer.open(store)

    virtual.run(run())


def test_an_outage_is_waited_out_and_told_once(model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        await layer.idle()
        loop = asyncio.get_running_loop()
        down = (loop.time(), loop.time() + 30.0)
        origin.fault = lambda _: Reset() if down[0] <= loop.time() < down[1] else None
        for _ in range(30 * 31):
            frame(layer)
            await asyncio.sleep(FRAME)
        asked = len(origin.log)
        assert asked < 60, "the host is hammered"
        resident = layer.resident.copy()
        await fill(layer)
        assert layer.resident.all()
        assert resident.sum() > 20, "what was here stays here"
        (report,) = layer.stats.errors
        assert report.cause == "host"

    over_line(model, check)


def test_a_host_that_turns_us_away_later_is_not_asked_again(model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        await layer.idle()
        origin.fault = lambda _: Status(code=403)
        here = layer.resident.copy()
        for _ in range(60):
            frame(layer)
            await asyncio.sleep(FRAME)
        assert len(origin.log) <= 7
        assert (layer.resident == here).all()
        assert "403" in layer.stats.errors[0].text

    over_line(model, check)


def test_memory_stays_below_its_cap_and_the_cut_stays(model: bytes) -> None:
    """The cut wanders over the leaves; what it draws is always here, the rest goes least recently used first."""

    async def run() -> None:
        index = whole_index(model)
        async with opened(MemoryStore(model)) as layer:
            await fill(layer)
            size = layer.stats.resident_bytes
        capacity = size // 3
        async with opened(MemoryStore(model), capacity=capacity) as layer:
            for node in range(len(index)):
                path = [node]
                while index.parent[path[0]] >= 0:
                    path.insert(0, int(index.parent[path[0]]))
                for _ in range(100):
                    drawn = [n for n in path if layer.resident[n]]
                    layer.end_frame([n for n in path if not layer.resident[n]], pinned=drawn)
                    assert layer.resident[drawn].all()
                    for pinned in drawn:
                        layer.take(pinned)
                    if len(drawn) == len(path):
                        break
                    await layer.idle()
                assert layer.resident[path].all()
                assert layer.stats.resident_bytes <= capacity + size // 20
                assert layer.stats.over_bytes == 0
            assert layer.stats.evicted > 0
            with pytest.raises(KeyError):
                layer.take(int(np.flatnonzero(~layer.resident)[0]))

    asyncio.run(run())


def test_a_cut_that_fills_the_memory_asks_for_nothing_more(model: bytes) -> None:
    async def check(layer: AccessLayer, origin: Origin) -> None:
        for _ in range(200):
            frame(layer)
            await asyncio.sleep(FRAME)
        asked = len(origin.log)
        for _ in range(200):
            frame(layer)
            await asyncio.sleep(FRAME)
        assert len(origin.log) == asked, "clouds are fetched only to be dropped"
        assert not layer.resident.all()
        assert layer.stats.over_bytes < 5000

    over_line(model, check, capacity=100_000)


def test_closing_in_the_middle_leaves_nothing(model: bytes) -> None:
    async def run(when: float) -> None:
        async with virtual_store(origin_of(model), ADSL) as store:
            layer = await AccessLayer.open(store)
            end = asyncio.get_running_loop().time() + when
            while asyncio.get_running_loop().time() < end:
                frame(layer)
                await asyncio.sleep(0.011)
            await layer.close()
            assert store.meter is not None
            assert store.meter.in_flight == 0
            assert repr(store).endswith("<Lanes 0 busy, 0 idle, 0 closing>>")

    for when in (0.0, 0.01, 0.3, 0.5, 0.6):
        virtual.run(run(when))


def test_two_runs_are_the_same_run(model: bytes) -> None:
    def trace() -> list[Any]:
        events: list[Any] = []

        async def check(layer: AccessLayer, origin: Origin) -> None:
            await fill(layer)
            events.extend((exchange.start, exchange.stop) for exchange in origin.log)
            events.append((asyncio.get_running_loop().time(), layer.stats))

        over_line(model, check, fault={3: Reset(after=50), 6: Status(code=503)})
        return events

    assert trace() == trace()
