"""Turned normals in compiled kernels; `normals_numpy` is the oracle (docs/format.md, Turn)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .channels import Channels


def best_turn(
    rows: NDArray[np.uint32], before: NDArray[np.int64], channels: Channels
) -> tuple[int, NDArray[np.uint32]]:
    """Return the turn that makes residuals of normals shortest, and the turned rows."""
    turned = rows.copy()
    turn = _best_turn(rows, before, channels.bits, channels.normals, turned)
    return int(turn), turned


def turn_back(rows: NDArray[np.uint32], channels: Channels, turn: int) -> None:
    """Undo the turn of the normals, in place."""
    for first, centre in channels.normals.tolist():
        _turn_back(rows[first], rows[first + 1], centre, turn)


@njit(cache=True, nogil=True)
def _zigzag(residual: Any, bits: int) -> Any:
    """Give the smallest residual modulo ``2**bits`` as an unsigned number."""
    levels = np.int64(1) << bits
    residual &= levels - 1
    return 2 * residual if residual < levels >> 1 else 2 * (levels - residual) - 1


@njit(cache=True, nogil=True)
def _size(residual: Any, bits: int) -> Any:
    """How much a residual takes, in 1/16 bit: the logarithm of the zigzag number + 1, linear between powers of two."""
    number = np.float64(_zigzag(residual, bits) + 1)
    return (number.view(np.int64) >> 48) - (1023 << 4)


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
    return best
