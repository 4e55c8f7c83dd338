"""Splats per second of a backend: `python benchmarks/splat.py [cpu|gl]`.

Random samples of a sphere that fills 80% of a 1024x1024 picture, in clouds of 8,192 that are sorted inside. Splats are
submitted splats; "one core" divides by the CPU time of all threads, "wall" by elapsed time.
"""

from __future__ import annotations

import sys
import time
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

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

SAMPLES = 4_000_000
CLOUD = 8192
SIZE = 1024
ROUNDS = 7


def sphere_clouds() -> tuple[Any, list[Cloud]]:
    """The model's header and clouds, Morton-sorted."""
    rng = np.random.default_rng(1)
    normal = rng.normal(size=(SAMPLES, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    lattice = np.rint((normal + 1) * (2**20 - 1) / 2).astype(np.int64)
    normal_codes = _octahedral(normal)
    order = np.argsort(_morton(lattice >> 4), kind="stable")
    lattice, normal_codes = lattice[order], normal_codes[order]
    clouds = []
    for start in range(0, SAMPLES, CLOUD):
        part = lattice[start : start + CLOUD]
        corner = part.min(axis=0)
        local = part - corner
        shift = max(0, int(local.max()).bit_length() - 16)
        clouds.append(Cloud(origin=corner, position=(local >> shift).astype(np.uint16), shift=shift,
                            codes={"normal": normal_codes[start : start + CLOUD]}))  # fmt: skip
    header = SimpleNamespace(
        origin=(-1.0, -1.0, -1.0), step=2 / (2**20 - 1), nodes=len(clouds), samples=SAMPLES, cloud_size=CLOUD,
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


def cut_of(clouds: list[Cloud], side_px: float, camera: Camera) -> Cut:
    """All clouds, with splats of about that side."""
    count = len(clouds)
    spacing = side_px / CLOSING / camera.focal * 2.4
    return Cut(
        nodes=np.arange(count), spacing=np.full(count, spacing, dtype=np.float32),
        splat_px=np.full(count, side_px, dtype=np.float32),
        starved=np.zeros(count, dtype=bool), wants=np.empty(0, dtype=np.int64), pages=np.empty(0, dtype=np.int64),
        culled=Culled(), splats=SAMPLES, max_spacing_px=1.0, places=None, depth_range=(1.9, 4.1),
    )  # fmt: skip


def milliseconds(draw: Callable[[], Any]) -> tuple[float, float]:
    """Median wall and CPU time of a call, after one to warm up."""
    draw()
    wall, cpu = [], []
    for _ in range(ROUNDS):
        start, start_cpu = time.perf_counter(), time.process_time()
        draw()
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - start_cpu)
    return 1e3 * float(np.median(wall)), 1e3 * float(np.median(cpu))


def main() -> None:
    kind: Any = sys.argv[1] if len(sys.argv) > 1 else "cpu"
    header, clouds = sphere_clouds()
    camera = Camera(eye=(0, 0, 3), target=(0, 0, 0), up=(0, 1, 0), fov_y=45.0, width=SIZE, height=SIZE)
    print(f"{'threads':>7} {'px':>4} {'back faces':>10} {'ms wall':>8} {'M/s one core':>12} {'M/s wall':>8}  backend")
    for threads in (1, 2) if kind == "cpu" else (1,):
        backend = open_backend(kind, header, threads=threads)
        for side in (0.5, 3.0, 9.0):
            cut = cut_of(clouds, side, camera)
            for style, name in ((Style(two_sided=True), "drawn"), (Style(), "dropped")):
                wall, cpu = milliseconds(partial(backend.draw, cut, clouds.__getitem__, camera, style))
                rates = f"{SAMPLES / cpu / 1e3:12.1f} {SAMPLES / wall / 1e3:8.1f}"
                print(f"{threads:7d} {side:4g} {name:>10} {wall:8.1f} {rates}  {backend.name}")
        backend.close()


if __name__ == "__main__":
    main()
