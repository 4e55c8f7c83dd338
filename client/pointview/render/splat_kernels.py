"""The first of the two steps of a picture, compiled: which sample each pixel shows.

`splat` keeps, for each pixel, the smallest of the 64-bit keys `depth << 32 | place`: the bits of a positive float32 are
ordered like its value, and the place (a running number of the sample within the frame) decides ties, so the picture
depends neither on the order of work nor on the number of threads.

What is quick here: samples are projected a batch at a time, by loops that vector instructions run; and pixels are
written without asking who is nearer. Which of two samples is, is as good as random, and a branch on it costs more than
storing the smaller key. So splats are drawn in blocks of equal size, with a key that changes nothing where they end;
the last rows of a key image may be overrun by that, and `padded` says by how much.

The constants of `splats` come as arguments (see `rules` for why).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

from .rules import EMPTY, F, direction, key_of, plane_of, spacing_at, spacing_in, x_of, y_of, z_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

BATCH = 256
"""Samples that are projected at a time: they stay in the first cache."""

LANES = 4
"""Squares of up to so many pixels a side are filled without looking at their size."""

BLOCK = 16
"""Pixels of a disc that are computed at a time."""


def padded(height: int, width: int) -> int:
    """Return the length of the key image of a picture."""
    return (height + LANES) * width + BLOCK


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _lean(
    nx: NDArray[np.float32],
    ny: NDArray[np.float32],
    nz: NDArray[np.float32],
    rights: NDArray[np.float32],
    ups: NDArray[np.float32],
    words: NDArray[np.uint64],
    depths: NDArray[np.float32],
    cloud: Any,
    rotation: NDArray[np.float32],
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Place samples and their planes in camera space; see `_project` for why apart."""
    ox, oy, oz, scale, steepest = cloud.x, cloud.y, cloud.z, cloud.scale, view.steepest
    for i in range(len(words)):
        word = words[i]
        x, y, z = ox + scale * x_of(word), oy + scale * y_of(word), oz + scale * z_of(word)
        right = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
        up = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
        code = np.int32(word >> np.uint64(48))
        nx[i], ny[i], nz[i] = plane_of(code, right, up, depths[i], rotation, steepest)
        rights[i], ups[i] = right, up


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _bound(
    first: NDArray[np.int32],
    end: NDArray[np.int32],
    at: NDArray[np.float32],
    aside: NDArray[np.float32],
    along: NDArray[np.float32],
    nz: NDArray[np.float32],
    depths: NDArray[np.float32],
    sides: NDArray[np.float32],
    words: NDArray[np.uint64],
    sign: np.float32,
    size: np.float32,
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Bounds of the pictures of discs along one axis of the picture; empty for what is not drawn as one."""
    focal, round_from, round_half, oriented = view.focal, view.round_from, view.round * F(0.5), view.oriented
    for i in range(len(words)):
        half, depth, slope = sides[i] * round_half, depths[i], aside[i] / depths[i]
        drawn = (sides[i] > round_from) & (at[i] + half >= F(0.0)) & (at[i] - half < size)
        # Of a tilted disc: right to first order in radius over depth, and no less.
        radius = half * depth / focal
        across = radius * focal / depth / (F(1.0) - min(radius / depth, F(0.5)))
        lean = along[i] - slope * nz[i]
        reach = across * math.sqrt(max(F(1.0) + slope * slope - lean * lean, F(0.0)))
        tilted = oriented & (words[i] >> np.uint64(48) != np.uint64(0))
        middle = size * F(0.5) + sign * (slope * focal) if tilted else at[i]
        reach = reach if tilted else half
        low, high = max(np.ceil(middle - reach - F(0.5)), F(0.0)), min(np.ceil(middle + reach - F(0.5)), size)
        drawn = drawn & (low < high)
        first[i] = np.int32(low) if drawn else np.int32(0)
        end[i] = np.int32(high) if drawn else np.int32(0)


@numba.njit(nogil=True, cache=True, inline="always")
def _disc(
    keys: NDArray[np.uint64],
    block: NDArray[np.uint64],
    bits: np.int32,
    place: int,
    box: tuple[np.int32, np.int32, np.int32, np.int32],
    center: tuple[np.float32, np.float32, np.float32],
    radius: np.float32,
    normal: tuple[np.float32, np.float32, np.float32],
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Draw a disc in the plane of its normal, exactly: each pixel's ray meets the plane inside the radius, or not."""
    left, end, top, bottom = box
    right, up, depth = center
    nx, ny, nz = normal
    middle_x, middle_y = view.width * F(0.5), view.height * F(0.5)
    reach, inverse = radius * radius, F(1.0) / view.focal
    bulge = view.bulge / radius
    along = nx * right + ny * up + nz * depth
    for upper in range(top, bottom, BLOCK >> bits):
        for near in range(left, end, 1 << bits):
            for k in range(BLOCK):
                row = np.int32(upper) + (np.int32(k) >> bits)
                column = np.int32(near) + (np.int32(k) & ((np.int32(1) << bits) - np.int32(1)))
                ray_y = (middle_y - F(row) - F(0.5)) * inverse
                ray_x = (F(column) + F(0.5) - middle_x) * inverse
                t = along / (nx * ray_x + (ny * ray_y + nz))
                dx, dy, dz = t * ray_x - right, t * ray_y - up, t - depth
                apart = dx * dx + dy * dy + dz * dz
                covered = (apart <= reach) & (t > F(0.0)) & (column < end) & (row < bottom)
                block[k] = key_of(t + bulge * apart, place) if covered else EMPTY
            _write(keys, block, bits, np.int32(view.width), np.int32(upper), bottom, np.int32(near))


@numba.njit(nogil=True, cache=True, inline="always")
def _ball(
    keys: NDArray[np.uint64],
    block: NDArray[np.uint64],
    bits: np.int32,
    place: int,
    box: tuple[np.int32, np.int32, np.int32, np.int32],
    px: np.float32,
    py: np.float32,
    depth: np.float32,
    half: np.float32,
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Draw a disc that faces the eye and bulges toward it, so that of two the one with the nearer centre is seen."""
    left, end, top, bottom = box
    reach = half * half
    bulge = view.bulge * depth / (view.focal * half)
    for upper in range(top, bottom, BLOCK >> bits):
        for near in range(left, end, 1 << bits):
            for k in range(BLOCK):
                row = np.int32(upper) + (np.int32(k) >> bits)
                column = np.int32(near) + (np.int32(k) & ((np.int32(1) << bits) - np.int32(1)))
                dx, dy = F(column) + F(0.5) - px, F(row) + F(0.5) - py
                apart = dx * dx + dy * dy
                covered = (apart <= reach) & (column < end) & (row < bottom)
                block[k] = key_of(depth + bulge * apart, place) if covered else EMPTY
            _write(keys, block, bits, np.int32(view.width), np.int32(upper), bottom, np.int32(near))


@numba.njit(nogil=True, cache=True, inline="always")
def _write(
    keys: NDArray[np.uint64],
    block: NDArray[np.uint64],
    bits: np.int32,
    width: np.int32,
    top: np.int32,
    bottom: np.int32,
    left: np.int32,
) -> None:  # pragma: no cover - compiled
    """Keep the smaller of the keys in a block of pixels and those there."""
    start = top * width + left
    for row in range(min(bottom - top, np.int32(BLOCK >> bits))):
        line, own = keys[np.uint32(start + row * width) :], block[np.uint32(row << bits) :]
        for column in range(1 << bits):
            line[column] = min(line[column], own[column])


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _project(
    px: NDArray[np.float32],
    py: NDArray[np.float32],
    depths: NDArray[np.float32],
    sides: NDArray[np.float32],
    words: NDArray[np.uint64],
    cloud: Any,
    rotation: NDArray[np.float32],
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Pixel coordinates, depths and sides of samples; what is not before the eye, or faces away, gets a negative side.

    Loops without branch over plain arrays, so that they are compiled to vector instructions.
    """
    middle_x, middle_y, focal = view.width * F(0.5), view.height * F(0.5), view.focal
    near, largest, cull = view.near, view.largest, view.cull
    ox, oy, oz, scale, side_at_1 = cloud.x, cloud.y, cloud.z, cloud.scale, cloud.spacing * view.closing
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    for i in range(len(words)):
        word = words[i]
        x, y, z = ox + scale * x_of(word), oy + scale * y_of(word), oz + scale * z_of(word)
        depth = r20 * x + r21 * y + r22 * z
        inverse = F(1.0) / depth
        right = r00 * x + r01 * y + r02 * z
        up = r10 * x + r11 * y + r12 * z
        side = min(side_at_1 * inverse, largest)
        px[i] = middle_x + focal * right * inverse
        py[i] = middle_y - focal * up * inverse
        depths[i] = depth
        sides[i] = side if depth > near else F(-1.0)
    if cull:
        for i in range(len(words)):
            word = words[i]
            x, y, z = ox + scale * x_of(word), oy + scale * y_of(word), oz + scale * z_of(word)
            code = np.int32(word >> np.uint64(48))
            nx, ny, nz = direction(code)
            averted = (nx * x + ny * y + nz * z > F(0.0)) & (code != 0)
            sides[i] = F(-1.0) if averted else sides[i]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _box(
    left: NDArray[np.int32],
    top: NDArray[np.int32],
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
    px: NDArray[np.float32],
    py: NDArray[np.float32],
    sides: NDArray[np.float32],
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Pixels of the square splats: those whose centres lie in [p - half, p + half); the one that holds a point."""
    width, height, largest = view.width, view.height, view.round_from
    for i in range(len(px)):
        x, y, side = px[i], py[i], sides[i]
        half, point = side * F(0.5), side <= F(1.0)
        first_x = max(np.floor(x) if point else np.ceil(x - half - F(0.5)), F(0.0))
        first_y = max(np.floor(y) if point else np.ceil(y - half - F(0.5)), F(0.0))
        end_x = min(np.floor(x) + F(1.0) if point else np.ceil(x + half - F(0.5)), width)
        end_y = min(np.floor(y) + F(1.0) if point else np.ceil(y + half - F(0.5)), height)
        drawn = (side >= F(0.0)) & (side <= largest) & (first_x < end_x) & (first_y < end_y)
        left[i] = np.int32(first_x) if drawn else np.int32(0)
        top[i] = np.int32(first_y) if drawn else np.int32(0)
        columns[i] = np.int32(end_x - first_x) if drawn else np.int32(0)
        rows[i] = np.int32(end_y - first_y) if drawn else np.int32(0)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _fill(
    keys: NDArray[np.uint64],
    width: int,
    place: int,
    depths: NDArray[np.float32],
    left: NDArray[np.int32],
    top: NDArray[np.int32],
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
) -> None:  # pragma: no cover - compiled
    """Draw squares; those that are not drawn have no rows.

    Which of two samples is nearer is as good as random, and a branch on it costs more than the store it saves. So a key
    is always written, as the minimum; and small squares of unlike size are all filled as the largest of them, with a
    key that changes nothing beside them.
    """
    widest, highest = np.int32(0), np.int32(0)
    for i in range(len(rows)):
        widest, highest = max(widest, columns[i]), max(highest, rows[i])
    if highest == 0:
        return
    if widest > LANES or highest > LANES:
        for i in range(len(rows)):
            key = key_of(depths[i], place + i)
            for row in range(top[i], top[i] + rows[i]):
                start = np.uint32(row * width + left[i])
                for column in range(np.uint32(columns[i])):
                    spot = start + column
                    keys[spot] = min(keys[spot], key)
        return
    for i in range(len(rows)):
        if rows[i] == 0:
            continue
        key, start = key_of(depths[i], place + i), top[i] * width + left[i]
        # Two rows cost less than a branch on whether it is one, three do not.
        for row in range(rows[i] if highest > 2 else highest):
            for column in range(widest):
                spot = np.uint32(start + row * width + column)
                inside = (row < rows[i]) & (column < columns[i])
                keys[spot] = min(keys[spot], key if inside else EMPTY)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def splat(
    keys: NDArray[np.uint64],
    words: NDArray[np.uint64],
    colors: NDArray[np.uint32],
    clouds: NDArray[Any],
    places: NDArray[Any],
    halvings: NDArray[Any],
    rotation: NDArray[np.float32],
    view: Any,
) -> None:  # pragma: no cover - compiled
    """Keep the nearest sample of each pixel.

    Parameters
    ----------
    keys : (h * w + padding,) uint64
        EMPTY, or what earlier calls left; see `padded`.
    words : (n,) uint64
        x, y, z, normal: 16 bits each, the first in the lowest.
    colors : (n,) uint32
        Of which the code of `thin` is looked at, the highest byte.
    clouds : (k,) CLOUD
    places : (n,) PLACE
    halvings : (levels,) HALVING
    rotation : (3, 3) float32
        Model space to camera space.
    view : VIEW
    """
    width, height = view.width, view.height
    round_from, round_half = view.round_from, view.round * F(0.5)
    px, py = np.empty(BATCH, dtype=np.float32), np.empty(BATCH, dtype=np.float32)
    depths, sides = np.empty(BATCH, dtype=np.float32), np.empty(BATCH, dtype=np.float32)
    left, top = np.empty(BATCH, dtype=np.int32), np.empty(BATCH, dtype=np.int32)
    columns, rows = np.empty(BATCH, dtype=np.int32), np.empty(BATCH, dtype=np.int32)
    nx, ny = np.empty(BATCH, dtype=np.float32), np.empty(BATCH, dtype=np.float32)
    nz, rights = np.empty(BATCH, dtype=np.float32), np.empty(BATCH, dtype=np.float32)
    ups = np.empty(BATCH, dtype=np.float32)
    block = np.empty(BLOCK, dtype=np.uint64)
    for c in range(len(clouds)):
        cloud = clouds[c]
        for first in range(cloud.first, cloud.first + cloud.count, BATCH):
            count = min(BATCH, cloud.first + cloud.count - first)
            batch, place = words[first : first + count], cloud.place + first - cloud.first
            _project(px, py, depths, sides, batch, cloud, rotation, view)
            if cloud.level >= 0:
                for i in range(count):
                    if sides[i] >= F(0.0):
                        x = cloud.corner_x + cloud.scale * x_of(batch[i])
                        y = cloud.corner_y + cloud.scale * y_of(batch[i])
                        z = cloud.corner_z + cloud.scale * z_of(batch[i])
                        full = spacing_in(cloud, colors[first + i] >> np.uint32(24)) if cloud.thin else F(0.0)
                        spacing, _ = spacing_at(cloud, x, y, z, view.reach, full, places, halvings)
                        sides[i] = min(spacing * view.closing * (F(1.0) / depths[i]), view.largest)
            _box(left, top, columns, rows, px[:count], py, sides, view)
            _fill(keys, int(width), int(place), depths, left, top, columns[:count], rows[:count])
            widest = F(0.0)
            for i in range(count):
                widest = max(widest, sides[i])
            if not widest > round_from:
                continue
            if view.oriented:
                _lean(nx, ny, nz, rights, ups, batch, depths, cloud, rotation, view)
            _bound(left, columns, px, rights, nx, nz, depths, sides, batch, F(1.0), width, view)
            _bound(top, rows, py, ups, ny, nz, depths, sides, batch, F(-1.0), height, view)
            for i in range(count):
                box = (left[i], columns[i], top[i], rows[i])
                if box[0] >= box[1] or box[2] >= box[3]:
                    continue
                half, across = sides[i] * round_half, box[1] - box[0]
                bits = np.int32(3) if across <= 8 else np.int32(4)
                if not (view.oriented and batch[i] >> np.uint64(48) != 0):
                    _ball(keys, block, bits, place + i, box, px[i], py[i], depths[i], half, view)
                    continue
                center, normal = (rights[i], ups[i], depths[i]), (nx[i], ny[i], nz[i])
                radius = half * depths[i] / view.focal
                if across <= 4:  # most of them: compiled apart, so that nothing in its loops depends on the size
                    _disc(keys, block, np.int32(2), place + i, box, center, radius, normal, view)
                else:
                    _disc(keys, block, bits, place + i, box, center, radius, normal, view)
