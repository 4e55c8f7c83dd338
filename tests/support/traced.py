"""Closed surfaces as a ray meets them: what a picture of their samples is compared with."""

from __future__ import annotations

import numpy as np
from support import models


def trace(distance, camera):
    """Depth of the surface `distance(xyz) == 0` at each pixel, by sphere tracing; infinite where it is missed."""
    row, column = np.mgrid[0 : camera.height, 0 : camera.width]
    ray = np.stack(
        [
            (column + 0.5 - camera.width / 2) / camera.focal,
            (camera.height / 2 - row - 0.5) / camera.focal,
            np.ones(row.shape),
        ],
        axis=-1,
    )
    length = np.linalg.norm(ray, axis=-1)
    ray = (ray / length[..., None]) @ camera.rotation()
    along = np.zeros(row.shape)
    for _ in range(120):
        left = distance(np.array(camera.eye) + along[..., None] * ray)
        along = np.minimum(along + left, 50.0)
    return np.where(np.abs(left) < 1e-4, along / length, np.inf)


def sphere_distance(xyz):
    return np.linalg.norm(xyz, axis=-1) - 1


def torus_distance(xyz):
    ring = np.hypot(xyz[..., 0], xyz[..., 1]) - models.TORUS[0]
    return np.hypot(ring, xyz[..., 2]) - models.TORUS[1]


def hole_share(frame, exact, slack):
    """Share of the surface's pixels that show the background, or something more than `slack` behind the surface."""
    inside = np.isfinite(exact)
    return (inside & ~(frame.depth < exact + slack)).sum() / inside.sum()


def growth(frame, exact):
    """Mean growth of the silhouette, pixels: covered pixels outside per pixel of the rim."""
    inside = np.isfinite(exact)
    rim = inside & ~(np.roll(inside, 1, 0) & np.roll(inside, -1, 0) & np.roll(inside, 1, 1) & np.roll(inside, -1, 1))
    return (np.isfinite(frame.depth) & ~inside).sum() / rim.sum()
