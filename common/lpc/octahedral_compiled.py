"""Both ways of `octahedral` as compiled kernels: the same arithmetic, sample by sample."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray


def nearest_codes(normals: NDArray[np.float64], bits: int) -> NDArray[np.uint16]:
    """Codes (n, 2) of (n, 3) vectors; see `octahedral.encode_normals`."""
    codes = np.empty((len(normals), 2), np.uint16)
    _nearest_codes(normals, float((1 << (bits - 1)) - 1), codes)
    return codes


def unit_vectors(codes: NDArray[Any], bits: int) -> NDArray[np.float32]:
    """Give unit normals (n, 3) of (n, 2) codes; see `octahedral.decode_normals`."""
    normals = np.empty((len(codes), 3), np.float32)
    _unit_vectors(np.ascontiguousarray(codes, np.uint16), (1 << (bits - 1)) - 1, normals)
    return normals


@njit(cache=True, nogil=True)
def _unit_vectors(codes: Any, centre: int, normals: Any) -> None:
    for i in range(len(codes)):
        u, v = np.int64(codes[i, 0]) - centre, np.int64(codes[i, 1]) - centre
        if u == -centre and v == -centre:
            normals[i, 0] = normals[i, 1] = normals[i, 2] = np.float32(0)
            continue
        w = centre - abs(u) - abs(v)
        if w < 0:
            u, v = (centre - abs(v)) * (1 if u >= 0 else -1), (centre - abs(u)) * (1 if v >= 0 else -1)
        x, y, z = np.float32(u), np.float32(v), np.float32(w)
        length = np.sqrt(x * x + y * y + z * z)
        normals[i, 0], normals[i, 1], normals[i, 2] = x / length, y / length, z / length


@njit(cache=True, nogil=True)
def _nearest_codes(normals: Any, half: float, codes: Any) -> None:
    for i in range(len(normals)):
        x, y, z = float(normals[i, 0]), float(normals[i, 1]), float(normals[i, 2])
        largest = max(abs(x), abs(y), abs(z))
        if not (largest > 0.0 and largest < np.inf) or x != x or y != y or z != z:
            codes[i, 0] = codes[i, 1] = 0
            continue
        x, y, z = x / largest, y / largest, z / largest
        size = abs(x) + abs(y) + abs(z)
        u, v = x / size, y / size
        if z < 0.0:
            u, v = (
                (1.0 - abs(y / size)) * (1.0 if x >= 0.0 else -1.0),
                (1.0 - abs(x / size)) * (1.0 if y >= 0.0 else -1.0),
            )
        low_u, low_v = np.floor((u + 1.0) * half), np.floor((v + 1.0) * half)
        best, best_square = -1.0, 1.0
        for corner in range(4):
            a, b = min(low_u + (corner & 1), 2.0 * half), min(low_v + (corner >> 1), 2.0 * half)
            p, q = a / half - 1.0, b / half - 1.0
            w = 1.0 - abs(p) - abs(q)
            if w < 0.0:
                p, q = (
                    (1.0 - abs(q)) * (1.0 if p >= 0.0 else -1.0),
                    (1.0 - abs(p)) * (1.0 if q >= 0.0 else -1.0),
                )
            dot, square = max(p * x + q * y + w * z, 0.0), p * p + q * q + w * w
            dot *= dot
            if dot * best_square > best * square:
                best, best_square = dot, square
                codes[i, 0], codes[i, 1] = np.uint16(a), np.uint16(b)
        a, b = float(codes[i, 0]), float(codes[i, 1])
        if b in (0.0, 2.0 * half):
            codes[i, 0] = np.uint16(max(a, 2.0 * half - a))
        if a in (0.0, 2.0 * half):
            codes[i, 1] = np.uint16(max(b, 2.0 * half - b))
