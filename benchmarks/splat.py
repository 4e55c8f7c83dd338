"""Splats per second of a backend: `python benchmarks/splat.py [cpu|gl] [--samples 4M]`.

Random samples of a sphere that fills 80% of a 1024x1024 picture, in clouds of 8,192 that are sorted inside, all in the
backend's memory; with back faces drawn, and dropped. Splats are submitted splats.

    frame    from the cut to the picture as an array: by the wall clock; by the CPU time of all threads; and by that of
             the calling thread, which has its share of the samples and all that is not shared: what the wall clock says
             where nothing else runs
    splats   of OpenGL, on a GPU or in software: from an idle pipeline until `glFinish` returns, without reading back;
             "timer" is what OpenGL's own timer query says of the same commands

The line above the table names the renderer. Memory: 12 bytes a sample, 512 MiB at most; more samples than fit are
uploaded again in every frame, so keep below 40M.
"""

from __future__ import annotations

import time
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import asked
import numpy as np

from lpc.attributes import Attribute
from lpc.cloud import Cloud
from pointview.camera import Camera
from pointview.refine import Culled, Cut
from pointview.render import open_backend
from pointview.render.backend import Style
from pointview.splats import CLOSING

if TYPE_CHECKING:
    from collections.abc import Callable

CLOUD = 8192
SIZE = 1024
ROUNDS = 7


def sphere_clouds(samples: int = 4_000_000) -> tuple[Any, list[Cloud]]:
    """The model's header and clouds, Morton-sorted."""
    rng = np.random.default_rng(1)
    normal = rng.normal(size=(samples, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    lattice = np.rint((normal + 1) * (2**20 - 1) / 2).astype(np.int64)
    normal_codes = _octahedral(normal)
    order = np.argsort(_morton(lattice >> 4), kind="stable")
    lattice, normal_codes = lattice[order], normal_codes[order]
    clouds = []
    for start in range(0, samples, CLOUD):
        part = lattice[start : start + CLOUD]
        corner = part.min(axis=0)
        local = part - corner
        shift = max(0, int(local.max()).bit_length() - 16)
        clouds.append(Cloud(origin=corner, position=(local >> shift).astype(np.uint16), shift=shift,
                            low=(local & ((1 << shift) - 1)).astype(np.uint32) if shift else None,
                            codes={"normal": normal_codes[start : start + CLOUD]}))  # fmt: skip
    header = SimpleNamespace(
        origin=(-1.0, -1.0, -1.0), step=2 / (2**20 - 1), nodes=len(clouds), samples=samples, cloud_size=CLOUD,
        constants={},
        attributes=(Attribute(name="normal", kind="normal", dtype="<f4", bits=8),),
    )  # fmt: skip
    return header, clouds


def _octahedral(normal: Any) -> Any:
    folded = normal / np.abs(normal).sum(axis=1, keepdims=True)
    u, v = folded[:, 0], folded[:, 1]
    below = folded[:, 2] < 0
    u, v = (np.where(below, (1 - np.abs(b)) * np.where(a >= 0, 1, -1), a) for a, b in ((u, v), (v, u)))
    return np.rint((np.stack([u, v], axis=1) + 1) * 127).astype(np.uint8)


def _morton(cells: Any) -> Any:
    code = np.zeros(len(cells), dtype=np.int64)
    for bit in range(17):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


def front(size: int) -> Camera:
    """The camera that sees the sphere in a picture of so many pixels a side."""
    return Camera(eye=(0, 0, 3), target=(0, 0, 0), up=(0, 1, 0), fov_y=45.0, width=size, height=size)


def cut_of(header: Any, clouds: list[Cloud], side_px: float, camera: Camera) -> Cut:
    """All clouds, with splats of that side at the middle of each."""
    count = len(clouds)
    lattice = np.array([cloud.origin + (cloud.position.mean(axis=0) * 2.0**cloud.shift) for cloud in clouds])
    low, high = (
        np.array([cloud.origin + (at(cloud.position, axis=0).astype(float) * 2.0**cloud.shift) for cloud in clouds])
        for at in (np.min, np.max)
    )
    depth = camera.to_camera(np.array(header.origin) + header.step * lattice)[:, 2]
    radius = header.step * np.linalg.norm(high - low, axis=1) / 2
    center = np.array(header.origin) + header.step * (low + high) / 2
    return Cut(
        nodes=np.arange(count), spacing=(side_px / CLOSING / camera.focal * depth).astype(np.float32),
        splat_px=np.full(count, side_px, dtype=np.float32),
        starved=np.zeros(count, dtype=bool), wants=np.empty(0, dtype=np.int64), pages=np.empty(0, dtype=np.int64),
        culled=Culled(), splats=sum(map(len, clouds)), max_spacing_px=1.0, places=None,
        depth_range=camera.depth_range(center, radius),
    )  # fmt: skip


class Stopwatch:
    """Times what OpenGL needs for the splats of each frame that a backend draws."""

    def __init__(self, backend: Any) -> None:
        self.wall: list[float] = []
        self.timer: list[float] = []
        self._context, self._draw = backend._context, backend._draw_samples  # noqa: SLF001
        with self._context:
            self._query = self._context.query(time=True)
        backend._draw_samples = self._timed  # noqa: SLF001

    def _timed(self, *arguments: Any) -> int:
        self._context.finish()
        start = time.perf_counter()
        with self._query:
            uploads = self._draw(*arguments)
        self._context.finish()
        self.wall.append(1e3 * (time.perf_counter() - start))
        self.timer.append(self._query.elapsed / 1e6)
        return uploads

    def milliseconds(self) -> tuple[float, float]:
        """Median of the last frames, by the wall clock and by the timer."""
        wall, timer = (float(np.median(taken[-ROUNDS:])) for taken in (self.wall, self.timer))
        return wall, timer


def milliseconds(draw: Callable[[], Any]) -> list[float]:
    """Median times of a call, after one to warm up: wall, CPU of all threads, CPU of this one."""
    draw()
    clocks = (time.perf_counter, time.process_time, time.thread_time)
    taken = []
    for _ in range(ROUNDS):
        before = [clock() for clock in clocks]
        draw()
        taken.append([clock() - start for clock, start in zip(clocks, before, strict=True)])
    return [1e3 * float(median) for median in np.median(taken, axis=0)]


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("backend", nargs="?", choices=("cpu", "gl"), default="cpu")
    parser.add_argument("--samples", type=asked.samples, default=4_000_000)
    options = parser.parse_args()
    samples = options.samples
    header, clouds = sphere_clouds(samples)
    camera = front(SIZE)
    for threads in (1, 2) if options.backend == "cpu" else (1,):
        backend = open_backend(options.backend, header, threads=threads)
        watch = Stopwatch(backend) if options.backend == "gl" else None
        print(f"{backend.name}, {threads} thread{'s' if threads > 1 else ''}, {samples:,} samples")
        print(f"{'px':>4} {'back faces':>10} {'frame ms':>9} {'M/s':>7} {'CPU M/s':>7} {'own M/s':>7}"
              + (f" {'splats ms':>9} {'M/s':>7} {'timer ms':>8} {'M/s':>7}" if watch else ""))  # fmt: skip
        for side in (0.5, 3.0, 9.0):
            cut = cut_of(header, clouds, side, camera)
            for style, name in ((Style(two_sided=True), "drawn"), (Style(), "dropped")):
                wall, cpu, own = milliseconds(partial(backend.draw, cut, clouds.__getitem__, camera, style))
                line = f"{side:4g} {name:>10} {wall:9.1f}"
                for taken in (wall, cpu, own):
                    line += f" {samples / taken / 1e3:7.1f}"
                for taken in watch.milliseconds() if watch else ():
                    line += f" {taken:9.2f} {samples / taken / 1e3:7.1f}"
                print(line)
        backend.close()


if __name__ == "__main__":
    main()
