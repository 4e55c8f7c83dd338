"""CPU time of one refinement over 100,000 resident nodes: `python benchmarks/refine.py`.

The model is a binary tree over a sphere: 131,071 nodes of 2,048 samples, 65,536 of them leaves, 268 million samples.
"""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import asked
import numpy as np

from lpc.density import Density
from pointview.budget import allowance
from pointview.camera import Camera
from pointview.refine import refine

if TYPE_CHECKING:
    from collections.abc import Callable

LEVELS = 17
CLOUD_SIZE = 2048
ROUNDS = 15


def sphere_index() -> Any:
    """An index tree over the unit sphere: longitude and latitude halved in turn, all cells of a level of equal area."""
    center, radius, axis, angle, level = [], [], [], [], []
    for depth in range(LEVELS):
        rows, columns = 1 << (depth // 2), 1 << ((depth + 1) // 2)
        row, column = np.divmod(_interleaved(depth), columns)
        z0, z1 = -1 + 2 * row / rows, -1 + 2 * (row + 1) / rows
        a0, a1 = 2 * np.pi * column / columns, 2 * np.pi * (column + 1) / columns
        grid = np.stack([
            np.stack([np.sqrt(1 - z**2) * np.cos(a), np.sqrt(1 - z**2) * np.sin(a), z], axis=1)
            for z in (z0, (z0 + z1) / 2, z1) for a in (a0, (3 * a0 + a1) / 4, (a0 + a1) / 2, (a0 + 3 * a1) / 4, a1)
        ])  # fmt: skip
        middle = grid.mean(axis=0)
        far = np.linalg.norm(grid - middle, axis=2).max(axis=0)
        length = np.linalg.norm(middle, axis=1, keepdims=True)
        out = middle / np.maximum(length, 1e-9)
        spread = np.arccos(np.clip(np.einsum("gij,ij->gi", grid, out).min(axis=0), -1, 1))
        center.append(middle)
        radius.append(far)
        axis.append(out)
        angle.append(np.where(spread < 1.5, spread, np.pi))
        level.append(np.full(len(row), depth))
    nodes = 2**LEVELS - 1
    numbers = np.arange(nodes)
    children = np.stack([2 * numbers + 1, 2 * numbers + 2], axis=1)
    children[children >= nodes] = -1
    levels = np.concatenate(level)
    index = SimpleNamespace(
        header=SimpleNamespace(nodes=nodes, page_nodes=1024, bounds=(-1, -1, -1, 1, 1, 1)),
        known=np.ones(nodes, dtype=bool),
        center=np.concatenate(center),
        radius=np.concatenate(radius),
        spacing=np.sqrt(4 * np.pi / CLOUD_SIZE / (2.0 ** (levels + 1) - 1)),
        samples=np.full(nodes, CLOUD_SIZE),
        subtree=CLOUD_SIZE * (2 ** (LEVELS - levels) - 1),
        size=np.full(nodes, 5000),
        cone_axis=np.concatenate(axis).astype(np.float32),
        cone_angle=np.concatenate(angle).astype(np.float32),
        children=children.astype(np.int32),
        parent=np.where(numbers > 0, (numbers - 1) // 2, -1).astype(np.int32),
        level=levels.astype(np.uint8),
        density=Density(nodes),
    )
    index.density.add(index, [np.flatnonzero(levels == depth) for depth in range(LEVELS)])
    return index


def _interleaved(depth: int) -> Any:
    """Cell number row * columns + column of each node of a level, in breadth-first order."""
    row = column = np.zeros(1, dtype=np.int64)
    for split in range(depth):
        low, high = (2 * row, 2 * row + 1) if split % 2 else (2 * column, 2 * column + 1)
        both = np.stack([low, high], axis=1).ravel()
        row, column = (both, np.repeat(column, 2)) if split % 2 else (np.repeat(row, 2), both)
    return row * (1 << ((depth + 1) // 2)) + column


def milliseconds(work: Callable[..., Any], *arguments: Any, **options: Any) -> float:
    """Median CPU time of a call."""
    times = []
    for _ in range(ROUNDS):
        start = time.process_time()
        work(*arguments, **options)
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))


def main() -> None:
    asked.nothing(__doc__)
    index = sphere_index()
    resident = np.ones(index.header.nodes, dtype=bool)
    some = np.random.default_rng(0).random(index.header.nodes) < 0.9
    some[:1000] = True
    print(f"{index.header.nodes} nodes")
    print(f"{'view':36} {'px':>5} {'clouds':>7} {'Msplats':>8} {'wants':>6} {'refine ms':>10} {'budget ms':>9}")
    for name, distance, size in (
        ("whole, 1024x768", 3.0, (1024, 768)),
        ("whole, 1920x1080", 3.0, (1920, 1080)),
        ("close, 1024x768", 1.3, (1024, 768)),
        ("very close, 1024x768", 1.03, (1024, 768)),
    ):
        camera = Camera(eye=(0, -distance, 0), target=(0.2, 0, 0.1), up=(0, 0, 1), width=size[0], height=size[1])
        for tolerance in (2.0, 1.0, 0.5):
            for label, here in (("", resident), (", 10% missing", some)):
                cut = refine(index, camera, tolerance, here)
                took = milliseconds(refine, index, camera, tolerance, here, priority="error")
                counted = milliseconds(allowance, index, camera, cut.splats // 2, here, at_least=tolerance)
                print(
                    f"{name + label:36} {tolerance:5g} {len(cut.nodes):7d} {cut.splats / 1e6:8.2f} {len(cut.wants):6d}"
                    f" {took:10.2f} {counted:9.2f}"
                )


if __name__ == "__main__":
    main()
