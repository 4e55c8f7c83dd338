"""The data access layer over simulated lines: how busy it keeps them, how soon things come, what it costs.

Usage: PYTHONPATH=common:server:client:tests python benchmarks/access.py [MODEL.lpc]

Without a model, one of 600,000 samples is made up. The lines are pointlink's: the real httpx, a virtual clock; every
run is the same. The frame loop stands for a viewer that wants everything, coarse first, at 30 frames a second.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import asked
import numpy as np
from oracles.build import build_bytes

from lpc.header import HEADER_PROBE
from lpc.points import PointBatch
from pointlink import virtual
from pointlink.memory import Network
from pointlink.origin import Origin
from pointlink.profiles import parse_profile
from pointlink.resources import Resource
from pointstream.layer import AccessLayer, LayerOptions
from pointstream.scheduler import LinkState, Scheduler
from pointstream.stores import MemoryStore
from pointstream.stores.dialling import OneConnection
from pointstream.stores.http import HttpStore

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from pointlink.profiles import Profile

FRAME = 1 / 30
SAMPLES = 600_000


@asynccontextmanager
async def opened(data: bytes, profile: Profile) -> AsyncIterator[AccessLayer]:
    """A layer at the end of a line."""
    origin = Origin(resources={"/model.lpc": Resource.from_bytes(data)})
    network = Network(origin, profile)
    store = HttpStore(
        "http://host/model.lpc",
        clock=asyncio.get_running_loop().time,
        transports=lambda: OneConnection(backend=network, keep_alive=None),
    )
    layer = await AccessLayer.open(store)
    try:
        yield layer
    finally:
        await layer.close()
        await network.aclose()


async def stream(data: bytes, profile: Profile, seconds: float) -> str:
    """Want everything for some seconds; a row of the table."""
    loop, first = asyncio.get_running_loop(), None
    async with opened(data, profile) as layer:
        while loop.time() < seconds:
            layer.end_frame(np.flatnonzero(~layer.resident), pinned=np.flatnonzero(layer.resident))
            if not layer.wanting:
                break
            await asyncio.sleep(FRAME)
            if first is None and layer.resident[0]:
                first = loop.time()
        stats = layer.stats
        rate = (profile.down_rate or 0) / 8
        assert first is not None
        return (
            f"{loop.time():6.2f} {stats.payload_bytes / rate / stats.wanted_seconds:8.3f}"
            f" {stats.payload_bytes / stats.bytes_received:8.3f} {stats.goodput / rate:8.3f} {stats.rtt * 1e3:7.1f}"
            f" {first:8.3f} {stats.requests:8d}"
        )


async def urgent(data: bytes, profile: Profile, when: float, *, refining: bool) -> float:
    """Seconds from asking for one far cloud, in the middle of a bulk download, until it is decoded.

    With `refining`, of a node whose parent is here, as refinement wants them; else of the last one of the file, which
    brings the ancestors along that it is decoded after.
    """
    loop = asyncio.get_running_loop()
    async with opened(data, profile) as layer:
        while loop.time() < when:
            layer.end_frame(np.flatnonzero(~layer.resident), pinned=[0])
            await asyncio.sleep(FRAME)
        missing = np.flatnonzero(layer.index.known & ~layer.resident)
        if refining:
            missing = missing[layer.resident[layer.index.parent[missing]]]
        wanted = int(missing[-1])
        start = loop.time()
        await asyncio.sleep(FRAME / 2)  # the frame that notices ends half a frame later on average
        while not layer.resident[wanted]:
            layer.end_frame([wanted, *np.flatnonzero(~layer.resident).tolist()], pinned=[0])
            await asyncio.sleep(FRAME)
        return loop.time() - start


async def jumping(data: bytes, profile: Profile) -> float:
    """Part of the received bytes that was used, with new wants every 100 ms for 60 s and a cache too small to help."""
    draw = np.random.default_rng(1)
    origin = Origin(resources={"/model.lpc": Resource.from_bytes(data)})
    network = Network(origin, profile)
    store = HttpStore(
        "http://host/model.lpc",
        clock=asyncio.get_running_loop().time,
        transports=lambda: OneConnection(backend=network, keep_alive=None),
    )
    layer = await AccessLayer.open(store, options=LayerOptions(capacity=400_000))
    for number in range(1800):
        if number % 3 == 0:
            place = int(draw.integers(0, len(layer.index)))
        wants = np.arange(place, min(place + 40, len(layer.index)))
        layer.end_frame(wants[~layer.resident[wants]], pinned=[0])
        await asyncio.sleep(FRAME)
    stats = layer.stats
    await layer.close()
    await network.aclose()
    return stats.payload_bytes / stats.bytes_received


def frame_cost(nodes: int, wants: int) -> float:
    """Milliseconds of CPU for the end of a frame with so many nodes and wants, all requests allowed."""
    draw = np.random.default_rng(0)
    sizes = draw.integers(3000, 6000, nodes)
    stop = np.cumsum(sizes)
    keys = draw.permutation(nodes)[:wants]
    link = LinkState(156_250.0, 0.05, measured=True)
    scheduler = Scheduler()
    start, turns = time.process_time(), 200
    for turn in range(turns):
        scheduler.offer(keys, stop[keys] - sizes[keys], stop[keys])
        for request in scheduler.issue(turn / 30, link):
            scheduler.landed(request, request.range.size)
            scheduler.ended(request)
    return (time.process_time() - start) / turns * 1e3


async def local(data: bytes) -> tuple[float, int]:
    """CPU seconds to take in all clouds from memory, and their samples."""
    layer = await AccessLayer.open(MemoryStore(data))
    start = time.process_time()
    while layer.wanting:
        layer.end_frame(np.flatnonzero(~layer.resident), pinned=[])
        await layer.idle()
    samples = int(layer.index.samples.sum())
    spent = time.process_time() - start
    await layer.close()
    return spent, samples


def made_up() -> bytes:
    """A bumpy sphere."""
    draw = np.random.default_rng(0)
    xyz = draw.normal(size=(SAMPLES, 3))
    xyz /= np.linalg.norm(xyz, axis=1)[:, None]
    normal = xyz.astype(np.float32)
    return build_bytes(
        PointBatch(xyz * (1 + 0.05 * np.sin(20 * xyz[:, :1])), {"normal": normal}), cloud_size=2048, page_nodes=256
    )


def main() -> None:
    model = asked.model(__doc__)
    data = made_up() if model is None else model.read_bytes()
    print(f"{len(data)} bytes, the first request has {HEADER_PROBE}")
    print("line                 time  payload   useful  goodput rtt[ms] first[s] requests")
    for name in ("adsl", "lan", "1.25M,300ms", "20M,50ms", "256k,100ms"):
        print(f"{name:18s}", virtual.run(stream(data, parse_profile(name), 30.0)))
    adsl = parse_profile("adsl")
    for refining, which in ((True, "below a resident one"), (False, "with its missing ancestors")):
        waits = [virtual.run(urgent(data, adsl, when, refining=refining)) for when in np.linspace(1.5, 4.5, 10)]
        print(f"urgent cloud on adsl, {which}: {np.median(waits):.3f} s, at worst {max(waits):.3f} s")
    print(f"jumping camera on adsl: {virtual.run(jumping(data, adsl)):.3f} of the received bytes used")
    for nodes, wants in ((100_000, 1000), (100_000, 20_000)):
        print(f"end of frame, {nodes} nodes, {wants} wants: {frame_cost(nodes, wants):.2f} ms CPU")
    spent, samples = asyncio.run(local(data))
    print(f"from memory: {samples / spent / 1e6:.2f} million samples per CPU second")


if __name__ == "__main__":
    main()
