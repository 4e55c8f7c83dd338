"""Compiled loops of the CPU backend that look at samples; those that look at pixels are in `picture_kernels`.

All of them are in this module, and the constants of `splats` and `shading` come as arguments: the cache of compiled
code does not see other files.

A picture is made in two steps. `splat` keeps, for each pixel, the smallest of the 64-bit keys `depth << 32 | place`:
the bits of a positive float32 are ordered like its value, and the place (a running number of the sample within the
frame) decides ties, so the picture depends neither on the order of work nor on the number of threads. `resolve` then
looks up, once per pixel and not once per splat, which sample is seen, and lights it.

Names: (x, y, z) is a sample relative to the eye, axes of model space; (right, up, depth) the same in camera space.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

EMPTY = np.uint64(0xFFFFFFFFFFFFFFFF)
BLOCK_BITS = 8
"""Places are given out in blocks of 256, so that a table of blocks finds the cloud of a place."""

CLOUD = np.dtype(
    [
        ("node", np.int32),
        ("first", np.int64),  # row of its first sample
        ("count", np.int64),
        ("place", np.int64),  # of its first sample
        ("x", np.float32),  # position of the cloud's (0, 0, 0) relative to the eye
        ("y", np.float32),
        ("z", np.float32),
        ("scale", np.float32),  # model units of a step
        ("spacing", np.float32),  # to close, model units; the next five say where it differs inside the cloud
        ("starved", np.bool_),
        ("row", np.int32),  # of its node in PLACE
        ("level", np.int32),  # of its node; -1 where the spacing is the same everywhere
        ("corner_x", np.float32),  # position of the cloud's (0, 0, 0) relative to the corner of its node's cell
        ("corner_y", np.float32),
        ("corner_z", np.float32),
    ]
)
"""A cloud of the frame."""

PLACE = np.dtype(
    [
        ("lower", np.int32),  # rows of the drawn nodes in the halves of the cell; -1 where the half ends here
        ("upper", np.int32),
        ("lower_spacing", np.float32),  # to close there; negative where starved
        ("upper_spacing", np.float32),
    ]
)
"""A drawn node (see `places`)."""

HALVING = np.dtype([("axis", np.int32), ("half", np.float32)])
"""How the cells of a level are halved (see `places`)."""

F = np.float32


@numba.njit(nogil=True, cache=True, inline="always")
def _key(depth: np.float32, place: int) -> np.uint64:  # pragma: no cover - compiled
    return (np.uint64(F(depth).view(np.uint32)) << np.uint64(32)) | np.uint64(place)


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
def _plane(
    code: int, right: np.float32, up: np.float32, depth: np.float32, rotation: NDArray[np.float32], steepest: np.float32
) -> tuple[np.float32, np.float32, np.float32]:  # pragma: no cover - compiled
    """Return a disc's normal in camera space: toward the eye, and seen no more from the side than `steepest`."""
    a, b, c = _octahedral(code)
    nx = rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c
    ny = rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c
    nz = rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c
    away = F(1.0) / math.sqrt(right * right + up * up + depth * depth)
    vx, vy, vz = right * away, up * away, depth * away
    length = F(1.0) / math.sqrt(nx * nx + ny * ny + nz * nz)
    facing = -(nx * vx + ny * vy + nz * vz) * length
    if facing < F(0.0):
        length, facing = -length, -facing
    lean = max(steepest - facing, F(0.0))
    nx, ny, nz = nx * length - lean * vx, ny * length - lean * vy, nz * length - lean * vz
    length = F(1.0) / math.sqrt(nx * nx + ny * ny + nz * nz)
    return F(nx * length), F(ny * length), F(nz * length)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _disc(
    keys: NDArray[np.uint64],
    place: int,
    right: np.float32,
    up: np.float32,
    depth: np.float32,
    radius: np.float32,
    normal: tuple[np.float32, np.float32, np.float32],
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Draw a disc in the plane of its normal, exactly: each pixel's ray meets the plane inside the radius, or not."""
    nx, ny, nz = normal
    middle_x, middle_y, focal = view.width * F(0.5), view.height * F(0.5), view.focal
    slope_x, slope_y = right / depth, up / depth
    # Bounds of the disc's picture: right to first order in radius over depth, and no less.
    across = radius * focal / depth / (F(1.0) - min(radius / depth, F(0.5)))
    half_x = across * math.sqrt(max(F(1.0) + slope_x * slope_x - (nx - slope_x * nz) ** 2, F(0.0)))
    half_y = across * math.sqrt(max(F(1.0) + slope_y * slope_y - (ny - slope_y * nz) ** 2, F(0.0)))
    px, py = middle_x + slope_x * focal, middle_y - slope_y * focal
    left = max(math.ceil(px - half_x - F(0.5)), 0)
    end = min(math.ceil(px + half_x - F(0.5)), int(view.width))
    top = max(math.ceil(py - half_y - F(0.5)), 0)
    bottom = min(math.ceil(py + half_y - F(0.5)), int(view.height))
    reach, inverse = radius * radius, F(1.0) / focal
    bulge = view.bulge / radius
    along = nx * right + ny * up + nz * depth
    for row in range(top, bottom):
        ray_y = (middle_y - F(row) - F(0.5)) * inverse
        part = ny * ray_y + nz
        for column in range(left, end):
            ray_x = (F(column) + F(0.5) - middle_x) * inverse
            t = along / (nx * ray_x + part)
            dx, dy, dz = t * ray_x - right, t * ray_y - up, t - depth
            apart = dx * dx + dy * dy + dz * dz
            if apart <= reach and t > F(0.0):
                key = _key(t + bulge * apart, place)
                if key < keys[row, column]:
                    keys[row, column] = key


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _ball(
    keys: NDArray[np.uint64],
    place: int,
    px: np.float32,
    py: np.float32,
    depth: np.float32,
    half: np.float32,
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Draw a disc that faces the eye and bulges toward it, so that of two the one with the nearer centre is seen."""
    left = max(math.ceil(px - half - F(0.5)), 0)
    end = min(math.ceil(px + half - F(0.5)), int(view.width))
    top = max(math.ceil(py - half - F(0.5)), 0)
    bottom = min(math.ceil(py + half - F(0.5)), int(view.height))
    reach = half * half
    bulge = view.bulge * depth / (view.focal * half)
    for row in range(top, bottom):
        dy = F(row) + F(0.5) - py
        for column in range(left, end):
            dx = F(column) + F(0.5) - px
            apart = dx * dx + dy * dy
            if apart <= reach:
                key = _key(depth + bulge * apart, place)
                if key < keys[row, column]:
                    keys[row, column] = key


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _facing(
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
def _spacing_at(
    cloud: Any,
    x: np.float32,
    y: np.float32,
    z: np.float32,
    reach: np.float32,
    places: NDArray[Any],
    halvings: NDArray[Any],
) -> tuple[np.float32, bool]:  # pragma: no cover - compiled
    """Spacing to close at a sample of the cloud, and whether its place is starved; the sample relative to `corner`."""
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
                other = _facing(
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
            return max(abs(spacing), coarsest), spacing < F(0.0)
        if above:
            if axis == 0:
                x -= half
            elif axis == 1:
                y -= half
            else:
                z -= half
        level += 1


@numba.njit(nogil=True, cache=True, error_model="numpy")
def splat(
    keys: NDArray[np.uint64],
    vertex: NDArray[np.uint16],
    clouds: NDArray[Any],
    places: NDArray[Any],
    halvings: NDArray[Any],
    rotation: NDArray[np.float32],
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Keep the nearest sample of each pixel.

    Parameters
    ----------
    keys : (h, w) uint64
        EMPTY, or what earlier calls left.
    vertex : (n, 4) uint16
        x, y, z, normal.
    clouds : (k,) CLOUD
    places : (n,) PLACE
    halvings : (levels,) HALVING
    rotation : (3, 3) float32
        Model space to camera space.
    view : VIEW
    """
    width, height = view.width, view.height
    middle_x, middle_y, focal = width * F(0.5), height * F(0.5), view.focal
    near, largest, round_from, round_half = view.near, view.largest, view.round_from, view.round * F(0.5)
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    for c in range(len(clouds)):
        cloud = clouds[c]
        ox, oy, oz, scale, side_at_1 = cloud.x, cloud.y, cloud.z, cloud.scale, cloud.spacing * view.closing
        start, place = cloud.first, cloud.place
        for i in range(start, start + cloud.count):
            x = ox + scale * F(vertex[i, 0])
            y = oy + scale * F(vertex[i, 1])
            z = oz + scale * F(vertex[i, 2])
            depth = r20 * x + r21 * y + r22 * z
            if not depth > near:
                continue
            if view.cull:
                code = int(vertex[i, 3])
                if code != 0:
                    nx, ny, nz = _octahedral(code)
                    if nx * x + ny * y + nz * z > F(0.0):
                        continue
            inverse = F(1.0) / depth
            right = r00 * x + r01 * y + r02 * z
            up = r10 * x + r11 * y + r12 * z
            px = middle_x + focal * right * inverse
            py = middle_y - focal * up * inverse
            if cloud.level >= 0:
                inside_x = cloud.corner_x + scale * F(vertex[i, 0])
                inside_y = cloud.corner_y + scale * F(vertex[i, 1])
                inside_z = cloud.corner_z + scale * F(vertex[i, 2])
                spacing, _ = _spacing_at(cloud, inside_x, inside_y, inside_z, view.reach, places, halvings)
                side_at_1 = spacing * view.closing
            side = min(side_at_1 * inverse, largest)
            half = side * (round_half if side > round_from else F(0.5))
            if not (px + half >= F(0.0) and py + half >= F(0.0) and px - half < width and py - half < height):
                continue
            if side <= F(1.0):
                if px >= F(0.0) and py >= F(0.0) and px < width and py < height:
                    key = _key(depth, place + (i - start))
                    if key < keys[int(py), int(px)]:
                        keys[int(py), int(px)] = key
            elif side <= round_from:
                # Pixels whose centres lie in [p - half, p + half).
                key = _key(depth, place + (i - start))
                left = max(math.ceil(px - half - F(0.5)), 0)
                end = min(math.ceil(px + half - F(0.5)), int(width))
                top = max(math.ceil(py - half - F(0.5)), 0)
                bottom = min(math.ceil(py + half - F(0.5)), int(height))
                for row in range(top, bottom):
                    for column in range(left, end):
                        if key < keys[row, column]:
                            keys[row, column] = key
            elif view.oriented and vertex[i, 3] != 0:
                normal = _plane(int(vertex[i, 3]), right, up, depth, rotation, view.steepest)
                _disc(keys, place + (i - start), right, up, depth, half * depth / focal, normal, view)
            else:
                _ball(keys, place + (i - start), px, py, depth, half, view)


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
    vertex: NDArray[np.uint16],
    color: NDArray[np.uint8],
    clouds: NDArray[Any],
    cloud_of_block: NDArray[np.int32],
    places: NDArray[Any],
    halvings: NDArray[Any],
    rotation: NDArray[np.float32],
    view: Any,
    light: Any,
    albedo: NDArray[np.float32],
    background: NDArray[np.uint8],
) -> None:  # pragma: no cover - compiled
    """Colour, depth, node, side and starvation of the rows `top` to `bottom` from the key images (threads, h, w)."""
    threads, _, width = layers.shape
    middle_x, middle_y, focal = view.width * F(0.5), view.height * F(0.5), view.focal
    for row in range(top, bottom):
        for column in range(width):
            key = layers[0, row, column]
            for layer in range(1, threads):
                other = layers[layer, row, column]
                if other < key:
                    key = other
            if key == EMPTY:
                depth[row, column], node[row, column], side[row, column] = np.inf, -1, 0.0
                starved[row, column] = False
                for channel in range(3):
                    rgb[row, column, channel] = background[channel]
                continue
            place = np.int64(key & np.uint64(0xFFFFFFFF))
            cloud = clouds[cloud_of_block[place >> BLOCK_BITS]]
            i = cloud.first + place - cloud.place
            code = int(vertex[i, 3])
            x = cloud.x + cloud.scale * F(vertex[i, 0])
            y = cloud.y + cloud.scale * F(vertex[i, 1])
            z = cloud.z + cloud.scale * F(vertex[i, 2])
            here = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
            spacing, hungry = cloud.spacing, cloud.starved
            if cloud.level >= 0:
                inside_x = cloud.corner_x + cloud.scale * F(vertex[i, 0])
                inside_y = cloud.corner_y + cloud.scale * F(vertex[i, 1])
                inside_z = cloud.corner_z + cloud.scale * F(vertex[i, 2])
                spacing, hungry = _spacing_at(cloud, inside_x, inside_y, inside_z, view.reach, places, halvings)
            starved[row, column] = hungry
            across = min(spacing * view.closing / here, view.largest)
            if across > view.round_from and view.oriented and code != 0:
                right = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
                up = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
                nx, ny, nz = _plane(code, right, up, here, rotation, view.steepest)
                ray_x, ray_y = (F(column) + F(0.5) - middle_x) / focal, (middle_y - F(row) - F(0.5)) / focal
                here = (nx * right + ny * up + nz * here) / (nx * ray_x + ny * ray_y + nz)
            depth[row, column], node[row, column], side[row, column] = here, cloud.node, across
            bright, shine = F(1.0), F(0.0)
            if light.lit:
                bright, shine = _lit(code, x, y, z, light)
            for channel in range(3):
                value = F(color[i, channel]) * albedo[channel] * bright + F(255.0) * shine
                rgb[row, column, channel] = np.uint8(min(value + F(0.5), F(255.0)))


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
        spacing = cloud.spacing
        for i in range(cloud.first, cloud.first + cloud.count):
            x = cloud.x + cloud.scale * F(vertex[i, 0])
            y = cloud.y + cloud.scale * F(vertex[i, 1])
            z = cloud.z + cloud.scale * F(vertex[i, 2])
            depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
            if not depth > view.near:
                continue
            code = int(vertex[i, 3])
            if view.cull and code != 0:
                nx, ny, nz = _octahedral(code)
                if nx * x + ny * y + nz * z > F(0.0):
                    continue
            if cloud.level >= 0:
                inside_x = cloud.corner_x + cloud.scale * F(vertex[i, 0])
                inside_y = cloud.corner_y + cloud.scale * F(vertex[i, 1])
                inside_z = cloud.corner_z + cloud.scale * F(vertex[i, 2])
                spacing, _ = _spacing_at(cloud, inside_x, inside_y, inside_z, view.reach, places, halvings)
            right = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
            up = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
            plane = (F(0.0), F(0.0), F(-1.0))
            if view.oriented and code != 0:
                plane = _plane(code, right, up, depth, rotation, view.steepest)
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


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _lit(
    code: int, x: np.float32, y: np.float32, z: np.float32, light: Any
) -> tuple[np.float32, np.float32]:  # pragma: no cover - compiled
    """Factor of the albedo and highlight of a sample (see `shading`)."""
    if code == 0:
        return light.unlit, F(0.0)
    a, b, c = _octahedral(code)
    length = F(1.0) / math.sqrt(a * a + b * b + c * c)
    a, b, c = a * length, b * length, c * length
    length = F(-1.0) / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * length, y * length, z * length
    toward_eye = a * x + b * y + c * z
    if light.two_sided and toward_eye < F(0.0):
        a, b, c, toward_eye = -a, -b, -c, -toward_eye
    toward = a * light.lamp_x + b * light.lamp_y + c * light.lamp_z
    if toward <= F(0.0):
        return light.ambient, F(0.0)
    mirror = F(2.0) * toward * toward_eye - (light.lamp_x * x + light.lamp_y * y + light.lamp_z * z)
    shine = F(0.0) if mirror <= F(0.0) else light.specular * mirror**light.shininess
    return light.ambient + light.diffuse * toward, F(shine)
