"""Seeded samplings of known surfaces, uniform over their area, with exact normals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.points import PointBatch

if TYPE_CHECKING:
    from numpy.typing import NDArray


def sphere(n: int, *, seed: int = 0, radius: float = 1.0, color: bool = False, normals: bool = True) -> PointBatch:
    """Sample a sphere about the origin."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return _batch(directions * radius, directions, color, normals)


def torus(
    n: int, *, seed: int = 0, major: float = 1.0, minor: float = 0.35, color: bool = False, normals: bool = True
) -> PointBatch:
    """Sample a torus about the z axis: shallow enough for cones, with a hole and self-occlusion."""
    rng = np.random.default_rng(seed)
    tube = np.empty(0)
    while len(tube) < n:  # the outer side has more area
        angles = rng.uniform(0, 2 * np.pi, 2 * n)
        keep = rng.uniform(0, major + minor, 2 * n) < major + minor * np.cos(angles)
        tube = np.concatenate([tube, angles[keep]])
    tube, ring = tube[:n], rng.uniform(0, 2 * np.pi, n)
    outward = np.stack([np.cos(ring), np.sin(ring), np.zeros(n)], axis=1)
    normal = np.cos(tube)[:, None] * outward + np.sin(tube)[:, None] * [0.0, 0.0, 1.0]
    return _batch(outward * major + normal * minor, normal, color, normals)


def bumpy(n: int, *, seed: int = 0, color: bool = False, normals: bool = True) -> PointBatch:
    """Sample a rolling field over the square (0, 4) x (0, 2): an open surface, longer in x than in y than in z."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 4, n), rng.uniform(0, 2, n)
    z = 0.2 * np.sin(3 * x) * np.cos(4 * y) + 0.05 * np.sin(17 * x + 5 * y)
    dx = 0.6 * np.cos(3 * x) * np.cos(4 * y) + 0.85 * np.cos(17 * x + 5 * y)
    dy = -0.8 * np.sin(3 * x) * np.sin(4 * y) + 0.25 * np.cos(17 * x + 5 * y)
    normal = np.stack([-dx, -dy, np.ones(n)], axis=1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return _batch(np.stack([x, y, z], axis=1), normal, color, normals)


def checker(xyz: NDArray[np.float64], cell: float = 0.25) -> NDArray[np.uint8]:
    """Colour a checkerboard in space, two colours that any eye tells apart: (n, 3) uint8."""
    odd = np.floor(xyz / cell).astype(np.int64).sum(axis=1) % 2
    return np.where(odd[:, None] == 1, [230, 60, 40], [40, 90, 220]).astype(np.uint8)


def _batch(xyz: NDArray[np.float64], normal: NDArray[np.float64], color: bool, normals: bool) -> PointBatch:
    attributes: dict[str, NDArray[Any]] = {}
    if normals:
        attributes["normal"] = normal.astype(np.float32)
    if color:
        attributes["color"] = checker(xyz)
    return PointBatch(xyz, attributes)
