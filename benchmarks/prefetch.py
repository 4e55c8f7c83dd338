"""What fetching ahead of a moving camera is worth, and what it costs: `python benchmarks/prefetch.py MODEL.lpc...`.

Every model is streamed over ADSL on the virtual clock along five paths of 20 s, with `--prefetch off` and `auto`:

orbit      once around, from half the distance that shows the whole model
flight     from the whole view to a part of the model, then along it
stops      the orbit at three times the speed, 2 s of motion and 3 s of rest in turn
turns      the orbit at twice the speed, but its sense changes at random every second or two: many guesses are wrong
jumps      every second from another random place around the model: whatever is being fetched ahead, what is wanted then
           is something else

error      root mean square difference to the same view with everything resident, levels, mean over the run
starved    seconds in which a frame lacked something that it wanted
used       what the line carried meanwhile over what it could have (`link_utilisation`)
ahead      bytes fetched ahead, and the share of them that no frame drew
wait       milliseconds from the first frame that wants a cloud until it can be drawn, of the clouds that both runs came
           to want: median and worst
jump       the same for the first of the clouds wanted in the first frame after a jump: what a want finds before it

Errors and bytes are of `run_experiment`, waits of a frame loop with the same cuts and no pictures.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import asked
import numpy as np

import pointstream
from pointlink import virtual
from pointlink.profiles import parse_profile
from pointstream.layer import AccessLayer
from pointview.camera import Camera
from pointview.lookahead import Lookahead
from pointview.refine import refine
from pointview.stream.experiment import Experiment, run_experiment
from pointview.stream.network import open_link
from pointview.stream.path import ViewPath

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pointview.refine import Cut

ADSL = parse_profile("adsl")
SIZE = (320, 240)
TOLERANCE = 2.0
SECONDS = 20.0
FRAME = 1 / 30
POLLS = 4
"""Looks at what came, in a frame."""

PATHS = ("orbit", "flight", "stops", "turns", "jumps")


def main() -> None:
    models = [str(model) for model in asked.models(__doc__)]
    tasks = [(model, path, prefetch) for model in models for path in PATHS for prefetch in (False, True)]
    with ProcessPoolExecutor(2) as pool:
        rows = dict(zip(tasks, pool.map(_row, *zip(*tasks, strict=True)), strict=True))
    print(
        f"{'model':16} {'path':7} {'prefetch':8} {'error':>6} {'starved':>7} {'used':>6} {'ahead':>9} {'wasted':>6}"
        f" {'wait':>6} {'worst':>6} {'jump':>6} {'worst':>6}"
    )
    for task in tasks:
        model, path, prefetch = task
        row = rows[task]
        both = rows[model, path, False].waits.keys() & rows[model, path, True].waits.keys()
        wasted = f"{row.wasted / row.ahead:6.0%}" if row.ahead else f"{'':6}"
        print(
            f"{Path(model).stem:16} {path:7} {'auto' if prefetch else 'off':8} {row.error:6.2f} {row.starved:7.2f}"
            f" {row.used:6.3f} {row.ahead:9,} {wasted} {_middle([row.waits[node] for node in both])}"
            f" {_middle(row.jumps)}"
        )


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one run; waits in seconds."""

    error: float
    starved: float
    used: float
    ahead: int
    wasted: int
    waits: dict[int, float]
    jumps: list[float]


def _row(model: str, name: str, prefetch: bool) -> Row:
    views, jumps = _path(model, name)
    experiment = Experiment(
        model=model,
        link="adsl",
        profile=ADSL,
        clock="virtual",
        seconds=SECONDS,
        size=SIZE,
        tolerance=TOLERANCE,
        priority="error",
        prefetch="auto" if prefetch else "off",
        views=views,
    )
    report, _ = run_experiment(experiment, say=lambda _: None, progress=_silent)
    curve = [
        (entry["t"], 0.0 if entry["psnr_db"] is None else 255 * 10 ** (-entry["psnr_db"] / 20))
        for entry in report.curve
        if entry["splats"]
    ]
    error = float(np.interp(np.arange(0.5, SECONDS, 0.01), *np.array(curve).T).mean())
    waits, firsts = virtual.run(_waits(model, views, jumps, prefetch=prefetch))
    return Row(
        error=error,
        starved=report.wanted_s,
        used=report.link_utilisation or 0.0,
        ahead=report.speculative_bytes,
        wasted=report.wasted_bytes,
        waits=waits,
        jumps=firsts,
    )


async def _waits(
    model: str, views: ViewPath, jumps: list[float], *, prefetch: bool
) -> tuple[dict[int, float], list[float]]:
    """Seconds from want to arrival: of every cloud when it first came, and of the first one after each jump."""
    clock = asyncio.get_running_loop().time
    waits: dict[int, float] = {}
    firsts: list[float] = []
    since: dict[int, float] = {}
    after, jumped = set[int](), 0.0
    lookahead, pending = Lookahead(), list(jumps)
    width, height = SIZE

    def look(camera: Camera) -> Cut:
        return refine(layer.index, camera, TOLERANCE, layer.resident, priority="error")

    async with open_link(model, ADSL, "virtual") as connect:
        layer = await AccessLayer.open(connect(), clock=clock)
        ticks = 0
        while (now := clock()) < SECONDS:
            if ticks % POLLS == 0:
                camera = Camera.from_view(views.at(now), width=width, height=height)
                cut = look(camera)
                layer.end_frame(cut.asks, pinned=cut.nodes)
                if prefetch:
                    lookahead.note(now, camera)
                    layer.prefetch(lookahead.nodes(look) if layer.spare else [])
                wanted = set(cut.wants.tolist())
                if pending and now >= pending[0]:
                    pending.pop(0)
                    after, jumped = wanted - set(since), now
                since = {node: since.get(node, now) for node in wanted}
            here = [node for node in since if layer.resident[node]]
            for node in here:
                waits.setdefault(node, now - since.pop(node))
            if after & set(here):
                firsts.append(now - jumped)
                after = set()
            ticks += 1
            await asyncio.sleep(max(0.0, ticks * FRAME / POLLS - clock()))
        await layer.close()
    return waits, firsts


def _middle(waits: list[float]) -> str:
    """Median and worst, milliseconds."""
    return f"{np.median(waits) * 1e3:6.0f} {max(waits) * 1e3:6.0f}" if waits else f"{'':13}"


def _path(model: str, name: str) -> tuple[ViewPath, list[float]]:
    """Views at every frame, and the times of the jumps among them."""
    with pointstream.open(model) as opened:
        whole = Camera.frame_model(opened.header, width=SIZE[0], height=SIZE[1])
        low, high = np.array(opened.header.bounds).reshape(2, 3)
    times = np.arange(0.0, SECONDS + FRAME, FRAME)
    draw = np.random.default_rng(5)
    target, back, up = np.array(whole.target), np.array(whole.eye) - np.array(whole.target), np.array(whole.up)
    side = np.cross(up, back)

    def around(angle: float, share: float, center: Any = target) -> dict[str, Any]:
        eye = center + share * (math.cos(angle) * back + math.sin(angle) * side + 0.25 * np.linalg.norm(back) * up)
        return {"eye": eye.tolist(), "target": center.tolist(), "up": up.tolist(), "fov_y": whole.fov_y}

    jumps: list[float] = []
    turn = 2 * math.pi / SECONDS
    if name == "orbit":
        views = [around(turn * t, 0.5) for t in times]
    elif name == "stops":
        moved = np.cumsum(np.where(times % 5.0 < 2.0, FRAME, 0.0))
        views = [around(3 * turn * t, 0.5) for t in moved]
    elif name == "turns":
        sense = np.ones(len(times))
        for t in np.cumsum(draw.uniform(1.0, 2.0, 20)):
            sense[times >= t] *= -1
        views = [around(t, 0.5) for t in np.cumsum(2 * turn * sense * FRAME)]
    elif name == "jumps":
        starts = np.arange(0.0, SECONDS, 1.0)
        places = [(draw.uniform(0, 2 * math.pi), target + draw.uniform(-0.3, 0.3, 3) * (high - low)) for _ in starts]
        jumps = (starts[1:] - FRAME / 2).tolist()
        views = []
        for t in times:
            angle, center = places[min(int(t + FRAME / 2), len(places) - 1)]
            views.append(around(angle + 3.0 * turn * ((t + FRAME / 2) % 1.0), 0.3, center))
    else:
        part = target + 0.2 * (high - low) * (np.abs(up) < 0.5)
        views = []
        for t in times:
            near = 1.0 - 0.8 * min(t / 10.0, 1.0)
            center = target + (part - target) * min(t / 10.0, 1.0)
            along = 0.04 * max(t - 10.0, 0.0) * side
            views.append(around(0.0, near, center - along))
    return ViewPath(tuple(times.tolist()), tuple(views)), jumps


@contextlib.contextmanager
def _silent(_label: str, _total: int) -> Iterator[Any]:
    yield lambda _steps: None


if __name__ == "__main__":
    main()
