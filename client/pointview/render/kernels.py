"""Compiled loops of the CPU backend. All of them in this module: the cache of compiled code does not see other files.

A picture is made in two steps. `splat` keeps, for each pixel, the smallest of the 64-bit keys `depth << 32 | place`:
the bits of a positive float32 are ordered like its value, and the place (a running number of the sample within the
frame) decides ties, so the picture depends neither on the order of work nor on the number of threads. `resolve` then
looks up, once per pixel and not once per splat, which sample is seen, and lights it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numba
import numpy as np

from .shading import AMBIENT, DIFFUSE, RADIUS, SHININESS, SPECULAR, UNLIT

if TYPE_CHECKING:
    from numpy.typing import NDArray

EMPTY = np.uint64(0xFFFFFFFFFFFFFFFF)
BLOCK_BITS = 8
"""Places are given out in blocks of 256, so that a table of blocks finds the cloud of a place."""

F = np.float32


@numba.njit(nogil=True, cache=True, inline="always")
def _octahedral(code: int) -> tuple[np.float32, np.float32, np.float32]:  # pragma: no cover - compiled
    """Direction of a normal of two octahedral bytes, not normalised (docs/format.md, Normals)."""
    u = F(code & 0xFF) * F(1.0 / 127.0) - F(1.0)
    v = F(code >> 8) * F(1.0 / 127.0) - F(1.0)
    w = F(1.0) - abs(u) - abs(v)
    if w < F(0.0):
        a = (F(1.0) - abs(v)) * (F(1.0) if u >= F(0.0) else F(-1.0))
        b = (F(1.0) - abs(u)) * (F(1.0) if v >= F(0.0) else F(-1.0))
        return a, b, w
    return u, v, w


@numba.njit(nogil=True, cache=True, error_model="numpy")
def splat(
    keys: NDArray[np.uint64],
    vertex: NDArray[np.uint16],
    first: NDArray[np.int64],
    count: NDArray[np.int64],
    place: NDArray[np.int64],
    offset: NDArray[np.float32],
    scale: NDArray[np.float32],
    size: NDArray[np.float32],
    rotation: NDArray[np.float32],
    focal: float,
    near: float,
    largest: float,
    round_from: float,
    round_factor: float,
    cull: bool,
) -> None:  # pragma: no cover - compiled
    """Keep the nearest sample of each pixel.

    Parameters
    ----------
    keys : (h, w) uint64
        EMPTY, or what earlier calls left.
    vertex : (n, 4) uint16
        x, y, z, normal.
    first, count, place : (clouds,) int64
        Rows of `vertex`, and the place of the cloud's first sample.
    offset : (clouds, 3) float32
        Position of the cloud's (0, 0, 0) relative to the eye, axes of model space.
    scale : (clouds,) float32
        Model units of a step.
    size : (clouds,) float32
        Side of a splat, pixels times depth.
    cull : bool
        Drop samples whose normal points away from the eye.
    """
    height, width = keys.shape
    middle_x, middle_y = F(width * 0.5), F(height * 0.5)
    focal32, near32, largest32 = F(focal), F(near), F(largest)
    round_from32, round_half = F(round_from), F(round_factor * 0.5)
    r00, r01, r02 = rotation[0, 0] * focal32, rotation[0, 1] * focal32, rotation[0, 2] * focal32
    r10, r11, r12 = rotation[1, 0] * focal32, rotation[1, 1] * focal32, rotation[1, 2] * focal32
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    for c in range(len(first)):
        ox, oy, oz, s = offset[c, 0], offset[c, 1], offset[c, 2], scale[c]
        side_at_1 = size[c]
        start = first[c]
        for i in range(start, start + count[c]):
            x = ox + s * F(vertex[i, 0])
            y = oy + s * F(vertex[i, 1])
            z = oz + s * F(vertex[i, 2])
            depth = r20 * x + r21 * y + r22 * z
            if not depth > near32:
                continue
            if cull:
                code = int(vertex[i, 3])
                if code != 0:
                    nx, ny, nz = _octahedral(code)
                    if nx * x + ny * y + nz * z > F(0.0):
                        continue
            inverse = F(1.0) / depth
            px = middle_x + (r00 * x + r01 * y + r02 * z) * inverse
            py = middle_y - (r10 * x + r11 * y + r12 * z) * inverse
            side = min(side_at_1 * inverse, largest32)
            key = (np.uint64(F(depth).view(np.uint32)) << np.uint64(32)) | np.uint64(place[c] + (i - start))
            if side <= F(1.0):
                if px >= F(0.0) and py >= F(0.0) and px < F(width) and py < F(height):
                    column, row = int(px), int(py)
                    if key < keys[row, column]:
                        keys[row, column] = key
                continue
            round_splat = side > round_from32
            half = side * (round_half if round_splat else F(0.5))
            if not (px + half > F(0.0) and py + half > F(0.0) and px - half < F(width) and py - half < F(height)):
                continue
            # Pixels whose centres lie in [p - half, p + half).
            left = max(math.ceil(px - half - F(0.5)), 0)
            right = min(math.ceil(px + half - F(0.5)), width)
            top = max(math.ceil(py - half - F(0.5)), 0)
            bottom = min(math.ceil(py + half - F(0.5)), height)
            if round_splat:
                reach = half * half
                for row in range(top, bottom):
                    dy = F(row) + F(0.5) - py
                    for column in range(left, right):
                        dx = F(column) + F(0.5) - px
                        if dx * dx + dy * dy <= reach and key < keys[row, column]:
                            keys[row, column] = key
            else:
                for row in range(top, bottom):
                    for column in range(left, right):
                        if key < keys[row, column]:
                            keys[row, column] = key


@numba.njit(nogil=True, cache=True, error_model="numpy")
def resolve(
    layers: NDArray[np.uint64],
    top: int,
    bottom: int,
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    node: NDArray[np.int32],
    vertex: NDArray[np.uint16],
    color: NDArray[np.uint8],
    cloud_of_block: NDArray[np.int32],
    place: NDArray[np.int64],
    first: NDArray[np.int64],
    nodes: NDArray[np.int64],
    offset: NDArray[np.float32],
    scale: NDArray[np.float32],
    rotation: NDArray[np.float32],
    albedo: NDArray[np.float32],
    background: NDArray[np.uint8],
    lamp: NDArray[np.float32],
    lit: bool,
    two_sided: bool,
) -> None:  # pragma: no cover - compiled
    """Colour, depth and node of the rows `top` to `bottom` from the key images (threads, h, w)."""
    threads, _, width = layers.shape
    for row in range(top, bottom):
        for column in range(width):
            key = layers[0, row, column]
            for layer in range(1, threads):
                other = layers[layer, row, column]
                if other < key:
                    key = other
            if key == EMPTY:
                depth[row, column] = np.inf
                node[row, column] = -1
                for channel in range(3):
                    rgb[row, column, channel] = background[channel]
                continue
            bits = np.uint32(key >> np.uint64(32))
            depth[row, column] = np.uint32(bits).view(np.float32)
            sample_place = np.int64(key & np.uint64(0xFFFFFFFF))
            cloud = cloud_of_block[sample_place >> BLOCK_BITS]
            node[row, column] = nodes[cloud]
            i = first[cloud] + sample_place - place[cloud]
            light, shine = F(1.0), F(0.0)
            if lit:
                s = scale[cloud]
                x = offset[cloud, 0] + s * F(vertex[i, 0])
                y = offset[cloud, 1] + s * F(vertex[i, 1])
                z = offset[cloud, 2] + s * F(vertex[i, 2])
                light, shine = _light(int(vertex[i, 3]), x, y, z, rotation, lamp, two_sided)
            for channel in range(3):
                value = F(color[i, channel]) * albedo[channel] * light + F(255.0) * shine
                rgb[row, column, channel] = np.uint8(min(value + F(0.5), F(255.0)))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _light(
    code: int,
    x: np.float32,
    y: np.float32,
    z: np.float32,
    rotation: NDArray[np.float32],
    lamp: NDArray[np.float32],
    two_sided: bool,
) -> tuple[np.float32, np.float32]:  # pragma: no cover - compiled
    """Factor of the albedo and highlight of a sample at (x, y, z) from the eye (see `shading`)."""
    if code == 0:
        return F(UNLIT), F(0.0)
    a, b, c = _octahedral(code)
    length = F(1.0) / math.sqrt(a * a + b * b + c * c)
    a, b, c = a * length, b * length, c * length
    length = F(-1.0) / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * length, y * length, z * length
    toward_eye = a * x + b * y + c * z
    if two_sided and toward_eye < F(0.0):
        a, b, c, toward_eye = -a, -b, -c, -toward_eye
    # The lamp in model space.
    lx = rotation[0, 0] * lamp[0] + rotation[1, 0] * lamp[1] + rotation[2, 0] * lamp[2]
    ly = rotation[0, 1] * lamp[0] + rotation[1, 1] * lamp[1] + rotation[2, 1] * lamp[2]
    lz = rotation[0, 2] * lamp[0] + rotation[1, 2] * lamp[1] + rotation[2, 2] * lamp[2]
    toward = a * lx + b * ly + c * lz
    if toward <= F(0.0):
        return F(AMBIENT), F(0.0)
    mirror = F(2.0) * toward * toward_eye - (lx * x + ly * y + lz * z)
    shine = F(0.0) if mirror <= F(0.0) else F(SPECULAR) * mirror**SHININESS
    return F(AMBIENT) + F(DIFFUSE) * toward, F(shine)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def eye_dome(
    rgb: NDArray[np.uint8], depth: NDArray[np.float32], top: int, bottom: int, factor: float
) -> None:  # pragma: no cover - compiled
    """Darken `rgb` in place by eye-dome lighting; `factor` is strength * focal / (8 RADIUS)."""
    height, width = depth.shape
    for row in range(top, bottom):
        for column in range(width):
            here = depth[row, column]
            if here == np.inf:
                continue
            inverse = F(1.0) / here
            # The sum of logarithms is the logarithm of a product: one call for eight neighbours.
            product = F(1.0)
            for y in range(max(row - RADIUS, 0), min(row + RADIUS + 1, height), RADIUS):
                for x in range(max(column - RADIUS, 0), min(column + RADIUS + 1, width), RADIUS):
                    ratio = depth[y, x] * inverse
                    if ratio < F(1.0):
                        product *= max(ratio, F(1e-4))
            shade = F(math.exp(factor * math.log(product)))
            for channel in range(3):
                rgb[row, column, channel] = np.uint8(F(rgb[row, column, channel]) * shade + F(0.5))
