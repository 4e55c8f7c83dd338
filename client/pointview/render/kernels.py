"""What follows from the samples that are seen, compiled: the second of the two steps of a picture.

`splat_kernels.splat` finds out which sample each pixel shows. `resolve` lights it, once per pixel and not once per
splat; `seen` lists the samples for a picture that blends them. Kernels that look only at pixels are in
`picture_kernels`.

The constants of `splats` and `shading` come as arguments (see `rules` for why).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from .rules import EMPTY, F, direction, plane_of, spacing_at, spacing_in, x_of, y_of, z_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLOCK_BITS = 8
"""Places are given out in blocks of 256, so that a table of blocks finds the cloud of a place."""

RUN = 32
"""Pixels of which it is asked at a time whether they show anything."""

MOST_SQUARINGS = 6
"""A highlight is no sharper than the 64th power."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def resolve(
    layers: NDArray[np.uint64],
    top: int,
    bottom: int,
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    node: NDArray[np.int32],
    side: NDArray[np.float32],
    starved: NDArray[np.bool_],
    words: NDArray[np.uint64],
    colors: NDArray[np.uint32],
    clouds: NDArray[Any],
    cloud_of_block: NDArray[np.int32],
    row_of_block: NDArray[np.int64],
    places: NDArray[Any],
    halvings: NDArray[Any],
    rotation: NDArray[np.float32],
    view: Any,
    light: Any,
    albedo: NDArray[np.float32],
    background: NDArray[np.uint8],
) -> np.float32:  # pragma: no cover - compiled
    """Colour, depth, node, side and starvation of the rows `top` to `bottom` from the key images (threads, padded).

    Leaves the sides of pixels that show nothing as they were. A row at a time: the samples are gathered, which waits
    for memory, and then lit, which vector instructions do.

    Returns
    -------
    float32
        Largest side.
    """
    width = rgb.shape[1]
    nearest, column_of = np.empty(width, dtype=np.uint64), np.empty(width, dtype=np.int32)
    x, y, z = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    which, word = np.empty(width, dtype=np.int32), np.empty(width, dtype=np.uint64)
    code, color = np.empty(width, dtype=np.int32), np.empty(width, dtype=np.uint32)
    bright, shine = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    here, across = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    blank, largest = np.empty((width, 3), dtype=np.uint8), F(0.0)
    blank[:] = background
    blank_line = blank.reshape(3 * width)
    for row in range(top, bottom):
        _clear(rgb[row].reshape(3 * width), depth[row], node[row], starved[row], blank_line)
        count = _covered(nearest, column_of, layers, row * width)
        for k in range(count):  # nothing but loads, many at a time on their way
            place = np.uint32(nearest[k])
            block = place >> np.uint32(BLOCK_BITS)
            which[k], i = cloud_of_block[block], row_of_block[block] + np.int64(place)
            word[k], color[k] = words[i], colors[i]
        for k in range(count):
            cloud = clouds[which[k]]
            x[k] = cloud.x + cloud.scale * x_of(word[k])
            y[k] = cloud.y + cloud.scale * y_of(word[k])
            z[k] = cloud.z + cloud.scale * z_of(word[k])
            code[k] = np.int32(word[k] >> np.uint64(48))
            spacing, hungry = cloud.spacing, cloud.starved
            if cloud.level >= 0:
                full = spacing_in(cloud, color[k] >> np.uint32(24))
                inside_x = cloud.corner_x + cloud.scale * x_of(word[k])
                inside_y = cloud.corner_y + cloud.scale * y_of(word[k])
                inside_z = cloud.corner_z + cloud.scale * z_of(word[k])
                spacing, hungry = spacing_at(cloud, inside_x, inside_y, inside_z, view.reach, full, places, halvings)
            across[k] = spacing
            node[row, column_of[k]], starved[row, column_of[k]] = cloud.node, hungry
        _measure(here[:count], across, x, y, z, rotation, view)
        if view.oriented:
            _meet(here[:count], across, code, x, y, z, row, column_of, rotation, view)
        _light_up(bright[:count], shine, code, x, y, z, light)
        for k in range(count):
            column = column_of[k]
            depth[row, column], side[row, column] = here[k], across[k]
            largest = max(largest, across[k])
            for channel in range(3):
                own = F((color[k] >> np.uint32(8 * channel)) & np.uint32(0xFF))
                value = own * albedo[channel] * bright[k] + F(255.0) * shine[k]
                rgb[row, column, channel] = np.uint8(min(value + F(0.5), F(255.0)))
    return largest


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _clear(
    line: NDArray[np.uint8],
    depth: NDArray[np.float32],
    node: NDArray[np.int32],
    starved: NDArray[np.bool_],
    blank: NDArray[np.uint8],
) -> None:  # pragma: no cover - compiled
    """Fill a row of pixels with what is seen of nothing: in loops, which are compiled better than assignments."""
    for i in range(len(line)):
        line[i] = blank[i]
    for i in range(len(depth)):
        depth[i] = F(np.inf)
    for i in range(len(node)):
        node[i] = np.int32(-1)
    for i in range(len(starved)):
        starved[i] = False


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _covered(
    nearest: NDArray[np.uint64], columns: NDArray[np.int32], layers: NDArray[np.uint64], start: int
) -> int:  # pragma: no cover - compiled
    """List the keys of a row of pixels, and their columns; return how many they are. Merges the row into one image."""
    width, keys = len(nearest), layers[0, start:]
    for layer in range(1, len(layers)):
        others = layers[layer, start:]
        for column in range(width):
            keys[column] = min(keys[column], others[column])
    count = 0
    for first in range(0, width, RUN):
        end, least = min(first + RUN, width), EMPTY
        for column in range(first, end):
            least = min(least, keys[column])
        if least == EMPTY:
            continue
        for column in range(first, end):
            nearest[count], columns[count] = keys[column], column
            count += keys[column] != EMPTY
    return count


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _measure(
    here: NDArray[np.float32],
    across: NDArray[np.float32],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    z: NDArray[np.float32],
    rotation: NDArray[np.float32],
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Depths of samples, and in place of spacings the sides of splats that close them."""
    closing, largest = view.closing, view.largest
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    for k in range(len(here)):
        here[k] = r20 * x[k] + r21 * y[k] + r22 * z[k]
        across[k] = min(across[k] * closing / here[k], largest)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _meet(
    here: NDArray[np.float32],
    across: NDArray[np.float32],
    code: NDArray[np.int32],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    z: NDArray[np.float32],
    row: int,
    column: NDArray[np.int32],
    rotation: NDArray[np.float32],
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Where samples are discs, write the depths at which their pixels' rays meet their planes."""
    ray_y = (view.height * F(0.5) - F(row) - F(0.5)) / view.focal
    middle_x, focal, round_from, steepest = view.width * F(0.5), view.focal, view.round_from, view.steepest
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    for k in range(len(here)):
        right = r00 * x[k] + r01 * y[k] + r02 * z[k]
        up = r10 * x[k] + r11 * y[k] + r12 * z[k]
        nx, ny, nz = plane_of(code[k], right, up, here[k], rotation, steepest)
        ray_x = (F(column[k]) + F(0.5) - middle_x) / focal
        depth = (nx * right + ny * up + nz * here[k]) / (nx * ray_x + ny * ray_y + nz)
        here[k] = depth if (across[k] > round_from) & (code[k] != 0) else here[k]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _light_up(
    bright: NDArray[np.float32],
    shine: NDArray[np.float32],
    code: NDArray[np.int32],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    z: NDArray[np.float32],
    light: Any,
) -> None:  # pragma: no cover - compiled
    """Write `_lit` of samples."""
    if light.lit:
        for k in range(len(bright)):
            bright[k], shine[k] = _lit(code[k], x[k], y[k], z[k], light)
    else:
        for k in range(len(bright)):
            bright[k], shine[k] = F(1.0), F(0.0)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def seen(
    samples: NDArray[Any],
    vertex: NDArray[np.uint16],
    color: NDArray[np.uint8],
    clouds: NDArray[Any],
    places: NDArray[Any],
    halvings: NDArray[Any],
    rotation: NDArray[np.float32],
    view: Any,
    light: Any,
    albedo: NDArray[np.float32],
    linear: NDArray[np.float32],
) -> int:  # pragma: no cover - compiled
    """Write the samples before the eye that face it to `samples`, a SAMPLE each, and return how many they are."""
    count = 0
    for c in range(len(clouds)):
        cloud = clouds[c]
        for i in range(cloud.first, cloud.first + cloud.count):
            x = cloud.x + cloud.scale * F(vertex[i, 0])
            y = cloud.y + cloud.scale * F(vertex[i, 1])
            z = cloud.z + cloud.scale * F(vertex[i, 2])
            depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
            if not depth > view.near:
                continue
            code = int(vertex[i, 3])
            if view.cull and code != 0:
                nx, ny, nz = direction(code)
                if nx * x + ny * y + nz * z > F(0.0):
                    continue
            spacing = cloud.spacing
            if cloud.level >= 0:
                full = spacing_in(cloud, color[i, 3])
                inside_x = cloud.corner_x + cloud.scale * F(vertex[i, 0])
                inside_y = cloud.corner_y + cloud.scale * F(vertex[i, 1])
                inside_z = cloud.corner_z + cloud.scale * F(vertex[i, 2])
                spacing, _ = spacing_at(cloud, inside_x, inside_y, inside_z, view.reach, full, places, halvings)
            right = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
            up = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
            plane = (F(0.0), F(0.0), F(-1.0))
            if view.oriented and code != 0:
                plane = plane_of(code, right, up, depth, rotation, view.steepest)
            bright, shine = F(1.0), F(0.0)
            if light.lit:
                bright, shine = _lit(code, x, y, z, light)
            sample = samples[count]
            sample.right, sample.up, sample.depth = right, up, depth
            sample.nx, sample.ny, sample.nz = plane
            sample.side = min(spacing * view.closing / depth, view.largest)
            shown = F(255.0) * shine + F(0.5)
            sample.red = linear[int(min(F(color[i, 0]) * albedo[0] * bright + shown, F(255.0)))]
            sample.green = linear[int(min(F(color[i, 1]) * albedo[1] * bright + shown, F(255.0)))]
            sample.blue = linear[int(min(F(color[i, 2]) * albedo[2] * bright + shown, F(255.0)))]
            count += 1
    return count


@numba.njit(nogil=True, cache=True, inline="always")
def _lit(
    code: int, x: np.float32, y: np.float32, z: np.float32, light: Any
) -> tuple[np.float32, np.float32]:  # pragma: no cover - compiled
    """Factor of the albedo and highlight of a sample (see `shading`); without branch, as `_project`."""
    a, b, c = direction(code)
    length = F(1.0) / math.sqrt(a * a + b * b + c * c)
    a, b, c = a * length, b * length, c * length
    length = F(-1.0) / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * length, y * length, z * length
    toward_eye = a * x + b * y + c * z
    turn = F(-1.0) if light.two_sided and toward_eye < F(0.0) else F(1.0)
    a, b, c, toward_eye = a * turn, b * turn, c * turn, toward_eye * turn
    toward = a * light.lamp_x + b * light.lamp_y + c * light.lamp_z
    mirror = F(2.0) * toward * toward_eye - (light.lamp_x * x + light.lamp_y * y + light.lamp_z * z)
    power = np.float64(max(mirror, F(0.0)))
    for halving in range(MOST_SQUARINGS):
        power = power * power if halving < light.squarings else power
    shine = light.specular * F(power) if toward > F(0.0) else F(0.0)
    bright = light.ambient + light.diffuse * max(toward, F(0.0))
    return (light.unlit, F(0.0)) if code == 0 else (bright, F(shine))
