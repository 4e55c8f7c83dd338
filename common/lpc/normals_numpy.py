"""Turned normals in plain numpy: the oracle of `normals_compiled` (docs/format.md, Turn)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .octahedral import fold_codes, unfold_codes
from .payload import TURNS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .channels import Channels

    Signed = NDArray[np.int64]


def turn_back(rows: NDArray[np.uint32], channels: Channels, turn: int) -> None:
    """Undo the turn of the normals, in place."""
    axis, sign = turn >> 1, -1 if turn & 1 else 1
    for first, centre in channels.normals.tolist():
        stored = unfold_codes(rows[first : first + 2], centre)
        points = np.empty_like(stored)
        points[axis], points[(axis + 1) % 3], points[(axis + 2) % 3] = stored[0], stored[1], sign * stored[2]
        none = (rows[first : first + 2] == 0).all(axis=0)
        rows[first : first + 2] = np.where(none, 0, fold_codes(points, centre))


def best_turn(rows: NDArray[np.uint32], before: Signed, channels: Channels) -> tuple[int, NDArray[np.uint32]]:
    """Return the turn that makes residuals of normals shortest, and the turned rows."""
    turned = [_turn(rows, channels, turn) for turn in range(TURNS)]

    def cost(rows: NDArray[np.uint32]) -> int:
        total = 0
        for row in (channels.normals[:, :1] + (0, 1)).ravel().tolist():
            value = rows[row].astype(np.int64)
            guess = np.where(before == 0, int(channels.start[row]), value[np.arange(len(value)) - before])
            total += int(_size(_smallest(value - guess, int(channels.bits[row]))).sum())
        return total

    best = min(range(TURNS), key=lambda turn: cost(turned[turn]))
    return best, turned[best]


def _turn(rows: NDArray[np.uint32], channels: Channels, turn: int) -> NDArray[np.uint32]:
    """Turn the octahedron so that another of its six corners is the centre of the map; (0, 0) stays."""
    turned = rows.copy()
    for first, centre in channels.normals.tolist():
        point = unfold_codes(rows[first : first + 2], centre)
        axis, sign = turn >> 1, -1 if turn & 1 else 1
        stored = np.stack([point[axis], point[(axis + 1) % 3], sign * point[(axis + 2) % 3]])
        none = (rows[first : first + 2] == 0).all(axis=0)
        turned[first : first + 2] = np.where(none, 0, fold_codes(stored, centre))
    return turned


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
