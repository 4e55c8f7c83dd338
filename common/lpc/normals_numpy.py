"""Normals as the codec stores them, in plain numpy: turned, and predicted by planes (docs/format.md, Planes).

The oracle of `normals_compiled`, and what runs where numba is missing. Only the side of its plane on which a normal
lies depends on the samples before it. That is one bit, so `from_planes` decodes a cloud for both sides and composes
functions of one bit by pointer doubling.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .octahedral import fold_codes, unfold_codes
from .payload import FIRST_GRID, LAST_GRID, MAX_GRID_SAMPLES, TURNS, table_bits

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .channels import Channels

    Signed = NDArray[np.int64]

KEPT = 20
"""Bits that matrices and vectors are cut to: products of two, and sums of three of them, stay below 2**53."""

_PRODUCTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_COMPOSED = np.array(
    [[(outer >> (inner & 1) & 1) | (outer >> (inner >> 1) & 1) << 1 for inner in range(4)] for outer in range(4)],
    np.uint8,
).ravel()
"""Functions of a bit, written as their values for 0 and 1: ``_COMPOSED[4 * outer + inner]``."""


def turn_back(rows: NDArray[np.uint32], channels: Channels, turn: int) -> None:
    """Undo the turn of the normals, in place."""
    axis, sign = turn >> 1, -1 if turn & 1 else 1
    for first, centre in channels.normals.tolist():
        stored = unfold_codes(rows[first : first + 2], centre)
        points = np.empty_like(stored)
        points[axis], points[(axis + 1) % 3], points[(axis + 2) % 3] = stored[0], stored[1], sign * stored[2]
        none = (rows[first : first + 2] == 0).all(axis=0)
        rows[first : first + 2] = np.where(none, 0, fold_codes(points, centre))


def best_turn(
    rows: NDArray[np.uint32], before: Signed, channels: Channels
) -> tuple[int, int, NDArray[np.uint32]]:  # fmt: skip
    """Return the turn that makes residuals of normals shortest, their cost, and the turned rows."""
    turned = [_turn(rows, channels, turn) for turn in range(TURNS)]

    def cost(rows: NDArray[np.uint32]) -> int:
        total = 0
        for row in channels.normal_rows.tolist():
            value = rows[row].astype(np.int64)
            guess = np.where(before == 0, int(channels.start[row]), value[np.arange(len(value)) - before])
            total += int(_size(_smallest(value - guess, int(channels.bits[row]))).sum())
        return total

    best = min(range(TURNS), key=lambda turn: cost(turned[turn]))
    return best, cost(turned[best]), turned[best]


def best_planes(
    position: NDArray[np.uint16], rows: NDArray[np.uint32], before: Signed, channels: Channels, turn: int
) -> tuple[int, int, int, NDArray[np.uint32]]:
    """Find the planes that predict normals best, looking at grids with the turn given, then at turns.

    Returns the grid, 0 for none, the turn, the cost of all residuals, and these, (2 m, k) zigzag.
    """
    if len(position) > MAX_GRID_SAMPLES:
        return 0, 0, 0, np.empty((2 * len(channels.normals), len(position)), np.uint32)
    turned = _turn(rows, channels, turn)

    def cost(grid: int) -> int:
        normal = _planes(position, grid)
        return sum(
            int(_size(residual).sum()) for residual in _residuals(normal, turned, turned, before, channels, turn)
        )

    best = _first_grid(position, before)
    least = cost(best)
    for step in (1, -1):
        begin = best
        while FIRST_GRID <= best + step <= LAST_GRID and (here := cost(best + step)) < least:
            best, least = best + step, here
        if best != begin:
            break

    normal = _planes(position, best)
    costs = [
        sum(
            int(_size(residual).sum())
            for residual in _residuals(normal, rows, _turn(rows, channels, turn), before, channels, turn, sides_turn=0)
        )
        for turn in range(TURNS)
    ]
    turn = costs.index(min(costs))
    turned = _turn(rows, channels, turn)
    numbers, total = [], 0
    for wanted, (first, _) in zip(
        _residuals(normal, turned, turned, before, channels, turn), channels.normals.tolist(), strict=True
    ):
        residual = _uncarried(wanted, before, int(channels.bits[first]))
        total += int(_size(residual).sum())
        numbers.append(_zigzag(residual))
    return best, turn, total, np.concatenate(numbers).astype(np.uint32)


def from_planes(
    position: NDArray[np.uint16],
    before: Signed,
    rows: NDArray[np.uint32],
    channels: Channels,
    grid: int,
    turn: int,
) -> None:
    """Turn residuals of normals, signed in uint32, into codes that are still turned, in place."""
    k = len(position)
    normal = _planes(position, grid)
    parent = np.arange(k) - before
    jump = np.where(before == 0, 0, parent + 1)
    for first, centre in channels.normals.tolist():
        bits = int(channels.bits[first])
        residual = rows[first : first + 2].view(np.int32).astype(np.int64)
        point = _turn_points(_points(normal, centre), turn)
        step = residual + _carried(residual, before, bits)
        sides = [((_codes(side, centre) + step) & ((1 << bits) - 1)) for side in (point, -point)]
        met = [
            ((point * _point_of(codes, centre).take(parent, axis=1)).sum(axis=0) < 0) for codes in sides
        ]  # fmt: skip
        root = point[2] < 0  # there the normal before it is (0, 0, 1)
        side = np.zeros(k + 1, np.uint8)  # place 0: before the first sample
        side[1:] = np.where(before == 0, 3 * root, met[0] | (met[1].astype(np.uint8) << 1))
        follow = np.concatenate(([0], jump))
        while follow.any():
            side = _COMPOSED.take(4 * side + side.take(follow))
            follow = follow.take(follow)
        rows[first : first + 2] = np.where(side[1:] & 1, sides[1], sides[0])


def _planes(position: NDArray[np.uint16], grid: int) -> Signed:
    """Directions (3, k) of the planes of samples: sums go to the nodes of a grid and come back."""
    k = len(position)
    table = table_bits(k)
    u = (position.T.astype(np.int64, order="C") * (32 * (7 - (grid & 3)))) >> (grid >> 2)
    cell = u >> 5
    near = ((u & 31) + 2) >> 2
    weights = np.stack([8 - near, near], axis=1)
    keys = np.stack([cell, cell + 1], axis=1) & ((1 << table) - 1)
    keys <<= np.array([0, table, 2 * table])[:, None, None]
    weight = (weights[2][:, None, None] * weights[1][None, :, None] * weights[0][None, None, :]).reshape(8, k)
    key = (keys[2][:, None, None] | keys[1][None, :, None] | keys[0][None, None, :]).reshape(-1)
    slots = np.empty(1 << (3 * table), np.int32)
    slots[key] = np.arange(8 * k, dtype=np.int32)
    node = slots.take(key).astype(np.intp)
    sums, shares = np.empty(8 * k, np.int64), np.empty((8, k), np.int64)

    def spread(own: Signed) -> Signed:
        sums.fill(0)
        np.multiply(weight, own, out=shares)
        np.add.at(sums, node, shares.ravel())
        np.take(sums, node, out=shares.reshape(-1), mode="clip")
        np.multiply(shares, weight, out=shares)
        return np.add.reduce(shares)

    total = spread(np.ones(k, np.int64))
    first = [spread(axis) for axis in u]
    covariance = np.stack([total * spread(u[a] * u[b]) - first[a] * first[b] for a, b in _PRODUCTS])
    return _least_axis(covariance)


def _least_axis(covariance: Signed) -> Signed:
    """Directions (3, k) of least spread: two steps of inverse iteration from the nearest axis."""
    xx, yy, zz, xy, xz, yz = _cut(covariance)
    a, b, c, d, e, f = _cut(np.stack([
        yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy,
        xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - yz * xx,
    ]))  # fmt: skip
    in_a, in_b = (a >= b) & (a >= c), b >= c
    x, y, z = (
        np.where(in_a, a, np.where(in_b, d, e)),
        np.where(in_a, d, np.where(in_b, b, f)),
        np.where(in_a, e, np.where(in_b, f, c)),
    )
    return _cut(np.stack([a * x + d * y + e * z, d * x + b * y + f * z, e * x + f * y + c * z]))


def _cut(values: Signed) -> Signed:
    """Shift columns right until their largest number has `KEPT` bits."""
    largest = (values ^ (values >> 63)).max(axis=0)
    return values >> np.maximum(_bit_length(largest) - KEPT, 0)


def _bit_length(number: Signed) -> Signed:
    """Bits of numbers below 2**63."""
    top = (number & ~(number >> 1)).astype(np.float64)  # without the bit below the top one nothing is rounded up
    return (top.view(np.int64) >> 52) - 1022  # far below 0 for 0


def _points(normal: Signed, centre: int) -> Signed:
    """Integer points (3, k) of the octahedron near directions."""
    size = np.abs(normal)
    total = np.maximum(size.sum(axis=0), 1)
    u = (2 * centre * size[0] + total) // (2 * total)
    v = np.minimum((2 * centre * size[1] + total) // (2 * total), centre - u)
    return np.stack([u, v, centre - u - v]) * np.where(normal >= 0, 1, -1)


def _codes(points: Signed, centre: int) -> Signed:
    return fold_codes(points.astype(np.int32), centre).astype(np.int64)


def _point_of(codes: NDArray[Any], centre: int) -> Signed:
    return unfold_codes(codes, centre).astype(np.int64)


def _turn_points(point: Signed, turn: int) -> Signed:
    """Turn (3, k) vectors."""
    axis, sign = turn >> 1, -1 if turn & 1 else 1
    return np.stack([point[axis], point[(axis + 1) % 3], sign * point[(axis + 2) % 3]])


def _turn(rows: NDArray[np.uint32], channels: Channels, turn: int) -> NDArray[np.uint32]:
    """Turn the octahedron so that another of its six corners is the centre of the map; (0, 0) stays."""
    turned = rows.copy()
    for first, centre in channels.normals.tolist():
        stored = _turn_points(_point_of(rows[first : first + 2], centre), turn)
        none = (rows[first : first + 2] == 0).all(axis=0)
        turned[first : first + 2] = np.where(none, 0, _codes(stored, centre))
    return turned


def _residuals(
    normal: Signed,
    known: NDArray[np.uint32],
    wanted: NDArray[np.uint32],
    before: Signed,
    channels: Channels,
    turn: int,
    sides_turn: int | None = None,
) -> list[Signed]:
    """Give residuals (2, k) of each normal, nothing carried; rows `known`, of another turn maybe, tell the sides."""
    found = []
    for first, centre in channels.normals.tolist():
        point = _points(normal, centre)
        near = _turn_points(point, turn if sides_turn is None else sides_turn)
        last = _point_of(known[first : first + 2], centre)[:, np.arange(len(before)) - before]
        last = np.where(before == 0, np.array([[0], [0], [centre]]), last)
        sided = np.where((near * last).sum(axis=0) < 0, -1, 1) * _turn_points(point, turn)
        difference = wanted[first : first + 2].astype(np.int64) - _codes(sided, centre)
        found.append(_smallest(difference, int(channels.bits[first])))
    return found


def _carried(residual: Signed, before: Signed, bits: int) -> Signed:
    """Guess residuals by two up the tree of predecessors; large ones tell nothing."""
    small = np.where(5 * np.abs(residual).max(axis=0) < 1 << bits, residual, 0)
    parent = np.arange(len(before)) - before
    one = np.where(before == 0, 0, small.take(parent, axis=1))
    two = np.where((before == 0) | (before[parent] == 0), 0, small.take(parent[parent], axis=1))
    return (3 * one + two + 4) >> 3


def _uncarried(wanted: Signed, before: Signed, bits: int) -> Signed:
    """Residuals to store, so that with what is carried they are `wanted` modulo ``2**bits``."""
    residual = np.zeros_like(wanted)
    for i in range(len(before)):
        carried = np.full(2, 4)
        at = i
        for factor in (3, 1):
            if not before[at]:
                break
            at -= int(before[at])
            if 5 * np.abs(residual[:, at]).max() < 1 << bits:
                carried += factor * residual[:, at]
        residual[:, i] = _smallest(wanted[:, i] - (carried >> 3), bits)
    return residual


def _smallest(residual: Signed, bits: int) -> Signed:
    """Residuals modulo ``2**bits``, from -2**(bits - 1) on."""
    half = 1 << (bits - 1)
    return ((residual + half) & (2 * half - 1)) - half


def _zigzag(residual: Signed) -> Signed:
    return np.where(residual >= 0, 2 * residual, -2 * residual - 1)


def _size(residual: Signed) -> Signed:
    """How much residuals take, in 1/16 bit: the logarithm of the zigzag number + 1, linear between powers of two."""
    number = (_zigzag(residual) + 1).astype(np.float64)
    return (number.view(np.int64) >> 48) - (1023 << 4)


def _first_grid(position: NDArray[np.uint16], before: Signed) -> int:
    """Give the grid to look at first: cells as wide as the mean distance (L1) of samples from their predecessors."""
    wide = position.astype(np.int64)
    total = int(np.abs(wide - wide[np.arange(len(wide)) - before]).sum())
    grid = FIRST_GRID
    while grid < LAST_GRID and (len(wide) << (grid >> 2)) < total * (7 - (grid & 3)):
        grid += 1
    return grid
