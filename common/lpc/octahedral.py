"""Unit normals as two small integers: the octahedral map (Meyer, Suessmuth, Sussner, Stamminger and Greiner 2010).

``2**b - 1`` levels an axis, so the centre and the poles are exact (docs/format.md, Normals).
"""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def _code_dtype(bits: int) -> type[np.uint8 | np.uint16]:
    if not 2 <= bits <= 16:
        raise ValueError(f"normals of {bits} bits an axis (2 to 16 are allowed)")
    return np.uint8 if bits <= 8 else np.uint16


def encode_normals(
    normals: NDArray[Any], bits: int = 8, *, engine: Literal["auto", "numpy", "compiled"] = "auto"
) -> NDArray[Any]:
    """Codes of normals, chosen among the four roundings by the least angle.

    Parameters
    ----------
    normals : ndarray, (n, 3)
        Any length; zero and not finite vectors mean "no normal".
    bits : int
        Bits an axis, 2 to 16.
    engine : {"auto", "numpy", "compiled"}
        "auto" takes the compiled kernel if numba is installed. The codes are the same.

    Returns
    -------
    ndarray, (n, 2) uint8 or uint16
        (0, 0) for "no normal" and for nothing else.
    """
    dtype = _code_dtype(bits)
    wide = np.ascontiguousarray(normals, np.float64).reshape(-1, 3)
    if engine == "compiled" or (engine == "auto" and find_spec("numba")):
        from .octahedral_compiled import nearest_codes

        return nearest_codes(wide, bits).astype(dtype)
    return _nearest_codes(wide, bits).astype(dtype)


def _nearest_codes(normals: NDArray[np.float64], bits: int) -> NDArray[np.float64]:
    """(n, 2) codes: the oracle of `octahedral_compiled`."""
    half = float((1 << (bits - 1)) - 1)
    with np.errstate(invalid="ignore"):
        largest = np.abs(normals).max(axis=1)
    real = (largest > 0.0) & (largest < np.inf)
    unit = np.where(real[:, None], normals, (0.0, 0.0, 1.0)) / np.where(real, largest, 1.0)[:, None]
    x, y, z = unit.T
    size = np.abs(x) + np.abs(y) + np.abs(z)
    u, v = x / size, y / size
    folded = z < 0.0
    u, v = np.where(folded, (1.0 - np.abs(v)) * _sign(u), u), np.where(folded, (1.0 - np.abs(u)) * _sign(v), v)
    low_u, low_v = np.floor((u + 1.0) * half), np.floor((v + 1.0) * half)
    best, best_square = np.full(len(unit), -1.0), np.ones(len(unit))
    codes = np.zeros((len(unit), 2))
    for corner in range(4):
        a, b = np.minimum(low_u + (corner & 1), 2.0 * half), np.minimum(low_v + (corner >> 1), 2.0 * half)
        p, q, w = _unfold(a / half - 1.0, b / half - 1.0)
        dot, square = np.maximum(p * x + q * y + w * z, 0.0) ** 2, p * p + q * q + w * w
        better = dot * best_square > best * square  # cos^2 without a division
        best[better], best_square[better] = dot[better], square[better]
        codes[better, 0], codes[better, 1] = a[better], b[better]
    edge = (codes == 0.0) | (codes == 2.0 * half)  # where two codes or four mean one direction
    codes = np.where(edge[:, ::-1], np.maximum(codes, 2.0 * half - codes), codes)
    codes[~real] = 0.0
    return codes


def decode_normals(codes: NDArray[Any], bits: int = 8) -> NDArray[np.float32]:
    """Give unit normals of (n, 2) codes, (n, 3) float32; the zero vector for (0, 0)."""
    _code_dtype(bits)
    normals = np.ascontiguousarray(unfold_codes(codes.T, (1 << (bits - 1)) - 1).T, np.float32)
    normals /= np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
    normals[(codes == 0).all(axis=1)] = 0.0
    return normals


def unfold_codes(codes: NDArray[Any], centre: int) -> NDArray[np.int32]:
    """Integer points (3, n) with ``|x| + |y| + |z| = centre`` of codes (2, n)."""
    u, v = codes.astype(np.int32) - centre
    w = centre - np.abs(u) - np.abs(v)
    below = w < 0
    folded = (centre - np.abs(v)) * _sign(u), (centre - np.abs(u)) * _sign(v)
    return np.stack([np.where(below, folded[0], u), np.where(below, folded[1], v), w])


def fold_codes(points: NDArray[np.int32], centre: int) -> NDArray[np.int32]:
    """Codes (2, n) of integer points (3, n): of the two or four that mean one direction, the canonical one."""
    x, y, z = points
    below = z < 0
    u = np.where(below, (centre - np.abs(y)) * _sign(x), x)
    v = np.where(below, (centre - np.abs(x)) * _sign(y), y)
    return np.stack([u, v]) + centre


def max_error_degrees(bits: int) -> float:
    """No normal moves further than this, in degrees.

    A step s in (u, v) moves the direction most at the centre of a face, where p = (1, 1, 1) / 3 and the angle is
    sqrt(3) |dp| with |dp|^2 = du^2 + dv^2 + (du + dv)^2. In that metric the codes are a hexagonal lattice of
    edge sqrt(2) s, whose holes are sqrt(2 / 3) s deep: sqrt(2) s in all. The last term is float32.
    """
    _code_dtype(bits)
    step = 1.0 / ((1 << (bits - 1)) - 1)
    return math.degrees(math.sqrt(2.0) * step + 4e-7)


def _sign(value: NDArray[Any]) -> NDArray[Any]:
    """-1 or 1; 1 for both zeros."""
    if value.dtype.kind == "i":  # shifts are three times as fast
        return (value >> (8 * value.dtype.itemsize - 1)) | value.dtype.type(1)
    return np.where(value >= 0, value.dtype.type(1), value.dtype.type(-1))


def _unfold(u: NDArray[Any], v: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """From the square [-1, 1]^2 to the octahedron |x| + |y| + |z| = 1."""
    w = 1 - np.abs(u) - np.abs(v)
    below = w < 0
    return (
        np.where(below, (1 - np.abs(v)) * _sign(u), u),
        np.where(below, (1 - np.abs(u)) * _sign(v), v),
        w,
    )
