"""Closed surfaces that arrive over a simulated line: what every moment of the run shows, against the exact surface."""

from __future__ import annotations

import asyncio
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from support import shells, traced

from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan
from pointlink.profiles import parse_profile
from pointstream.layer import AccessLayer, LayerOptions
from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style, open_backend
from pointview.stream import network

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray
    from support.shells import Shell

    from pointview.refine import Cut

CAPACITY = 1 << 30


@dataclass(frozen=True)
class Run:
    """A surface, how it was sampled, the line it comes over, and who looks."""

    shell: Shell
    sampling: str = "random"
    normals: bool = True
    samples: int = 200_000
    link: str = "adsl"
    moving: bool = False
    size: tuple[int, int] = (400, 300)
    tolerance: float = 1.0

    def camera(self, t: float) -> Camera:
        """Stand, or turn and come nearer."""
        turn, away = (0.5 * t, 3.4 - 0.15 * min(t, 10.0)) if self.moving else (0.3, 3.2)
        eye = away * np.array([math.sin(turn) * 0.85, -math.cos(turn) * 0.85, 0.52])
        return Camera(eye=tuple(eye.tolist()), target=(0, 0, 0), up=(0, 0, 1), width=self.size[0], height=self.size[1])

    def build(self, folder: Path) -> Path:
        """Build the model, unless it is there."""
        path = folder / f"{self.shell.name}-{self.sampling}-{self.samples}-{self.normals}.lpc"
        if not path.exists():
            points = shells.sample(self.shell, self.sampling, self.samples, normals=self.normals)
            build_model([ArrayScan(points)], path, BuildOptions(threads=1), clock=time.monotonic)
        return path


@dataclass(frozen=True)
class Moment:
    """One picture of a run: pixels of the surface, how many show the background or its far side, growth of its rim."""

    t: float
    surface: int
    empty: int
    far: int
    growth: NDArray[np.float64]

    @property
    def holes(self) -> float:
        """Share of the surface that is not shown."""
        return (self.empty + self.far) / self.surface


def watch(run: Run, path: Path, *, every: float = 0.1, seconds: float = 12.0) -> list[Moment]:
    """Frames of a session as `stream.session` has them, and a picture every so many seconds until one is finished.

    The growth of silhouettes is measured at the first, second, fourth, eighth ... picture of a camera that stands.
    """
    return network.run("virtual", _watch(run, path, every, seconds))


async def _watch(run: Run, path: Path, every: float, seconds: float) -> list[Moment]:
    clock = asyncio.get_running_loop().time
    still = traced.Seen.of(run.shell, run.camera(0.0))
    moments: list[Moment] = []
    async with network.open_link(str(path), parse_profile(run.link), "virtual") as connect:
        start, due, growths = clock(), 0.0, 0
        layer = await AccessLayer.open(connect(), options=LayerOptions(capacity=CAPACITY), clock=clock)
        backend = open_backend("cpu", layer.header, threads=2)
        try:
            while (t := clock() - start) < seconds:
                camera = run.camera(t)
                cut = refine(layer.index, camera, run.tolerance, layer.resident, priority="error")
                layer.end_frame(cut.asks, pinned=cut.nodes)
                finished = bool(len(cut.nodes)) and not len(cut.wants)
                if len(cut.nodes) and (t >= due or (finished and not run.moving)):
                    due = t + every
                    seen = traced.Seen.of(run.shell, camera, silhouette=False) if run.moving else still
                    frame = backend.draw(cut, layer.take, camera, Style())
                    growth = np.empty(0)
                    if not run.moving and (len(moments) + 1 == 1 << growths or finished):
                        growths += 1
                        growth = seen.growth(frame, traced.local_spacing(_positions(layer, cut)))
                    empty, far, surface = seen.holes(frame, 2.0 * float(cut.spacing.max()))
                    moments.append(Moment(t, surface, empty, far, growth))
                if finished and not run.moving:
                    break
                await asyncio.sleep(1 / 30)
        finally:
            backend.close()
            await layer.close()
    return moments


def _positions(layer: AccessLayer, cut: Cut) -> NDArray[np.float64]:
    lattice = np.concatenate([layer.take(node).lattice() for node in cut.nodes.tolist()])
    return np.array(layer.header.origin) + layer.header.step * lattice
