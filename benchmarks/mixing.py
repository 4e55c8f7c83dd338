"""The mixing interface of two gases as samples: a convoluted isosurface of great depth complexity, at any size.

LPC's largest model is an isosurface of a Richtmyer-Meshkov simulation that nobody can download today. This one has
what matters of it: bubbles and spikes at both ends of a turbulent layer, sheets folded behind sheets from everywhere,
normals from the gradient. Stirring folds an interface until it lies in layers along the level sets of a smooth field,
so the surface is where

    G(x, y, z) = turbulence + bubbles(x, y) + confinement(z)

takes one of a number of evenly spaced values, inside a box of about 1 x 1 x 0.94 (2048 x 2048 x 1920 in the paper).
`turbulence` are plane waves of all directions over three octaves, `bubbles` a few waves across, and `confinement` is a
power of z that leaves one gas alone at either end. The surface depends on the seed and the wanted depth, so two
sizes are two samplings of one surface.

Samples are where axis-parallel lines cross the surface, which is what the vertices of a marching-cubes mesh are. The
box is cut into bricks; how many lines a brick gets decides the size, so a small sampling costs little and a large one
needs one brick's memory a thread. On a line, a table of waves gives G at 16 points and more a wave length, a cubic the
crossings between them, and one exact evaluation the normal and the last correction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

STEPS = 16
"""Points of a line in a brick."""

EDGE, HEIGHT = 16, 15
"""Bricks along x and y, and along z."""

SHORTEST, LONGEST = 0.0625, 0.5
"""Wave lengths of the turbulence; amplitudes grow with them."""

WAVES, BUBBLES = 40, 8
BUBBLE, CONFINEMENT, SHARPNESS = 0.6, 3.0, 8
"""Amplitude of the waves across, and of the confinement at the ends and its power of z, over that of the turbulence."""

FURTHEST = 2.0
"""Largest value of G that the interface takes."""

DEPTH_PER_SHEET = 1.55
"""Mean crossings from the worst viewpoint, a corner of the box, for each value that G may take; see `depths`."""

BRICKS = EDGE**2 * HEIGHT
SIZE = np.array([1.0, 1.0, HEIGHT / EDGE])
"""Sides of the box."""

PILOT = 8
"""One brick of so many is counted first, in each layer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Interface:
    """One surface.

    Parameters
    ----------
    sheet : float
        Distance of the values that the surface is made of.
    waves : ndarray, (m, 3) float64
        Wave vectors, radians per unit.
    amplitude, phase : ndarray, (m,) float64
    seed : int
    """

    sheet: float
    waves: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    phase: NDArray[np.float64]
    seed: int

    @classmethod
    def of(cls, seed: int = 0, depth: float = 55.0) -> Interface:
        """Choose the waves.

        Parameters
        ----------
        seed : int
        depth : float
            Wanted mean number of crossings of rays from the worst viewpoint.
        """
        rng = np.random.default_rng(seed)
        # Directions evenly over the sphere, so that the depth is much the same from everywhere.
        number = np.arange(WAVES)
        up, turn = 1 - (2 * number + 1) / WAVES, np.pi * (3 - np.sqrt(5)) * number
        flat = np.sqrt(1 - up**2)
        directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), up], axis=1)
        length = SHORTEST * (LONGEST / SHORTEST) ** rng.permutation(number / (WAVES - 1))
        angle = 2 * np.pi * (np.arange(BUBBLES) + rng.random(BUBBLES)) / BUBBLES
        across = 2 * np.pi / rng.uniform(0.15, 0.4, BUBBLES)
        bubbles = np.stack([across * np.cos(angle), across * np.sin(angle), np.zeros(BUBBLES)], axis=1)
        strength = length * np.sqrt(2 / (length**2).sum())
        return cls(
            sheet=2 * FURTHEST * DEPTH_PER_SHEET / depth,
            waves=np.concatenate([directions * (2 * np.pi / length)[:, None], bubbles]),
            amplitude=np.concatenate([strength, np.full(BUBBLES, BUBBLE * np.sqrt(2 / BUBBLES))]),
            phase=rng.uniform(0, 2 * np.pi, WAVES + BUBBLES),
            seed=seed,
        )

    def brick(self, number: int, lines: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Positions and normals (n, 3) where about `lines` lines along each axis cross the surface in a brick."""
        corner = np.array([number % EDGE, number // EDGE % EDGE, number // EDGE**2]) / EDGE
        rng = np.random.default_rng((self.seed, number))
        counts = np.floor(lines + rng.random(3)).astype(np.int64)
        start = rng.random((3, 2))
        room = int(counts.sum()) * 16 + 64
        while True:
            found = np.empty((room, 6), np.float32)
            count = _brick(corner, self.sheet, self.waves, self.amplitude, self.phase, counts, start, found)
            if count <= room:
                return found[:count, :3], found[:count, 3:]
            room = count

    def lines_for(self, samples: int) -> float:
        """Lines along each axis in each brick that meet the surface about so often, from bricks here and there."""
        lines, layer = 60.0, EDGE**2
        rng = np.random.default_rng(self.seed)
        chosen = np.concatenate([rng.permutation(layer)[: layer // PILOT] + layer * z for z in range(HEIGHT)])
        each = np.mean([len(self.brick(int(number), lines)[0]) for number in chosen]) / lines
        return samples / (each * BRICKS)

    def depths(self, viewpoints: NDArray[np.float64], rays: int) -> list[NDArray[np.int64]]:
        """Crossings of random rays that meet the box, from viewpoints outside it (v, 3)."""
        rng = np.random.default_rng(self.seed)
        found = []
        for viewpoint in viewpoints:
            directions = _seen(viewpoint, rays, rng)
            count = np.zeros(rays, np.int64)
            _count(viewpoint, directions, self.sheet, self.waves, self.amplitude, self.phase, count)
            found.append(count)
        return found


def _seen(viewpoint: NDArray[np.float64], rays: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Directions (rays, 3) that meet the box, as evenly spread as the pixels of a picture are."""
    forward = SIZE / 2 - viewpoint
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    half = 1.2 * np.linalg.norm(SIZE) / 2 / np.linalg.norm(SIZE / 2 - viewpoint)
    kept: list[NDArray[np.float64]] = []
    while sum(map(len, kept)) < rays:
        plane = rng.uniform(-half, half, (4 * rays, 2))
        beams = forward + plane[:, :1] * right + plane[:, 1:] * up
        beams /= np.linalg.norm(beams, axis=1)[:, None]
        with np.errstate(divide="ignore"):
            near, far = -viewpoint / beams, (SIZE - viewpoint) / beams
        kept.append(beams[np.minimum(near, far).max(axis=1) < np.maximum(near, far).min(axis=1)])
    return np.concatenate(kept)[:rays]


@njit(cache=True, nogil=True)
def _brick(
    corner: Any, sheet: float, waves: Any, amplitude: Any, phase: Any, counts: Any, start: Any, found: Any
) -> int:
    """Fill `found` with positions and normals of one brick; how many there are, even if `found` has less room."""
    modes = len(waves)
    step, width = 1 / (EDGE * STEPS), 1 / EDGE
    points = STEPS + 3  # one more at either end for the cubic
    by_mode = np.empty((2, modes, points), np.float32)
    by_point = np.empty((points, 2, modes), np.float32)
    line = np.empty((2, modes), np.float32)
    values = np.empty(points, np.float32)
    along = np.empty(modes, np.float32)
    gradient = np.empty(3)
    at = np.empty(3)
    total = 0
    for axis in range(3):
        second, third = (axis + 1) % 3, (axis + 2) % 3
        for mode in range(modes):
            along[mode] = waves[mode, axis] * step
            for i in range(points):
                angle = waves[mode, axis] * (corner[axis] + (i - 1) * step)
                by_mode[0, mode, i] = by_point[i, 0, mode] = np.cos(angle)
                by_mode[1, mode, i] = by_point[i, 1, mode] = np.sin(angle)
        for number in range(counts[axis]):
            # A low-discrepancy sequence: the plastic number's, of two dimensions.
            at[second] = corner[second] + ((start[axis, 0] + number * 0.7548776662466927) % 1.0) * width
            at[third] = corner[third] + ((start[axis, 1] + number * 0.5698402909980532) % 1.0) * width
            for mode in range(modes):
                angle = waves[mode, second] * at[second] + waves[mode, third] * at[third] + phase[mode]
                line[0, mode] = amplitude[mode] * np.cos(angle)
                line[1, mode] = amplitude[mode] * np.sin(angle)
            for i in range(points):
                values[i] = _confinement(corner[2] + (i - 1) * step if axis == 2 else at[2])
            _add_waves(line, by_mode, values)
            for i in range(1, STEPS + 1):
                first, last = _levels(values[i], values[i + 1], sheet)
                for level in range(first, last):
                    wanted = (level + 0.5) * sheet
                    part = _crossing(
                        values[i - 1] - wanted, values[i] - wanted, values[i + 1] - wanted, values[i + 2] - wanted
                    )
                    if total < len(found):
                        at[axis] = corner[axis] + (i - 1 + part) * step
                        value = _evaluate(line, by_point[i], along, np.float32(part), waves, gradient)
                        value += _confinement(at[2]) - wanted
                        gradient[2] += _confinement_slope(at[2])
                        length = np.sqrt(gradient[0] ** 2 + gradient[1] ** 2 + gradient[2] ** 2)
                        move = min(max(value / length, -0.1 * step), 0.1 * step)
                        # One gas lies between the first and the second value, the other between the next two.
                        out = (1 if level % 2 else -1) / length
                        for k in range(3):
                            found[total, k] = at[k] - move * gradient[k] / length
                            found[total, 3 + k] = gradient[k] * out
                    total += 1
    return total


@njit(cache=True, nogil=True)
def _levels(one: float, other: float, sheet: float) -> tuple[int, int]:
    """Which of the values (level + 0.5) * sheet are between two, as a range."""
    first = math.ceil(max(min(one, other), -FURTHEST) / sheet - 0.5)
    last = math.ceil(min(max(one, other), FURTHEST) / sheet - 0.5)
    return first, last


@njit(cache=True, nogil=True)
def _confinement(z: float) -> float:
    away = 2 * EDGE / HEIGHT * z - 1
    return CONFINEMENT * away * abs(away) ** (SHARPNESS - 1)


@njit(cache=True, nogil=True)
def _confinement_slope(z: float) -> float:
    return CONFINEMENT * SHARPNESS * abs(2 * EDGE / HEIGHT * z - 1) ** (SHARPNESS - 1) * 2 * EDGE / HEIGHT


@njit(cache=True, nogil=True)
def _add_waves(line: Any, table: Any, values: Any) -> None:
    """Add the real parts of the products of a line's complex amplitudes and the waves along it."""
    for mode in range(0, line.shape[1], 4):
        c0, s0, c1, s1 = line[0, mode], line[1, mode], line[0, mode + 1], line[1, mode + 1]
        c2, s2, c3, s3 = line[0, mode + 2], line[1, mode + 2], line[0, mode + 3], line[1, mode + 3]
        for i in range(len(values)):
            first = (c0 * table[0, mode, i] - s0 * table[1, mode, i]) + (
                c1 * table[0, mode + 1, i] - s1 * table[1, mode + 1, i]
            )
            second = (c2 * table[0, mode + 2, i] - s2 * table[1, mode + 2, i]) + (
                c3 * table[0, mode + 3, i] - s3 * table[1, mode + 3, i]
            )
            values[i] += first + second


@njit(cache=True, nogil=True)
def _crossing(before: float, low: float, high: float, after: float) -> float:
    """Where between 0 and 1 the cubic through four values at -1, 0, 1, 2 is zero."""
    a = (after - 3 * high + 3 * low - before) / 6
    b = (high - 2 * low + before) / 2
    c = high - low - a - b
    part = low / (low - high)
    for _ in range(3):
        slope = (3 * a * part + 2 * b) * part + c
        if slope != 0:
            part = min(max(part - (((a * part + b) * part + c) * part + low) / slope, 0.0), 1.0)
    return part


@njit(cache=True, nogil=True, fastmath={"reassoc", "nsz", "contract"})
def _evaluate(line: Any, table: Any, along: Any, part: Any, waves: Any, gradient: Any) -> float:
    """Waves and their gradient, `part` of a step beyond a point of the table."""
    value = np.float32(0)
    x, y, z = np.float32(0), np.float32(0), np.float32(0)
    for mode in range(len(along)):
        angle = along[mode] * part  # below 0.8 a step: the series are exact in single precision
        square = angle * angle
        cos = np.float32(1) + square * (
            np.float32(-1 / 2)
            + square * (np.float32(1 / 24) + square * (np.float32(-1 / 720) + square * np.float32(1 / 40320)))
        )
        sin = angle * (
            np.float32(1)
            + square * (np.float32(-1 / 6) + square * (np.float32(1 / 120) - square * np.float32(1 / 5040)))
        )
        re = table[0, mode] * cos - table[1, mode] * sin
        im = table[1, mode] * cos + table[0, mode] * sin
        value += line[0, mode] * re - line[1, mode] * im
        turned = line[0, mode] * im + line[1, mode] * re
        x -= turned * np.float32(waves[mode, 0])
        y -= turned * np.float32(waves[mode, 1])
        z -= turned * np.float32(waves[mode, 2])
    gradient[0], gradient[1], gradient[2] = x, y, z
    return value


@njit(cache=True, nogil=True)
def field(xyz: Any, waves: Any, amplitude: Any, phase: Any) -> float:
    """G at one position, wave by wave."""
    value = _confinement(xyz[2])
    for mode in range(len(waves)):
        angle = waves[mode, 0] * xyz[0] + waves[mode, 1] * xyz[1] + waves[mode, 2] * xyz[2] + phase[mode]
        value += amplitude[mode] * np.cos(angle)
    return value


@njit(cache=True, nogil=True)
def _count(eye: Any, rays: Any, sheet: float, waves: Any, amplitude: Any, phase: Any, count: Any) -> None:
    """Crossings along rays, from G at points one step apart."""
    at = np.empty(3)
    step = 1 / (EDGE * STEPS)
    for ray in range(len(rays)):
        near, far = 0.0, np.inf
        for k in range(3):
            if rays[ray, k] != 0:
                one, other = -eye[k] / rays[ray, k], (SIZE[k] - eye[k]) / rays[ray, k]
                near, far = max(near, min(one, other)), min(far, max(one, other))
        before = 0.0
        for i in range(int((far - near) / step)):
            for k in range(3):
                at[k] = eye[k] + (near + i * step) * rays[ray, k]
            value = field(at, waves, amplitude, phase)
            if i > 0:
                first, last = _levels(before, value, sheet)
                count[ray] += max(last - first, 0)
            before = value
