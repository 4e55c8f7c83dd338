"""Splat sizes by place against LPC's by cloud: `python benchmarks/rules.py MODEL.lpc...`.

Each model is streamed over ADSL on the virtual clock, seen whole, near, obliquely and from afar. At 0.5, 1, 2, 5 and
10 s what is resident is drawn by both rules. PSNR in dB against everything resident, drawn by place: both rules at
equal bytes, and the difference; `--blended` compares with the blended still instead. Moments at which the view is
finished are left out.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pointlink.profiles import parse_profile
from pointstream.layer import AccessLayer, LayerOptions
from pointstream.stores import open_store
from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style, open_backend
from pointview.settle import settle
from pointview.still import CAPACITY
from pointview.stream import network
from pointview.stream.metrics import psnr_db

if TYPE_CHECKING:
    from lpc.header import Header
    from pointview.refine import SplatRule
    from pointview.render import Backend, Frame

TIMES = (0.5, 1.0, 2.0, 5.0, 10.0)
SIZE = (1024, 768)
VIEWS = ("whole", "near", "oblique", "far")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--blended", action="store_true", help="compare with blended stills")
    arguments = parser.parse_args()
    still = Style(splat="blended" if arguments.blended else "disc")
    print(f"{'model':20} {'view':8}" + "".join(f"{f'{t:g} s: paper':>13} {'place':>6} {'more':>6}" for t in TIMES))
    for path in arguments.models:
        for view in VIEWS:
            row = network.run("virtual", compare(path, view, still))
            print(f"{path.stem:20} {view:8}" + "".join(f"{a:13.2f} {b:6.2f} {b - a:+6.2f}" for a, b in row), flush=True)


def camera_of(header: Header, view: str) -> Camera:
    """Return one of the views."""
    whole = Camera.frame_model(header, width=SIZE[0], height=SIZE[1])
    low, high = np.array(header.bounds).reshape(2, 3)
    middle, up = np.array(whole.target), np.array(whole.up)
    away = np.array(whole.eye) - middle
    right = np.cross(up, away)
    target = middle + (0.2 * (high - low) if view == "near" else 0.0)
    slanted = 0.6 * away + 0.5 * right + 0.62 * np.linalg.norm(away) * up
    slanted *= 0.8 * np.linalg.norm(away) / np.linalg.norm(slanted)
    afar = 2.2 * (0.8 * away - 0.5 * right + 0.3 * np.linalg.norm(away) * up)
    eye = target + {"whole": away, "near": away / 3, "oblique": slanted, "far": afar}[view]
    return Camera(eye=tuple(eye), target=tuple(target), up=whole.up, width=SIZE[0], height=SIZE[1])


async def compare(path: Path, view: str, still: Style) -> list[tuple[float, float]]:
    """PSNR by the paper's rule and by place at each of the times until the view is finished."""
    clock, row, style = asyncio.get_running_loop().time, [], Style()
    options = LayerOptions(capacity=CAPACITY)
    whole = await AccessLayer.open(open_store(str(path), clock=time.monotonic), options=options, clock=time.monotonic)
    camera = camera_of(whole.header, view)
    backend = open_backend("cpu", whole.header, threads=2)

    def draw(layer: AccessLayer, rule: SplatRule, style: Style, backend: Backend) -> Frame:
        cut = refine(layer.index, camera, 1.0, layer.resident, splat_rule=rule)
        return backend.draw(cut, layer.take, camera, style)

    await settle(whole, lambda layer: refine(layer.index, camera, 1.0, layer.resident), clock=time.monotonic)
    reference = draw(whole, "place", still, backend)
    async with network.open_link(str(path), parse_profile("adsl"), "virtual") as connect:
        start = clock()
        layer = await AccessLayer.open(connect(), options=options, clock=clock)
        try:
            for due in TIMES:
                while True:
                    cut = refine(layer.index, camera, 1.0, layer.resident, priority="error")
                    layer.end_frame(cut.asks, pinned=cut.nodes)
                    if clock() - start >= due:
                        break
                    await asyncio.sleep(min(1 / 30, start + due - clock()) + 1e-9)
                if not len(cut.wants):
                    break
                frames = [draw(layer, rule, style, backend) for rule in ("paper", "place")]
                row.append(tuple(_psnr(frame, reference) for frame in frames))
        finally:
            await layer.close()
            await whole.close()
            backend.close()
    return row


def _psnr(frame: Frame, reference: Frame) -> float:
    psnr = psnr_db(frame.rgb, reference.rgb, (frame.node >= 0) | (reference.node >= 0))
    return float("inf") if psnr is None else psnr


if __name__ == "__main__":
    main()
