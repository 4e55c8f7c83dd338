"""Closed surfaces that are known exactly, sampled in the ways that scans are: evenly, on a grid, and most unevenly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lpc.points import PointBatch

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

BUMPS, HEIGHT = 6.0, 0.09


@dataclass(frozen=True)
class Shell:
    """The zero set of a function that is negative inside, between the spheres of radius `inner` and `outer`."""

    name: str
    value: Callable[[Array], Array]
    steepest: float  # of the function: value / steepest is no more than the distance
    inner: float
    outer: float

    def normal(self, xyz: Array, step: float = 1e-5) -> Array:
        """Unit normals, outward."""
        slope = np.stack(
            [(self.value(xyz + step * axis) - self.value(xyz - step * axis)) / (2 * step) for axis in np.eye(3)],
            axis=-1,
        )
        return slope / np.linalg.norm(slope, axis=-1, keepdims=True)

    def onto(self, xyz: Array) -> Array:
        """Move positions near the surface onto it."""
        for _ in range(4):
            xyz = xyz - self.value(xyz)[..., None] * self.normal(xyz) / self._slope(xyz)[..., None]
        return xyz

    def _slope(self, xyz: Array, step: float = 1e-5) -> Array:
        normal = self.normal(xyz)
        return (self.value(xyz + step * normal) - self.value(xyz - step * normal)) / (2 * step)

    def random(self, samples: int, *, seed: int = 0, density: Callable[[Array], Array] | None = None) -> Array:
        """Sample at random, evenly by area, or by a density of at most 1."""
        rng, found, thin = np.random.default_rng(seed), [np.empty((0, 3))], 0.02
        while sum(map(len, found)) < samples:
            direction = rng.normal(size=(400_000, 3))
            direction /= np.linalg.norm(direction, axis=1)[:, None]
            radius = rng.uniform(self.inner**3, self.outer**3, len(direction)) ** (1 / 3)
            xyz = direction * radius[:, None]
            xyz = xyz[np.abs(self.value(xyz)) < thin * self.steepest]
            xyz = xyz[np.abs(self.value(xyz)) < thin * self._slope(xyz)]  # a layer of one thickness everywhere
            if density is not None:
                xyz = xyz[rng.random(len(xyz)) < density(xyz)]
            found.append(self.onto(xyz))
        return np.concatenate(found)[:samples]

    def lattice(self, samples: int) -> Array:
        """Vertices of marching cubes: where the edges of a lattice cross the surface. About so many."""
        side, found = 0.04, np.empty((0, 3))
        for _ in range(3):
            found = self._crossings(side)
            side *= np.sqrt(len(found) / samples)
        return self._crossings(side)

    def _crossings(self, side: float) -> Array:
        count = int(np.ceil(2 * self.outer / side)) + 2
        line = (np.arange(count) - count / 2 + 0.31) * side
        value = np.stack([self.value(np.stack(np.broadcast_arrays(x, line[:, None], line), -1)) for x in line])
        found = []
        for axis in range(3):
            low, high = np.delete(value, -1, axis), np.delete(value, 0, axis)
            cell = np.argwhere((low < 0) != (high < 0))
            at, along = tuple(cell.T), line[cell]
            along[:, axis] += side * low[at] / (low[at] - high[at])
            found.append(along)
        return self.onto(np.concatenate(found))


def _sphere(xyz: Array) -> Array:
    return np.linalg.norm(xyz, axis=-1) - 1


def _torus(xyz: Array) -> Array:
    return np.hypot(np.hypot(xyz[..., 0], xyz[..., 1]) - 1.0, xyz[..., 2]) - 0.35


def _bumpy(xyz: Array) -> Array:
    return _sphere(xyz) + HEIGHT * np.sin(BUMPS * xyz).prod(axis=-1)


SPHERE = Shell("sphere", _sphere, 1.0, 0.95, 1.05)
TORUS = Shell("torus", _torus, 1.0, 0.6, 1.4)
BUMPY = Shell("bumpy", _bumpy, 1.0 + HEIGHT * BUMPS, 0.85, 1.15)
SHELLS = (SPHERE, TORUS, BUMPY)


def _fading(xyz: Array) -> Array:
    """A hundredth of the density from one end to the other."""
    return np.asarray(10.0 ** np.clip(xyz[..., 0] - 1, -2, 0))


def _halves(xyz: Array) -> Array:
    """One half thirty times denser than the other."""
    return np.where(xyz[..., 1] + 0.3 * xyz[..., 0] > 0, 1.0, 1 / 30)


SAMPLINGS = ("random", "lattice", "fading", "halves")


def sample(shell: Shell, sampling: str, samples: int, *, normals: bool, seed: int = 0) -> PointBatch:
    """Sample a shell in one of these ways."""
    if sampling == "lattice":
        xyz = shell.lattice(samples)
    else:
        density = {"random": None, "fading": _fading, "halves": _halves}[sampling]
        xyz = shell.random(samples, seed=seed, density=density)
    return PointBatch(xyz, {"normal": shell.normal(xyz).astype(np.float32)} if normals else {})
