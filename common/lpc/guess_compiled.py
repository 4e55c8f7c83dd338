"""Normals and colours guessed from the context of a cloud, in compiled kernels; `guess_numpy` is the oracle.

All integers (docs/format.md, Context); a float only stands for an integer below 2**53.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from .context import Near

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from .attributes import Schema
    from .channels import Channels
    from .context import Part, Place

KEPT = 7
MOST = 64
DIGIT = 12


def box(position: NDArray[np.uint16]) -> tuple[Place, Place]:
    """Smallest and largest local coordinates of (k, 3)."""
    found: tuple[Place, Place] = _box(position)
    return found


def take(parts: Sequence[Part], schema: Schema) -> Near:
    """Take samples of ancestors, one part after another."""
    guessed = [attribute for attribute in schema if attribute.kind != "scalar"]
    most = sum(len(part.cloud) for part in parts)
    place = np.empty((3, most), np.int32)
    rows = np.empty((sum(attribute.components for attribute in guessed), most), np.uint32)
    index = np.empty(most, np.int32)
    count = 0
    for cloud, low, high, away in parts:
        begin = count
        count = int(_inside(cloud.position, low, high, away, begin, place, index))
        row = 0
        for attribute in guessed:
            codes = cloud.codes[attribute.name]
            if attribute.kind == "normal":
                _take_normals(codes, index, begin, count, rows, row)
            else:
                _take_colors(codes, index, begin, count, attribute.bits, rows, row)
            row += attribute.components
    return Near(place[:, :count].copy(), rows[:, :count].copy())


def add_guesses(
    position: NDArray[np.uint16], rows: NDArray[np.uint32], near: Near, channels: Channels, nbits: int
) -> None:
    """Turn the residuals of guessed channels, signed in uint32, into codes, in place."""
    _guess(near.position, near.rows, position, rows, channels.guessed, nbits, True)


def without_guesses(
    position: NDArray[np.uint16], rows: NDArray[np.uint32], near: Near, channels: Channels, nbits: int
) -> NDArray[np.uint32]:
    """Residuals of guessed channels, zigzag, (g, k)."""
    found = rows.copy()
    _guess(near.position, near.rows, position, found, channels.guessed, nbits, False)
    return found[channels.guessed_rows]


@njit(cache=True, nogil=True)
def _box(position: Any) -> Any:
    low_x = low_y = low_z = np.uint16(0xFFFF)
    high_x = high_y = high_z = np.uint16(0)
    for i in range(len(position)):
        x, y, z = position[i, 0], position[i, 1], position[i, 2]
        low_x, low_y, low_z = min(low_x, x), min(low_y, y), min(low_z, z)
        high_x, high_y, high_z = max(high_x, x), max(high_y, y), max(high_z, z)
    return (int(low_x), int(low_y), int(low_z)), (int(high_x), int(high_y), int(high_z))


@njit(cache=True, nogil=True)
def _inside(position: Any, low: Any, high: Any, away: Any, count: int, place: Any, index: Any) -> int:
    """Add places and numbers of the samples from `low` to `high` after the first `count`; how many there are then."""
    low_x, low_y, low_z = np.uint32(low[0]), np.uint32(low[1]), np.uint32(low[2])
    # Below `low` a difference wraps around: one comparison sees both ends.
    size_x, size_y, size_z = np.uint32(high[0]) - low_x, np.uint32(high[1]) - low_y, np.uint32(high[2]) - low_z
    add_x, add_y, add_z = np.int32(away[0]), np.int32(away[1]), np.int32(away[2])
    for i in range(len(position)):
        x, y, z = np.uint32(position[i, 0]), np.uint32(position[i, 1]), np.uint32(position[i, 2])
        # Written always and kept if it is inside: no branch to guess.
        place[0, count], place[1, count], place[2, count] = x + add_x, y + add_y, z + add_z
        index[count] = i
        here = (np.uint32(x - low_x) <= size_x) & (np.uint32(y - low_y) <= size_y) & (np.uint32(z - low_z) <= size_z)
        count += int(here)
    return count


@njit(cache=True, nogil=True)
def _take_normals(codes: Any, index: Any, begin: int, end: int, rows: Any, row: int) -> None:
    for at in range(begin, end):
        i = index[at]
        rows[row, at], rows[row + 1, at] = codes[i, 0], codes[i, 1]


@njit(cache=True, nogil=True)
def _take_colors(codes: Any, index: Any, begin: int, end: int, bits: int, rows: Any, row: int) -> None:
    """Take them as YCoCg-R (`channels`)."""
    modulo = (np.int32(1) << (bits + 1)) - 1
    for at in range(begin, end):
        i = index[at]
        red, green, blue = np.int32(codes[i, 0]), np.int32(codes[i, 1]), np.int32(codes[i, 2])
        orange = red - blue
        base = blue + (orange >> 1)
        lime = green - base
        rows[row, at], rows[row + 1, at], rows[row + 2, at] = base + (lime >> 1), orange & modulo, lime & modulo


@njit(cache=True, nogil=True)
def _spread(value: Any) -> Any:
    """8 bits to every third of 24."""
    value = (value | (value << np.uint32(8))) & np.uint32(0x0000F00F)
    value = (value | (value << np.uint32(4))) & np.uint32(0x000C30C3)
    return (value | (value << np.uint32(2))) & np.uint32(0x00249249)


@njit(cache=True, nogil=True)
def _codes(x: Any, y: Any, z: Any, ahead: int, shift: int, code: Any) -> None:
    """Morton codes of places in one of the orders."""
    by, add = np.uint32(shift), np.uint32(ahead)
    for i in range(len(x)):
        low, middle = _spread((np.uint32(x[i]) + add) >> by), _spread((np.uint32(y[i]) + add) >> by)
        high = _spread((np.uint32(z[i]) + add) >> by)
        code[i] = low | (middle << np.uint32(1)) | (high << np.uint32(2))


@njit(cache=True, nogil=True)
def _sort(code: Any, order: Any, spare: Any, count: Any) -> None:
    """Radix sort of codes of 24 bits, stable, in two passes: `order` gets their numbers."""
    mask = np.uint32((1 << DIGIT) - 1)
    count[:] = 0
    for i in range(len(code)):
        count[0, code[i] & mask] += 1
        count[1, code[i] >> np.uint32(DIGIT)] += 1
    first = second = np.uint32(0)
    for digit in range(1 << DIGIT):
        here = count[0, digit]
        count[0, digit] = first
        first += here
        here = count[1, digit]
        count[1, digit] = second
        second += here
    for i in range(len(code)):
        digit = code[i] & mask
        to = count[0, digit]
        count[0, digit] = to + 1
        # High digit and number travel as one: half the stores.
        spare[to] = np.uint64(code[i] >> np.uint32(DIGIT)) << np.uint64(32) | np.uint64(i)
    for i in range(len(code)):
        pair = spare[i]
        digit = pair >> np.uint64(32)
        to = count[1, digit]
        count[1, digit] = to + 1
        order[to] = np.uint32(pair)


@njit(cache=True, nogil=True)
def _beside(near: Any, columns: Any, nbits: int, line: Any, start: Any) -> None:
    """Order the context twice: `line` gets its numbers after two times n, `start` where in it a sample's company is."""
    k, n = columns.shape[1], near.shape[1]
    code, order, spare = np.empty(k + n, np.uint32), np.empty(k + n, np.uint32), np.empty(k + n, np.uint64)
    count = np.empty((2, 1 << DIGIT), np.uint32)
    shift = max(0, nbits - KEPT)
    for which in range(2):
        ahead = which * ((1 << nbits) // 3)
        # The cloud's own come first: of equal codes those of the context stand after them.
        _codes(columns[0], columns[1], columns[2], ahead, shift, code[:k])
        _codes(near[0], near[1], near[2], ahead, shift, code[k:])
        _sort(code, order, spare, count)
        below = np.uint32(0)
        for at in range(k + n):
            i = order[at]
            # Both are written always, and what does not hold is written over: no branch to guess.
            line[which, below + np.uint32(2)] = i - np.uint32(k)
            start[which, min(i, np.uint32(k))] = below
            below += np.uint32(i >= np.uint32(k))
        line[which, 0] = line[which, 1] = line[which, n + 2] = line[which, n + 3] = n


@njit(cache=True, nogil=True)
def _unfold(first: Any, second: Any, centre: Any) -> Any:
    """Integer point of the octahedron |x| + |y| + |z| = centre of two codes; 0 for no normal."""
    if first == 0 and second == 0:
        return 0, 0, 0
    x, y = np.int64(first) - centre, np.int64(second) - centre
    z = centre - abs(x) - abs(y)
    if z < 0:
        x, y = (centre - abs(y)) * (1 if x >= 0 else -1), (centre - abs(x)) * (1 if y >= 0 else -1)
    return x, y, z


@njit(cache=True, nogil=True)
def _fold(x: Any, y: Any, z: Any, centre: Any) -> Any:
    """Canonical codes of an integer point of the octahedron; 0 for no normal."""
    if x == 0 and y == 0 and z == 0:
        return 0, 0
    if z < 0:
        x, y = (centre - abs(y)) * (1 if x >= 0 else -1), (centre - abs(x)) * (1 if y >= 0 else -1)
    return x + centre, y + centre


@njit(cache=True, nogil=True)
def _chroma(code: Any, bits: int) -> Any:
    """Chroma with its sign."""
    value = np.int64(code)
    return value - ((value & (1 << bits)) << 1)


@njit(cache=True, nogil=True)
def _value(rows: Any, row: int, i: int, normal: int, bits: int, values: Any, to: int, at: int) -> None:
    """Set three signed numbers of a field: the point of a normal, or a colour's YCoCg-R."""
    if normal:
        x, y, z = _unfold(rows[row, i], rows[row + 1, i], (1 << (bits - 1)) - 1)
    else:
        x, y, z = np.int64(rows[row, i]), _chroma(rows[row + 1, i], bits), _chroma(rows[row + 2, i], bits)
    values[to, at], values[to, at + 1], values[to, at + 2] = x, y, z


@njit(cache=True, nogil=True)
def _zigzag(residual: Any, bits: Any) -> Any:
    levels = np.int64(1) << bits
    residual &= levels - 1
    return 2 * residual if residual < levels >> 1 else 2 * (levels - residual) - 1


@njit(cache=True, nogil=True)
def _part(side: Any, centre: Any, length: Any) -> Any:
    """Share of a side in the length, in units of 1 / centre, rounded to the nearest."""
    # Numbers below 2**53, quotients below 2**16: cutting the float cuts the quotient.
    part = np.int64(np.float64(2 * centre * abs(side) + length) / np.float64(2 * length))
    return part if side >= 0 else -part


@njit(cache=True, nogil=True)
def _normal(
    x: Any, y: Any, z: Any, rows: Any, row: Any, i: int, bits: Any, decoding: bool, values: Any, own: Any, at: Any
) -> Any:
    """Decode or encode a normal whose guess lies along (x, y, z); whether it is one."""
    centre = (np.int64(1) << (bits - 1)) - 1
    length = max(abs(x) + abs(y) + abs(z), 1)
    if abs(x) >= abs(y) and abs(x) >= abs(z):
        largest = 0
        x, y, z = y, z, x
    elif abs(y) >= abs(z):
        largest = 1
        x, y, z = z, x, y
    else:
        largest = 2
    sign = -1 if z < 0 else 1
    guess_x, guess_y = _part(x, centre, length) + centre, _part(y, centre, length) + centre
    if not decoding:
        x, y, z = values[own, at + (largest + 1) % 3], values[own, at + (largest + 2) % 3], values[own, at + largest]
        first, second = _fold(x, y, z * sign, centre)
        rows[row, i], rows[row + 1, i] = _zigzag(first - guess_x, bits), _zigzag(second - guess_y, bits)
        return True
    mask = (np.int64(1) << bits) - 1
    first = (guess_x + np.int64(np.int32(rows[row, i]))) & mask
    second = (guess_y + np.int64(np.int32(rows[row + 1, i]))) & mask
    x, y, z = _unfold(first, second, centre)
    z *= sign
    if largest == 0:
        x, y, z = z, x, y
    elif largest == 1:
        x, y, z = y, z, x
    values[own, at], values[own, at + 1], values[own, at + 2] = x, y, z
    rows[row, i], rows[row + 1, i] = _fold(x, y, z, centre)
    return first <= 2 * centre and second <= 2 * centre


@njit(cache=True, nogil=True)
def _mean(total: Any, weight: Any) -> Any:
    """Mean rounded to the nearest, halves up; 0 where there is nothing."""
    return (2 * total + weight) // (2 * weight) if weight else np.int64(0)


@njit(cache=True, nogil=True)
def _color(
    x: Any, y: Any, z: Any, total: Any, rows: Any, row: Any, i: int, bits: Any, decoding: bool, values: Any, own: Any,
    at: Any,
) -> None:  # fmt: skip
    """Decode or encode a colour of such sums."""
    y_guess, co_guess, cg_guess = _mean(x, total), _mean(y, total), _mean(z, total)
    if not decoding:
        rows[row, i] = _zigzag(values[own, at] - y_guess, bits)
        rows[row + 1, i] = _zigzag(values[own, at + 1] - co_guess, bits + 1)
        rows[row + 2, i] = _zigzag(values[own, at + 2] - cg_guess, bits + 1)
        return
    mask = (np.int64(1) << bits) - 1
    rows[row, i] = (y_guess + np.int64(np.int32(rows[row, i]))) & mask
    mask = 2 * mask + 1
    rows[row + 1, i] = (co_guess + np.int64(np.int32(rows[row + 1, i]))) & mask
    rows[row + 2, i] = (cg_guess + np.int64(np.int32(rows[row + 2, i]))) & mask
    _value(rows, row, i, 0, bits, values, own, at)


@njit(cache=True, nogil=True)
def _guess(near: Any, near_rows: Any, position: Any, rows: Any, guessed: Any, nbits: int, decoding: bool) -> None:
    """Decode the rows that are guessed, or encode them, in place."""
    k, n, fields = len(position), near.shape[1], len(guessed)
    columns = np.empty((3, k), np.uint16)
    # Of the context, of who is missing, number n, far away and worth nothing, and of the cloud: places, then values.
    table = np.zeros((n + 1 + k, 4 + 4 * fields), np.int32)
    for i in range(n):
        table[i, 0], table[i, 1], table[i, 2] = near[0, i], near[1, i], near[2, i]
    table[n, 0] = table[n, 1] = table[n, 2] = 1 << 30
    for i in range(k):
        x, y, z = position[i, 0], position[i, 1], position[i, 2]
        columns[0, i], columns[1, i], columns[2, i] = x, y, z
        table[n + 1 + i, 0], table[n + 1 + i, 1], table[n + 1 + i, 2] = x, y, z
    row = 0
    for field in range(fields):
        at = 4 + 4 * field
        for i in range(n):
            _value(near_rows, row, i, guessed[field, 1], guessed[field, 2], table, i, at)
        if not decoding:
            for i in range(k):
                _value(rows, guessed[field, 0], i, guessed[field, 1], guessed[field, 2], table, n + 1 + i, at)
        row += 2 if guessed[field, 1] else 3
    line, start = np.empty((2, n + 4), np.uint32), np.empty((2, k + 1), np.uint32)
    _beside(near, columns, nbits, line, start)

    sound = np.ones(fields, np.bool_)
    member, weight = np.empty(10, np.uint32), np.empty(10, np.int64)
    distance = np.empty(10, np.float64)
    bits_of = distance.view(np.int64)
    for layer in range(3):
        begin, step, reach = (0, 4, 0) if layer == 0 else (2, 4, 2) if layer == 1 else (1, 2, 1)
        for i in range(begin, k, step):
            own = np.uint32(n + 1 + i)
            first, second = start[0, i], start[1, i]
            for which in range(4):
                member[which], member[4 + which] = line[0, first + which], line[1, second + which]
            member[8] = own - reach if reach else n
            member[9] = own + reach if reach and i + reach < k else n
            x, y, z = table[own, 0], table[own, 1], table[own, 2]
            for m in range(10):
                at = member[m]
                dx, dy, dz = np.float64(table[at, 0] - x), np.float64(table[at, 1] - y), np.float64(table[at, 2] - z)
                distance[m] = dx * dx + dy * dy + dz * dz + 1.0
            nearest = bits_of[0]
            for m in range(1, 10):
                nearest = min(nearest, bits_of[m])
            nearest >>= 51
            total = np.int64(0)
            for m in range(10):
                weight[m] = np.int64(MOST) >> min((bits_of[m] >> 51) - nearest, 7)
                total += weight[m]
            for field in range(fields):
                to = 4 + 4 * field
                x, y, z = np.int64(0), np.int64(0), np.int64(0)
                for m in range(10):
                    at = member[m]
                    x += weight[m] * table[at, to]
                    y += weight[m] * table[at, to + 1]
                    z += weight[m] * table[at, to + 2]
                row, bits = guessed[field, 0], guessed[field, 2]
                if guessed[field, 1]:
                    sound[field] &= _normal(x, y, z, rows, row, i, bits, decoding, table, own, to)
                else:
                    _color(x, y, z, total, rows, row, i, bits, decoding, table, own, to)
    if decoding:
        for field in range(fields):
            if not sound[field]:
                rows[guessed[field, 0], :] = (1 << guessed[field, 2]) - 1
