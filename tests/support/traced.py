"""Closed surfaces as a ray meets them: what a picture of their samples is compared with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from support import models

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from support.shells import Shell

    from pointview.camera import Camera
    from pointview.render import Frame

    Array = NDArray[np.float64]

FINER = 4
"""Rays a pixel and axis for the silhouette."""


def rays(camera: Camera) -> tuple[Array, Array]:
    """Unit directions through the pixels, model space, and how long a ray is at a depth of one."""
    row, column = np.mgrid[0 : camera.height, 0 : camera.width]
    right, up = (column + 0.5 - camera.width / 2) / camera.focal, (camera.height / 2 - row - 0.5) / camera.focal
    ray = np.stack([right, up, np.ones(row.shape)], axis=-1)
    length = np.linalg.norm(ray, axis=-1)
    return (ray / length[..., None]) @ camera.rotation(), length


def trace(distance: Callable[[Array], Array], camera: Camera) -> Array:
    """Depth of the surface `distance(xyz) == 0` at each pixel, by sphere tracing; infinite where it is missed."""
    ray, length = rays(camera)
    start = np.zeros(length.shape)
    return _march(distance, np.array(camera.eye), ray, start) / length


def _march(distance: Callable[[Array], Array], eye: Array, ray: Array, along: Array, *, most: float = 50.0) -> Array:
    """Distance along each ray to the surface, infinite where it is missed; only rays still under way cost anything."""
    reached = np.full(along.shape, np.inf)
    under_way = np.flatnonzero(np.isfinite(along))
    here, direction = along.ravel()[under_way], ray.reshape(-1, 3)[under_way]
    for _ in range(200):
        left = distance(eye + here[:, None] * direction)
        here = here + left
        near = left < 1e-4
        reached.ravel()[under_way[near]] = here[near]
        go_on = ~near & (here < most)
        under_way, here, direction = under_way[go_on], here[go_on], direction[go_on]
        if not len(under_way):
            break
    return reached


@dataclass(frozen=True)
class Seen:
    """A shell from one camera.

    Parameters
    ----------
    front, back : (h, w)
        Depths at which the ray of a pixel enters the shell and leaves it again; infinite where it misses.
    beyond : (h, w)
        Distance from the silhouette, pixels, of pixels outside; 0 inside.
    """

    shell: Shell
    camera: Camera
    front: Array
    back: Array
    beyond: Array

    @classmethod
    def of(cls, shell: Shell, camera: Camera, *, silhouette: bool = True) -> Seen:
        """Trace a shell."""

        def outside(xyz: Array) -> Array:
            return shell.value(xyz) / shell.steepest

        def inside(xyz: Array) -> Array:
            return -outside(xyz)

        front = trace(outside, camera)
        ray, length = rays(camera)
        back = _march(inside, np.array(camera.eye), ray, front * length + 4e-4) / length
        beyond = np.zeros(front.shape)
        if silhouette:
            fine = replace(camera, width=FINER * camera.width, height=FINER * camera.height)
            distance = distance_transform_edt(~np.isfinite(trace(outside, fine))) / FINER
            middles = slice(FINER // 2 - 1, None, FINER), slice(FINER // 2, None, FINER)
            beyond = (distance[middles[0], middles[0]] + distance[middles[1], middles[1]]) / 2
        return cls(shell, camera, front, back, beyond)

    def holes(self, frame: Frame, slack: float) -> tuple[int, int, int]:
        """Pixels of the shell that show the background, that show its far side, and all pixels of it.

        Parameters
        ----------
        slack : float
            Model units behind the front that are still the front: a splat is flat, the surface need not be.
        """
        surface = np.isfinite(self.front)
        empty = surface & ~np.isfinite(frame.depth)
        far = (
            surface
            & np.isfinite(frame.depth)
            & (frame.depth > np.maximum((self.front + self.back) / 2, self.front + slack))
        )
        return int(empty.sum()), int(far.sum()), int(surface.sum())

    def growth(self, frame: Frame, spacing_at: Callable[[Array], Array]) -> Array:
        """How far the picture reaches beyond each piece of the silhouette, in local spacings of at least a pixel.

        Parameters
        ----------
        spacing_at : callable
            Spacing of the drawn samples around positions (n, 3), model units.
        """
        surface = np.isfinite(self.front)
        _, nearest = distance_transform_edt(~surface, return_indices=True)
        rim = distance_transform_edt(surface) == 1
        rim &= surface
        row, column = np.nonzero(np.isfinite(frame.depth) & ~surface)
        farthest = np.zeros(surface.shape)
        np.maximum.at(farthest, tuple(nearest[:, row, column]), self.beyond[row, column])
        ray, length = rays(self.camera)
        depth = self.front[rim]
        at = np.array(self.camera.eye) + ray[rim] * (length[rim] * depth)[:, None]
        return farthest[rim] / np.maximum(spacing_at(at) * self.camera.focal / depth, 1.0)


def local_spacing(samples: Array) -> Callable[[Array], Array]:
    """Spacing of samples around positions: the nearest sample's, from the disc that holds its eight neighbours."""
    tree = cKDTree(samples)

    def spacing(at: Array) -> Array:
        _, nearest = tree.query(at)
        distance, _ = tree.query(samples[nearest], k=9)
        return distance[:, 8] * np.sqrt(np.pi / 8)

    return spacing


def sphere_distance(xyz: Array) -> Array:
    return np.linalg.norm(xyz, axis=-1) - 1


def torus_distance(xyz: Array) -> Array:
    ring = np.hypot(xyz[..., 0], xyz[..., 1]) - models.TORUS[0]
    return np.hypot(ring, xyz[..., 2]) - models.TORUS[1]


def hole_share(frame: Frame, exact: Array, slack: float) -> float:
    """Share of the surface's pixels that show the background, or something more than `slack` behind the surface."""
    inside = np.isfinite(exact)
    return float((inside & ~(frame.depth < exact + slack)).sum() / inside.sum())


def growth(frame: Frame, exact: Array) -> float:
    """Mean growth of the silhouette, pixels: covered pixels outside per pixel of the rim."""
    inside = np.isfinite(exact)
    rim = inside & ~(np.roll(inside, 1, 0) & np.roll(inside, -1, 0) & np.roll(inside, 1, 1) & np.roll(inside, -1, 1))
    return float((np.isfinite(frame.depth) & ~inside).sum() / rim.sum())
