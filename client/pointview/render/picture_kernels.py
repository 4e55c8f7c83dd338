"""Compiled loops over the pixels of a finished picture: its lighting, its holes, and the cells of the tree it shows.

Nothing here knows the kernels of the samples, so the cache of compiled code needs to see no other file.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1))
"""Of the eight neighbours; opposite ones first, which decide soonest."""

BAND = 32
"""Rows that are looked through for holes at a time: what is noted of them stays in the second cache."""

F = np.float32


@numba.njit(nogil=True, cache=True, error_model="numpy")
def eye_dome(
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    side: NDArray[np.float32],
    top: int,
    bottom: int,
    strength: float,
    sides: float,
    darkest: float,
) -> None:  # pragma: no cover - compiled
    """Darken `rgb` in place by eye-dome lighting (see `shading`).

    Parameters
    ----------
    strength : float
        `Style.edl_strength` times the focal length, pixels.
    sides : float
        Distance of the neighbours, sides of the pixel's splat.
    darkest : float
        Least factor.
    """
    height, width = depth.shape
    for row in range(top, bottom):
        for column in range(width):
            here = depth[row, column]
            if here == np.inf:
                continue
            inverse = F(1.0) / here
            away = max(int(side[row, column] * F(sides) + F(0.5)), 1)
            # The sum of logarithms is the logarithm of a product: one call for eight neighbours.
            product = F(1.0)
            for i in range(-1, 2):
                y = row + i * away
                if y < 0 or y >= height:
                    continue
                for j in range(-1, 2):
                    x = column + j * away
                    if x < 0 or x >= width or (i == 0 and j == 0):
                        continue
                    ratio = depth[y, x] * inverse
                    if ratio < F(1.0):
                        product *= max(ratio, F(1e-4))
            shade = F(darkest + (1.0 - darkest) * math.exp(strength / (8.0 * away) * math.log(product)))
            for channel in range(3):
                rgb[row, column, channel] = np.uint8(F(rgb[row, column, channel]) * shade + F(0.5))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def close_holes(
    depth: NDArray[np.float32],
    side: NDArray[np.float32],
    holes: NDArray[np.int32],
    sources: NDArray[np.int32],
    top: int,
    bottom: int,
    focal: float,
    reach: float,
    largest: int,
    walls: int,
    faces: int,
    face: float,
) -> int:  # pragma: no cover - compiled
    """Find the pixels of the rows `top` to `bottom` that lie in holes, and the walls that they show instead.

    Parameters
    ----------
    depth, side : (h, w) float32
    holes, sources : (h * w,) int32
        Results from `top * width` on, each `row * width + column`.
    reach : float
        A wall is at most this many sides of its own splat away.
    largest : int
        And at most this many pixels.
    walls : int
        Directions, of eight, in which a hole has walls; 7 or 8, as `_between_walls` takes for granted.
    faces, face : int, float
        In so many of these a wall goes on into the hole, by its slope over so many sides of its splat.

    Returns
    -------
    int
        How many pixels.
    """
    height, width = depth.shape
    first = count = top * width
    if largest == 0:
        return 0
    deep, away = np.empty((BAND, width), dtype=np.float32), np.empty(8, dtype=np.int32)
    for row in range(top, bottom):
        if (row - top) % BAND == 0:
            _between_walls(deep, depth, side, row, focal, largest)
        for column in range(width):
            here = depth[row, column]
            if not deep[(row - top) % BAND, column] < here:
                continue
            found = 0
            for direction in range(8):
                if found + 8 - direction < walls:
                    break
                dx, dy = DIRECTIONS[direction]
                step, away[direction] = 1, 0
                while step <= largest:
                    x, y = column + step * dx, row + step * dy
                    if x < 0 or x >= width or y < 0 or y >= height:
                        break
                    wall = depth[y, x]
                    if wall < here:
                        wide = side[y, x]
                        if step <= max(F(reach) * wide, F(1.0)) and wall * (F(1.0) + wide / F(focal)) < here:
                            found += 1
                            away[direction] = step
                            break
                    step += 1 if step < 4 else step // 2
            if found < walls:
                continue
            best, nearest, level = row * width + column, largest + 1, 0
            for direction in range(8):
                step = away[direction]
                if step == 1 or (step > 0 and _goes_on(depth, side, row, column, direction, step, focal, reach, face)):
                    level += 1
                    if step < nearest:
                        dx, dy = DIRECTIONS[direction]
                        nearest, best = step, (row + step * dy) * width + column + step * dx
                    if nearest == 1 and level >= faces:
                        break
            if level >= faces:
                holes[count], sources[count] = row * width + column, best
                count += 1
    return count - first


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _goes_on(
    depth: NDArray[np.float32],
    side: NDArray[np.float32],
    row: int,
    column: int,
    direction: int,
    step: int,
    focal: float,
    reach: float,
    face: float,
) -> bool:  # pragma: no cover - compiled
    """Whether the plane of a wall reaches the pixel that it is so many steps away from, more than one."""
    dx, dy = DIRECTIONS[direction]
    x, y = column + step * dx, row + step * dy
    wall, wide = depth[y, x], side[y, x]
    ahead, slope = max(int(F(face) * wide + F(0.5)), 1), F(0.0)
    x_ahead, y_ahead = x + ahead * dx, y + ahead * dy
    if x_ahead >= 0 and x_ahead < depth.shape[1] and y_ahead >= 0 and y_ahead < len(depth):
        slope = (depth[y_ahead, x_ahead] / wall - F(1.0)) * F(focal) / F(ahead)
        slope = slope if slope < np.inf else F(0.0)
    away = F(step * step) * (F(dx * dx + dy * dy) + slope * slope)
    return away <= F(reach) * wide * F(reach) * wide


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _between_walls(
    deep: NDArray[np.float32],
    depth: NDArray[np.float32],
    side: NDArray[np.float32],
    top: int,
    focal: float,
    reach: int,
) -> None:  # pragma: no cover - compiled
    """Write how deep the pixels of the rows from `top` must be to have walls within `reach` pixels around them.

    To the left, to the right, above and below, but for one of these. What is no deeper is in no hole, and that is
    nearly every pixel.
    """
    (rows, width), height, inf = deep.shape, len(depth), F(np.inf)
    wide = width + 2 * reach
    walls, spare = np.full((rows + 2 * reach) * wide, inf), np.empty((rows + 2 * reach) * wide, np.float32)
    for row in range(max(top - reach, 0), min(top + rows + reach, height)):
        start = (row - top + reach) * wide + reach
        line, own_depth, own_side = walls[start : start + width], depth[row], side[row]
        for column in range(width):
            wall = own_depth[column]
            line[column] = wall * (F(1.0) + own_side[column] / F(focal)) if wall < inf else inf
    across = walls[reach * wide : (reach + rows) * wide].copy()
    across = _least(across, spare[: len(across)], 1, reach).copy()
    along = _least(walls, spare, wide, reach)
    for row in range(rows):
        left, right = across[row * wide :], across[row * wide + reach + 1 :]
        above, below = along[row * wide + reach :], along[(row + reach + 1) * wide + reach :]
        line = deep[row]
        for column in range(width):
            level = max(left[column], right[column]), min(left[column], right[column])
            upright = max(above[column], below[column]), min(above[column], below[column])
            line[column] = max(min(level[0], upright[0]), max(level[1], upright[1]))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _least(
    values: NDArray[np.float32], spare: NDArray[np.float32], stride: int, window: int
) -> NDArray[np.float32]:  # pragma: no cover - compiled
    """Return the least of so many values from each on, `stride` apart: from those of half as many, and so on.

    Where these go beyond the end, what is returned means nothing. Both arrays are written.
    """
    done = 1
    while done < window:
        more = min(done, window - done)
        ahead = values[more * stride :]
        for i in range(len(ahead)):
            spare[i] = min(values[i], ahead[i])
        values, spare, done = spare, values, done + more
    return values


@numba.njit(nogil=True, cache=True, error_model="numpy")
def count_cells(
    counts: NDArray[np.int64],
    depth: NDArray[np.float32],
    places: NDArray[Any],
    halvings: NDArray[Any],
    eye: NDArray[np.float32],
    rotation: NDArray[np.float32],
    focal: float,
) -> None:  # pragma: no cover - compiled
    """Add the covered pixels to the halves of cells that their surface lies in, and to all cells around these.

    Parameters
    ----------
    counts : (n, 2) int64
        For the lower and the upper half of the cell of each node of `places`.
    depth : (h, w) float32
    eye : (3,) float32
        Relative to the corner of the root's cell.
    """
    height, width = depth.shape
    inverse = F(1.0 / focal)
    for line in range(height):
        up = (F(0.5) * F(height) - F(line) - F(0.5)) * inverse
        for column in range(width):
            here = depth[line, column]
            if here == np.inf:
                continue
            right = (F(column) + F(0.5) - F(0.5) * F(width)) * inverse
            x = eye[0] + here * (rotation[0, 0] * right + rotation[1, 0] * up + rotation[2, 0])
            y = eye[1] + here * (rotation[0, 1] * right + rotation[1, 1] * up + rotation[2, 1])
            z = eye[2] + here * (rotation[0, 2] * right + rotation[1, 2] * up + rotation[2, 2])
            # Counted on the way down: to note the way first, as `contrast_by_cell` has to, takes 1.6 times as long.
            row, level = 0, 0
            while row >= 0:
                axis, half, place = halvings[level].axis, halvings[level].half, places[row]
                along = x if axis == 0 else (y if axis == 1 else z)
                if along >= half:
                    counts[row, 1] += 1
                    row = place.upper
                    if axis == 0:
                        x -= half
                    elif axis == 1:
                        y -= half
                    else:
                        z -= half
                else:
                    counts[row, 0] += 1
                    row = place.lower
                level += 1


@numba.njit(nogil=True, cache=True, error_model="numpy")
def contrast_by_cell(
    sums: NDArray[np.float64],
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    places: NDArray[Any],
    halvings: NDArray[Any],
    eye: NDArray[np.float32],
    rotation: NDArray[np.float32],
    focal: float,
    reach: float,
    stride: int,
) -> None:  # pragma: no cover - compiled
    """Add the squared difference of covered pixels from others near them to the halves of the cells that they show.

    Parameters
    ----------
    sums : (n, 2) float64
        For the lower and the upper half of the cell of each node of `places`.
    rgb : (h, w, 3) uint8
    depth : (h, w) float32
    eye : (3,) float32
        Relative to the corner of the root's cell.
    reach : float
        How far the others are, over the spacing that the pixel shows; a pixel at least.
    stride : int
        Pixels and lines from one that is looked at to the next.
    """
    height, width = depth.shape
    rows, halves = np.empty(len(halvings) + 1, np.int64), np.empty(len(halvings) + 1, np.int64)
    inverse = F(1.0 / focal)
    for line in range(0, height, stride):
        up = (F(0.5) * F(height) - F(line) - F(0.5)) * inverse
        for column in range(0, width, stride):
            here = depth[line, column]
            if here == np.inf:
                continue
            right = (F(column) + F(0.5) - F(0.5) * F(width)) * inverse
            x = eye[0] + here * (rotation[0, 0] * right + rotation[1, 0] * up + rotation[2, 0])
            y = eye[1] + here * (rotation[0, 1] * right + rotation[1, 1] * up + rotation[2, 1])
            z = eye[2] + here * (rotation[0, 2] * right + rotation[1, 2] * up + rotation[2, 2])
            row, level, spacing = 0, 0, F(0.0)
            while row >= 0:
                axis, half, place = halvings[level].axis, halvings[level].half, places[row]
                along = x if axis == 0 else (y if axis == 1 else z)
                rows[level] = row
                if along >= half:
                    halves[level] = 1
                    row, spacing = place.upper, place.upper_spacing
                    if axis == 0:
                        x -= half
                    elif axis == 1:
                        y -= half
                    else:
                        z -= half
                else:
                    halves[level] = 0
                    row, spacing = place.lower, place.lower_spacing
                level += 1
            # The sign of a spacing says whether a node is missing.
            away = max(int(F(reach * focal) * abs(spacing) / here + F(0.5)), 1)
            total, count = 0, 0
            for direction in range(4):
                step = away if direction < 2 else -away
                i, j = (line + step, column) if direction % 2 else (line, column + step)
                if 0 <= i < height and 0 <= j < width:
                    count += 1
                    for channel in range(3):
                        difference = int(rgb[i, j, channel]) - int(rgb[line, column, channel])
                        total += difference * difference
            if count:
                mean = total / count
                for k in range(level):
                    sums[rows[k], halves[k]] += mean
