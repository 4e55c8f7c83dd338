"""A camera that jumps every 100 ms for 60 s on an ADSL line: how much of what is received is used, by real cuts.

Usage: PYTHONPATH=common:server:client:tests python benchmarks/jumping.py [MODEL.lpc]

Views are close-ups of random places, refined to one pixel by `pointview.refine` 30 times a second; memory holds only a
part of the model, so that what was dropped has to come again. *Used* bytes are those of pages and clouds that passed
their checks and became resident; the rest are gaps between them, clouds cut in two and what came twice.
"""

from __future__ import annotations

import asyncio

import asked
import numpy as np
from access import FRAME, made_up

from lpc.header import parse_header
from pointlink import virtual
from pointlink.memory import Network
from pointlink.origin import Origin
from pointlink.profiles import parse_profile
from pointlink.resources import Resource
from pointstream.layer import AccessLayer, LayerOptions
from pointstream.stores.dialling import OneConnection
from pointstream.stores.http import HttpStore
from pointview.camera import Camera
from pointview.refine import refine

SECONDS = 60.0
SIZE = {"width": 640, "height": 480}


def close_up(layer: AccessLayer, draw: np.random.Generator) -> Camera:
    """A view of some node that is known, from a few of its radii away."""
    node = int(draw.choice(np.flatnonzero(layer.index.known)))
    away = draw.normal(size=3)
    distance = draw.uniform(1.5, 4.0) * max(float(layer.index.radius[node]), 0.02 * float(layer.index.radius[0]))
    target = layer.index.center[node]
    eye = target + distance * away / np.linalg.norm(away)
    view = {"eye": eye.tolist(), "target": target.tolist(), "up": [0.3, 0.4, 0.87], "fov_y": 45.0}
    return Camera.from_view(view, **SIZE)


async def jump(data: bytes, every: float, capacity: int, seed: int) -> str:
    draw, loop = np.random.default_rng(seed), asyncio.get_running_loop()
    network = Network(Origin(resources={"/model.lpc": Resource.from_bytes(data)}), parse_profile("adsl"))
    store = HttpStore(
        "http://host/model.lpc",
        clock=loop.time,
        transports=lambda: OneConnection(backend=network, keep_alive=None),
    )
    layer = await AccessLayer.open(store, options=LayerOptions(capacity=capacity))
    jumped, wants = -1.0, 0
    while loop.time() < SECONDS:
        if loop.time() - jumped >= every:
            camera, jumped = close_up(layer, draw), loop.time()
        cut = refine(layer.index, camera, 1.0, layer.resident)
        layer.end_frame(cut.asks, pinned=cut.nodes)
        wants += len(cut.wants)
        await asyncio.sleep(FRAME)
    stats = layer.stats
    await layer.close()
    await network.aclose()
    line = (parse_profile("adsl").down_rate or 0) / 8 * SECONDS
    return (
        f"{every * 1e3:5.0f} {capacity / 1e6:8.1f} {stats.payload_bytes / stats.bytes_received:6.3f}"
        f" {stats.bytes_received / line:6.3f} {stats.evicted:8d} {wants / (SECONDS / FRAME):7.1f}"
    )


def main() -> None:
    model = asked.model(__doc__)
    data = made_up() if model is None else model.read_bytes()
    print(f"{len(data)} bytes, {parse_header(data).samples} samples")
    print("every ms  memory MB  used  line  evicted  wants a frame")
    for every, capacity in ((0.1, 4_000_000), (0.1, 1_000_000), (1.0, 1_000_000)):
        print(virtual.run(jump(data, every, capacity, seed=1)))


if __name__ == "__main__":
    main()
