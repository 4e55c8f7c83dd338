"""What a sample is to the kernels, in scalars: coordinates, normal, plane, key, and the spacing at its place.

`splat_kernels` and `kernels` compile these into their own code, and the cache of compiled code looks at no file but a
kernel's own: who changes a rule here deletes what is cached (`__pycache__/*.nbi`).

Names: (x, y, z) is a sample relative to the eye, axes of model space; (right, up, depth) the same in camera space.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from .tables import STEPS

if TYPE_CHECKING:
    from numpy.typing import NDArray

EMPTY = np.uint64(0xFFFFFFFFFFFFFFFF)
"""Key of a pixel that nothing covers."""

F = np.float32


@numba.njit(nogil=True, cache=True, inline="always")
def key_of(depth: np.float32, place: int) -> np.uint64:  # pragma: no cover - compiled
    """Key of a sample: depth, then place, see `splat_kernels`."""
    return (np.uint64(F(depth).view(np.uint32)) << np.uint64(32)) | np.uint64(place)


@numba.njit(nogil=True, cache=True, inline="always")
def x_of(word: np.uint64) -> np.float32:  # pragma: no cover - compiled
    """First coordinate of a sample: bits 0 to 15 of its word."""
    return F(np.uint32(word) & np.uint32(0xFFFF))


@numba.njit(nogil=True, cache=True, inline="always")
def y_of(word: np.uint64) -> np.float32:  # pragma: no cover - compiled
    """Second coordinate: bits 16 to 31."""
    return F(np.uint32(word) >> np.uint32(16))


@numba.njit(nogil=True, cache=True, inline="always")
def z_of(word: np.uint64) -> np.float32:  # pragma: no cover - compiled
    """Third coordinate: bits 32 to 47. The code of the normal is in the bits above."""
    return F(np.uint32(word >> np.uint64(32)) & np.uint32(0xFFFF))


@numba.njit(nogil=True, cache=True, inline="always")
def direction(code: int | np.int32) -> tuple[np.float32, np.float32, np.float32]:  # pragma: no cover - compiled
    """Direction of a normal of two octahedral bytes, not normalised (docs/format.md, Normals)."""
    u = F(code & 0xFF) * F(1.0 / 127.0) - F(1.0)
    v = F(code >> 8) * F(1.0 / 127.0) - F(1.0)
    w = F(1.0) - abs(u) - abs(v)
    if w < F(0.0):
        a = (F(1.0) - abs(v)) * (F(1.0) if u >= F(0.0) else F(-1.0))
        b = (F(1.0) - abs(u)) * (F(1.0) if v >= F(0.0) else F(-1.0))
        return a, b, w
    return u, v, w


@numba.njit(nogil=True, cache=True, inline="always")
def plane_of(
    code: int | np.int32,
    right: np.float32,
    up: np.float32,
    depth: np.float32,
    rotation: NDArray[np.float32],
    steepest: np.float32,
) -> tuple[np.float32, np.float32, np.float32]:  # pragma: no cover - compiled
    """Return a disc's normal in camera space: toward the eye, and seen no more from the side than `steepest`."""
    a, b, c = direction(code)
    nx = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c
    ny = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c
    nz = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c
    away = F(1.0) / math.sqrt(right * right + up * up + depth * depth)
    vx, vy, vz = right * away, up * away, depth * away
    length = F(1.0) / math.sqrt(nx * nx + ny * ny + nz * nz)
    facing = -(nx * vx + ny * vy + nz * vz) * length
    length, facing = (-length, -facing) if facing < F(0.0) else (length, facing)
    lean = max(steepest - facing, F(0.0))
    nx, ny, nz = nx * length - lean * vx, ny * length - lean * vy, nz * length - lean * vz
    length = F(1.0) / math.sqrt(nx * nx + ny * ny + nz * nz)
    return F(nx * length), F(ny * length), F(nz * length)


@numba.njit(nogil=True, cache=True, inline="always")
def spacing_in(cloud: Any, code: np.uint32 | np.uint8) -> np.float32:  # pragma: no cover - compiled
    """Spacing of all of the model's samples around a sample of a code of `thin`, as far as the cloud tells; 0: none."""
    return cloud.alone * math.exp2(F(code) * F(1.0 / STEPS)) if code > 0 else F(0.0)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def facing(
    row: int, level: int, x: np.float32, y: np.float32, z: np.float32, places: NDArray[Any], halvings: NDArray[Any]
) -> np.float32:  # pragma: no cover - compiled
    """Spacing of the cell that holds a position; the position is relative to the corner of the row's cell."""
    while True:
        axis, half, place = halvings[level].axis, halvings[level].half, places[row]
        along = x if axis == 0 else (y if axis == 1 else z)
        if along >= half:
            row, spacing = place.upper, place.upper_spacing
            if axis == 0:
                x -= half
            elif axis == 1:
                y -= half
            else:
                z -= half
        else:
            row, spacing = place.lower, place.lower_spacing
        if row < 0:
            return abs(spacing)
        level += 1


@numba.njit(nogil=True, cache=True, error_model="numpy")
def spacing_at(
    cloud: Any,
    x: np.float32,
    y: np.float32,
    z: np.float32,
    reach: np.float32,
    full: np.float32,
    places: NDArray[Any],
    halvings: NDArray[Any],
) -> tuple[np.float32, bool]:  # pragma: no cover - compiled
    """Spacing to close at a sample of the cloud, and whether its place is starved; the sample relative to `corner`.

    `full` is the spacing of all of the model's samples around it, where it is known (see `spacing_in`).
    """
    row, level, coarsest = cloud.row, cloud.level, F(0.0)
    while True:
        axis, half, place = halvings[level].axis, halvings[level].half, places[row]
        along = x if axis == 0 else (y if axis == 1 else z)
        above = along >= half
        if above:
            row, spacing, beyond, other = place.upper, place.upper_spacing, place.lower, abs(place.lower_spacing)
            edge = half * F(1.0 - 1e-6)
        else:
            row, spacing, beyond, other = place.lower, place.lower_spacing, place.upper, abs(place.upper_spacing)
            edge = F(0.0)
        apart = abs(along - half)
        if other > max(coarsest, abs(spacing) if row < 0 else F(0.0)) and apart < reach * other:
            if beyond >= 0:
                # What the sample faces straight across the plane.
                other = facing(
                    beyond,
                    level + 1,
                    edge if axis == 0 else x,
                    edge if axis == 1 else y,
                    edge if axis == 2 else z,
                    places,
                    halvings,
                )
            if apart < reach * other:
                coarsest = max(coarsest, other)
        if row < 0:
            return max(abs(spacing), coarsest, full * place.spread), spacing < F(0.0)
        if above:
            if axis == 0:
                x -= half
            elif axis == 1:
                y -= half
            else:
                z -= half
        level += 1
