"""Normals as the codec stores them, in compiled kernels: turned, predicted by planes; `normals_numpy` is the oracle.

All integers, so every machine finds the same planes. Sums wrap modulo 2**64 where a cloud is odd enough; both engines
wrap alike (docs/format.md, Planes).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from .payload import FIRST_GRID, LAST_GRID, MAX_GRID_SAMPLES, table_bits

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .channels import Channels

KEPT = 20
"""Bits that matrices and vectors are cut to: products of two, and sums of three of them, stay below 2**53."""


def best_turn(
    rows: NDArray[np.uint32], before: NDArray[np.int64], channels: Channels
) -> tuple[int, int, NDArray[np.uint32]]:
    """Return the turn that makes residuals of normals shortest, their bits, and the turned rows."""
    turned = rows.copy()
    turn, cost = _best_turn(rows, before, channels.bits, channels.normals, turned)
    return int(turn), int(cost), turned


def turn_back(rows: NDArray[np.uint32], channels: Channels, turn: int) -> None:
    """Undo the turn of the normals, in place."""
    for first, centre in channels.normals.tolist():
        _turn_back(rows[first], rows[first + 1], centre, turn)


def best_planes(
    position: NDArray[np.uint16], rows: NDArray[np.uint32], before: NDArray[np.int64], channels: Channels, turn: int
) -> tuple[int, int, int, NDArray[np.uint32]]:
    """Find the planes that predict normals best, looking at grids with the turn given, then at turns.

    Returns the grid, 0 for none, the turn, the bits of all residuals, and these, (2 m, k) zigzag.
    """
    k = len(position)
    number = np.empty((2 * len(channels.normals), k), np.uint32)
    if k > MAX_GRID_SAMPLES:
        return 0, 0, 0, number
    grid, turn, cost = _best_planes(
        position, rows, before, channels.bits, channels.normals, turn, table_bits(k), number
    )
    return int(grid), int(turn), int(cost), number


def from_planes(
    position: NDArray[np.uint16],
    before: NDArray[np.int64],
    rows: NDArray[np.uint32],
    channels: Channels,
    grid: int,
    turn: int,
) -> None:
    """Turn residuals of normals, signed in uint32, into codes that are still turned, in place."""
    normal = np.empty((len(position), 3), np.int64)
    _planes(position, grid, table_bits(len(position)), normal)
    for first, centre in channels.normals.tolist():
        _add_planes(normal, before, rows[first], rows[first + 1], int(channels.bits[first]), centre, turn)


@njit(cache=True, nogil=True)
def _bit_length(number: Any) -> Any:
    """Bits of an unsigned number below 2**64."""
    shift = np.uint64(12 if number >> np.uint64(52) else 0)  # a float holds 53 bits
    if number == 0:
        return 0
    return (np.float64(number >> shift).view(np.int64) >> 52) - 1022 + np.int64(shift)


@njit(cache=True, nogil=True)
def _size(residual: Any, bits: int) -> Any:
    """How much a residual takes, in 1/16 bit: the logarithm of the zigzag number + 1, linear between powers of two."""
    number = np.float64(_zigzag(residual, bits) + 1)
    return (number.view(np.int64) >> 48) - (1023 << 4)


@njit(cache=True, nogil=True)
def _zigzag(residual: Any, bits: int) -> Any:
    """Give the smallest residual modulo ``2**bits`` as an unsigned number."""
    levels = np.int64(1) << bits
    residual &= levels - 1
    return 2 * residual if residual < levels >> 1 else 2 * (levels - residual) - 1


@njit(cache=True, nogil=True)
def _unfold(first: Any, second: Any, centre: int) -> Any:
    """Integer point of the octahedron |x| + |y| + |z| = centre of two codes."""
    x, y = np.int64(first) - centre, np.int64(second) - centre
    z = centre - abs(x) - abs(y)
    if z < 0:
        x, y = (centre - abs(y)) * (1 if x >= 0 else -1), (centre - abs(x)) * (1 if y >= 0 else -1)
    return x, y, z


@njit(cache=True, nogil=True)
def _fold(x: int, y: int, z: int, centre: int) -> Any:
    """Canonical codes of an integer point of the octahedron."""
    if z < 0:
        x, y = (centre - abs(y)) * (1 if x >= 0 else -1), (centre - abs(x)) * (1 if y >= 0 else -1)
    return x + centre, y + centre


@njit(cache=True, nogil=True)
def _turned(x: int, y: int, z: int, turn: int) -> Any:
    """Turn a vector; see `_turn`."""
    axis = turn >> 1
    if axis == 1:
        x, y, z = y, z, x
    elif axis == 2:
        x, y, z = z, x, y
    return x, y, -z if turn & 1 else z


@njit(cache=True, nogil=True)
def _turn(first: Any, second: Any, centre: int, turn: int, into_first: Any, into_second: Any) -> None:
    """Turn the octahedron so that another of its six corners is the centre of the map; (0, 0) stays."""
    for i in range(len(first)):
        if first[i] == 0 and second[i] == 0:
            into_first[i] = into_second[i] = 0
            continue
        x, y, z = _unfold(first[i], second[i], centre)
        x, y, z = _turned(x, y, z, turn)
        into_first[i], into_second[i] = _fold(x, y, z, centre)


@njit(cache=True, nogil=True)
def _turn_back(first: Any, second: Any, centre: int, turn: int) -> None:
    """Undo `_turn`, in place."""
    axis, sign = turn >> 1, -1 if turn & 1 else 1
    for i in range(len(first)):
        if first[i] == 0 and second[i] == 0:
            continue
        x, y, z = _unfold(first[i], second[i], centre)
        z *= sign
        if axis == 1:
            x, y, z = z, x, y
        elif axis == 2:
            x, y, z = y, z, x
        first[i], second[i] = _fold(x, y, z, centre)


@njit(cache=True, nogil=True)
def _added_cost(first: Any, second: Any, before: Any, bits: int, centre: int) -> Any:
    """Bits of the residuals where predecessors predict normals."""
    cost = np.int64(0)
    for i in range(len(before)):
        back = before[i]
        u, v = (np.int64(first[i - back]), np.int64(second[i - back])) if back else (centre, centre)
        cost += _size(np.int64(first[i]) - u, bits)
        cost += _size(np.int64(second[i]) - v, bits)
    return cost


@njit(cache=True, nogil=True)
def _best_turn(rows: Any, before: Any, bits: Any, normals: Any, turned: Any) -> Any:
    best, least = 0, np.int64(0)
    for turn in range(6):
        cost = np.int64(0)
        for m in range(len(normals)):
            row, centre = normals[m]
            _turn(rows[row], rows[row + 1], centre, turn, turned[row], turned[row + 1])
            cost += _added_cost(turned[row], turned[row + 1], before, bits[row], centre)
        if turn == 0 or cost < least:
            best, least = turn, cost
    for m in range(len(normals)):
        row, centre = normals[m]
        _turn(rows[row], rows[row + 1], centre, best, turned[row], turned[row + 1])
    return best, least


@njit(cache=True, nogil=True)
def _excess(a: int, b: int, c: int, d: int, e: int, f: int) -> Any:
    """Bits by which the largest of six numbers is longer than `KEPT`."""
    largest = max(a ^ (a >> 63), b ^ (b >> 63), c ^ (c >> 63), d ^ (d >> 63), e ^ (e >> 63), f ^ (f >> 63))
    return max(_bit_length(np.uint64(largest)) - KEPT, 0)


@njit(cache=True, nogil=True)
def _least_axis(xx: Any, yy: Any, zz: Any, xy: Any, xz: Any, yz: Any) -> Any:
    """Direction of least spread of a covariance: two steps of inverse iteration from the nearest axis."""
    cut = _excess(xx, yy, zz, xy, xz, yz)
    xx, yy, zz, xy, xz, yz = xx >> cut, yy >> cut, zz >> cut, xy >> cut, xz >> cut, yz >> cut
    a, b, c = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    d, e, f = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - yz * xx
    cut = _excess(a, b, c, d, e, f)
    a, b, c, d, e, f = a >> cut, b >> cut, c >> cut, d >> cut, e >> cut, f >> cut
    if a >= b and a >= c:
        x, y, z = a, d, e
    elif b >= c:
        x, y, z = d, b, f
    else:
        x, y, z = e, f, c
    x, y, z = a * x + d * y + e * z, d * x + b * y + f * z, e * x + f * y + c * z
    cut = _excess(x, y, z, 0, 0, 0)
    return x >> cut, y >> cut, z >> cut


@njit(cache=True, nogil=True)
def _nodes_around(position: Any, grid: int, table: int, around: Any, weight: Any, own: Any) -> int:
    """Fill in the nodes around each sample, its weights there and its terms of the sums; returns how many nodes."""
    mask = (np.int64(1) << table) - 1
    slot = np.full(1 << (3 * table), -1, np.int32)
    used = 0
    shift, factor = grid >> 2, 32 * (7 - (grid & 3))
    for i in range(len(position)):
        x = (np.int64(position[i, 0]) * factor) >> shift
        y = (np.int64(position[i, 1]) * factor) >> shift
        z = (np.int64(position[i, 2]) * factor) >> shift
        near_x, near_y, near_z = ((x & 31) + 2) >> 2, ((y & 31) + 2) >> 2, ((z & 31) + 2) >> 2
        own[i, 0], own[i, 1], own[i, 2], own[i, 3] = 1, x, y, z
        own[i, 4], own[i, 5], own[i, 6], own[i, 7], own[i, 8], own[i, 9] = x * x, y * y, z * z, x * y, x * z, y * z
        for corner in range(8):
            a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
            key = (((x >> 5) + a) & mask) | ((((y >> 5) + b) & mask) << table)
            key |= (((z >> 5) + c) & mask) << (2 * table)
            at = slot[key]
            if at < 0:
                at = used
                slot[key] = used
                used += 1
            around[i, corner] = at
            weight[i, corner] = (
                (near_x if a else 8 - near_x) * (near_y if b else 8 - near_y) * (near_z if c else 8 - near_z)
            )
    return used


@njit(cache=True, nogil=True)
def _spread(around: Any, weight: Any, own: Any, node: Any) -> None:
    """Add what the samples have to their nodes. A loop of nothing else is one that the compiler turns into vectors."""
    for i in range(len(own)):
        for corner in range(8):
            at, w = around[i, corner], weight[i, corner]
            for which in range(10):
                node[at, which] += w * own[i, which]


@njit(cache=True, nogil=True)
def _planes(position: Any, grid: int, table: int, normal: Any) -> None:
    """Directions of the planes of samples: sums go to the nodes of a grid and come back."""
    k = len(position)
    around, weight = np.empty((k, 8), np.int32), np.empty((k, 8), np.int64)
    own = np.empty((k, 10), np.int64)
    node = np.zeros((_nodes_around(position, grid, table, around, weight, own), 10), np.int64)
    _spread(around, weight, own, node)
    for i in range(k):
        s = x = y = z = xx = yy = zz = xy = xz = yz = np.int64(0)
        for corner in range(8):
            w, sums = weight[i, corner], node[around[i, corner]]
            s += w * sums[0]
            x += w * sums[1]
            y += w * sums[2]
            z += w * sums[3]
            xx += w * sums[4]
            yy += w * sums[5]
            zz += w * sums[6]
            xy += w * sums[7]
            xz += w * sums[8]
            yz += w * sums[9]
        xx, yy, zz = s * xx - x * x, s * yy - y * y, s * zz - z * z
        xy, xz, yz = s * xy - x * y, s * xz - x * z, s * yz - y * z
        normal[i, 0], normal[i, 1], normal[i, 2] = _least_axis(xx, yy, zz, xy, xz, yz)


@njit(cache=True, nogil=True)
def _point(normal: Any, i: int, centre: int) -> Any:
    """Integer point of the octahedron near a plane's direction."""
    x, y, z = normal[i, 0], normal[i, 1], normal[i, 2]
    size = max(abs(x) + abs(y) + abs(z), 1)
    # Floats divide faster and cut as integers do: quotients below 2**17 are whole or 2**-23 away from it.
    u = np.int64(float(2 * centre * abs(x) + size) / float(2 * size))
    v = min(np.int64(float(2 * centre * abs(y) + size) / float(2 * size)), centre - u)
    w = centre - u - v
    return u if x >= 0 else -u, v if y >= 0 else -v, w if z >= 0 else -w


@njit(cache=True, nogil=True)
def _sided(x: int, y: int, z: int, i: int, back: int, first: Any, second: Any, centre: int) -> Any:
    """Choose the point or its opposite: the one on whose side the normal of sample i's predecessor lies."""
    if back:
        a, b, c = _unfold(first[i - back], second[i - back], centre)
    else:
        a, b, c = 0, 0, centre
    return (-x, -y, -z) if x * a + y * b + z * c < 0 else (x, y, z)


@njit(cache=True, nogil=True)
def _guess(normal: Any, i: int, back: int, first: Any, second: Any, centre: int, turn: int) -> Any:
    """Codes of the plane of sample i, given codes of the samples before it; all turned."""
    x, y, z = _point(normal, i, centre)
    x, y, z = _turned(x, y, z, turn)
    x, y, z = _sided(x, y, z, i, back, first, second, centre)
    return _fold(x, y, z, centre)


@njit(cache=True, nogil=True)
def _note(small: Any, above: Any, i: int, back: int, first: Any, second: Any, bits: int) -> None:
    """Remember the residuals of sample i in place i + 1, if they are small, and the place of its predecessor."""
    if 5 * max(abs(first), abs(second)) < np.int64(1) << bits:
        small[i + 1, 0], small[i + 1, 1] = first, second
    above[i + 1] = i + 1 - back if back else 0


@njit(cache=True, nogil=True)
def _carried(small: Any, above: Any, i: int, back: int) -> Any:
    """Guess the residuals of sample i by two up the tree of predecessors; place 0 is nothing."""
    j = i + 1 - back if back else 0
    jj = above[j]
    return (3 * small[j, 0] + small[jj, 0] + 4) >> 3, (3 * small[j, 1] + small[jj, 1] + 4) >> 3


@njit(cache=True, nogil=True)
def _add_planes(normal: Any, before: Any, first: Any, second: Any, bits: int, centre: int, turn: int) -> None:
    k = len(before)
    small = np.zeros((k + 1, 2), np.int64)
    above = np.zeros(k + 1, np.int64)
    levels = (np.int64(1) << bits) - 1
    for i in range(k):
        back = before[i]
        a, b = np.int64(np.int32(first[i])), np.int64(np.int32(second[i]))
        u, v = _guess(normal, i, back, first, second, centre, turn)
        more = _carried(small, above, i, back)
        _note(small, above, i, back, a, b, bits)
        first[i] = np.uint32((u + more[0] + a) & levels)
        second[i] = np.uint32((v + more[1] + b) & levels)


@njit(cache=True, nogil=True)
def _planes_cost(normal: Any, rows: Any, before: Any, bits: Any, normals: Any, turn: int) -> Any:
    """Bits of the residuals where planes predict normals; nothing is carried."""
    cost = np.int64(0)
    for m in range(len(normals)):
        row, centre = normals[m]
        first, second = rows[row], rows[row + 1]
        for i in range(len(before)):
            u, v = _guess(normal, i, before[i], first, second, centre, turn)
            cost += _size(np.int64(first[i]) - u, bits[row])
            cost += _size(np.int64(second[i]) - v, bits[row])
    return cost


@njit(cache=True, nogil=True)
def _first_grid(position: Any, before: Any) -> Any:
    """Give the grid to look at first: cells as wide as the mean distance (L1) of samples from their predecessors."""
    total = np.int64(0)
    for i in range(1, len(before)):
        for axis in range(3):
            total += abs(np.int64(position[i, axis]) - np.int64(position[i - before[i], axis]))
    grid = FIRST_GRID
    while grid < LAST_GRID and (np.int64(len(before)) << (grid >> 2)) < total * (7 - (grid & 3)):
        grid += 1
    return grid


@njit(cache=True, nogil=True)
def _best_turn_of_planes(normal: Any, rows: Any, before: Any, bits: Any, normals: Any, turned: Any) -> int:
    """Find the turn with which planes predict best. Sides do not depend on it, but for samples that have no normal."""
    k = len(before)
    cost = np.zeros(6, np.int64)
    point = np.empty((3, k), np.int64)
    for m in range(len(normals)):
        row, centre = normals[m]
        for i in range(k):
            x, y, z = _point(normal, i, centre)
            x, y, z = _sided(x, y, z, i, before[i], rows[row], rows[row + 1], centre)
            point[0, i], point[1, i], point[2, i] = x, y, z
        for turn in range(6):
            _turn(rows[row], rows[row + 1], centre, turn, turned[row], turned[row + 1])
            for i in range(k):
                x, y, z = _turned(point[0, i], point[1, i], point[2, i], turn)
                u, v = _fold(x, y, z, centre)
                cost[turn] += _size(np.int64(turned[row, i]) - u, bits[row])
                cost[turn] += _size(np.int64(turned[row + 1, i]) - v, bits[row])
    best = 0
    for turn in range(1, 6):
        if cost[turn] < cost[best]:
            best = turn
    return best


@njit(cache=True, nogil=True)
def _best_planes(
    position: Any, rows: Any, before: Any, bits: Any, normals: Any, turn: int, table: int, number: Any
) -> Any:  # fmt: skip
    k = len(before)
    normal = np.empty((k, 3), np.int64)
    turned = np.empty_like(rows)
    for m in range(len(normals)):
        row, centre = normals[m]
        _turn(rows[row], rows[row + 1], centre, turn, turned[row], turned[row + 1])
    best = _first_grid(position, before)
    _planes(position, best, table, normal)
    least = _planes_cost(normal, turned, before, bits, normals, turn)
    for step in (1, -1):
        begin = best
        while FIRST_GRID <= best + step <= LAST_GRID:
            _planes(position, best + step, table, normal)
            cost = _planes_cost(normal, turned, before, bits, normals, turn)
            if cost >= least:
                break
            best, least = best + step, cost
        if best != begin:
            break

    _planes(position, best, table, normal)
    best_turn = _best_turn_of_planes(normal, rows, before, bits, normals, turned)
    cost = np.int64(0)
    for m in range(len(normals)):
        row, centre = normals[m]
        first, second = turned[row], turned[row + 1]
        _turn(rows[row], rows[row + 1], centre, best_turn, first, second)
        small = np.zeros((k + 1, 2), np.int64)
        above = np.zeros(k + 1, np.int64)
        for i in range(k):
            back = before[i]
            u, v = _guess(normal, i, back, first, second, centre, best_turn)
            more = _carried(small, above, i, back)
            a = _zigzag(np.int64(first[i]) - u - more[0], bits[row])
            b = _zigzag(np.int64(second[i]) - v - more[1], bits[row])
            number[2 * m, i], number[2 * m + 1, i] = a, b
            a, b = (a >> 1) ^ -(a & 1), (b >> 1) ^ -(b & 1)
            _note(small, above, i, back, a, b, bits[row])
            cost += _size(a, bits[row]) + _size(b, bits[row])
    return best, best_turn, cost
