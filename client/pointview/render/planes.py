"""Planes of samples that come without normals: a disc in the tangent plane is as wide as the surface, and no wider.

A disc that faces the eye stands out from a silhouette by its whole radius, and covers what lies beside a surface that
is seen from the side. Where a model has no normals, the plane of a sample is that through the samples around it in its
own cloud (Hoppe et al. 1992, section 3.2), found once, when the cloud is packed. Only the shape of the splat follows
it: its sign is unknown, so it lights nothing and hides nothing. Where the samples around make no plane, as in foliage,
there is none.

To be cheap beside the decoding of a cloud, the samples around are those of a block: of the three cells of a grid around
the sample along each axis, whole the middle one and of the outer ones the shares that put the block's middle at the
sample. Where a surface bends, the plane of a block beside the sample would lean. Sums over cells give the covariance of
each block. Samples in blocks of too few samples are looked at again with larger cells.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

FEWEST = 5
"""Samples of a block that make a plane; three always lie on one."""
FLAT = 0.6
"""Most deviation of a block's samples from their plane, over their lesser deviation along it. Where a surface bends
within a block a disc in a rough plane still covers less that it should not than one that faces the eye."""
CELL = 1.2
"""Side of a cell, spacings of the cloud's own samples."""
COARSER = 1.5
"""Side of the cells of the next grid over that of the last."""
GRIDS = 6
LARGEST_GRID = 64
"""Cells along an axis."""
MARGIN = 0.25
"""Of the box that holds all but a hundredth of the samples on each side: those beyond are strays, without plane."""


def planes(position: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Planes of the samples of one cloud.

    Parameters
    ----------
    position : (k, 3) uint16

    Returns
    -------
    (k,) uint16
        Normals of either sign in two octahedral bytes, the first in the low byte; 0: no plane.
    """
    codes = np.zeros(len(position), dtype=np.uint16)
    if len(position) < FEWEST:
        return codes
    low, extent = _box(position)
    # The cloud as the largest face of its box.
    area = max(extent[0] * extent[1], extent[1] * extent[2], extent[2] * extent[0])
    side = CELL * math.sqrt(area / len(position))
    pending = np.arange(len(position))
    for _ in range(GRIDS):
        side = max(side, max(extent) / LARGEST_GRID)
        shape = (int(extent[0] / side) + 2, int(extent[1] / side) + 2, int(extent[2] / side) + 2)  # of corners of cells
        tried = _fit(position, low, 1.0 / side, shape, pending, FEWEST, FLAT * FLAT, codes)
        pending = pending[~tried]
        if not len(pending):
            break
        side *= COARSER
    return codes


def _box(position: NDArray[np.uint16]) -> tuple[NDArray[np.float64], list[float]]:
    """Lowest corner and sides of a box that holds all samples, but for a few that are far off the others."""
    few = len(position) // 100
    ordered = np.partition(position, (0, few, -1 - few, -1), axis=0).astype(np.float64)
    inner = ordered[-1 - few] - ordered[few]
    low = np.maximum(ordered[0], ordered[few] - MARGIN * inner)
    high = np.minimum(ordered[-1], ordered[-1 - few] + MARGIN * inner)
    return low, (high - low + 1.0).tolist()


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _fit(
    position: NDArray[np.uint16],
    low: NDArray[np.float64],
    inverse: float,
    shape: tuple[int, int, int],
    pending: NDArray[np.int64],
    fewest: int,
    flat: float,
    codes: NDArray[np.uint16],
) -> NDArray[np.bool_]:  # pragma: no cover - compiled
    """Fit planes to the blocks of the pending samples; say which of these are done."""
    nx, ny, nz = shape
    slot = np.full(nx * ny * nz, -1, np.int32)
    sums = np.zeros((len(position), 10))
    filled = 0
    for i in range(len(position)):
        x, y, z = position[i, 0] - low[0], position[i, 1] - low[1], position[i, 2] - low[2]
        a, b, c = math.floor(x * inverse), math.floor(y * inverse), math.floor(z * inverse)
        if a < 0 or a >= nx or b < 0 or b >= ny or c < 0 or c >= nz:
            continue
        at = (a * ny + b) * nz + c
        if slot[at] < 0:
            slot[at] = filled
            filled += 1
        row = sums[slot[at]]
        row[0] += 1.0
        row[1] += x
        row[2] += y
        row[3] += z
        row[4] += x * x
        row[5] += x * y
        row[6] += x * z
        row[7] += y * y
        row[8] += y * z
        row[9] += z * z
    total, weight = np.empty(10), np.empty((3, 3))
    done = np.ones(len(pending), np.bool_)
    for p in range(len(pending)):
        i = pending[p]
        x, y, z = (
            (position[i, 0] - low[0]) * inverse,
            (position[i, 1] - low[1]) * inverse,
            (position[i, 2] - low[2]) * inverse,
        )
        a, b, c = math.floor(x), math.floor(y), math.floor(z)
        if a < 0 or a >= nx or b < 0 or b >= ny or c < 0 or c >= nz:
            continue
        weight[0, 0], weight[0, 1], weight[0, 2] = 1.0 - (x - a), 1.0, x - a
        weight[1, 0], weight[1, 1], weight[1, 2] = 1.0 - (y - b), 1.0, y - b
        weight[2, 0], weight[2, 1], weight[2, 2] = 1.0 - (z - c), 1.0, z - c
        total[:] = 0.0
        for u in range(max(a - 1, 0), min(a + 2, nx)):
            for v in range(max(b - 1, 0), min(b + 2, ny)):
                part = weight[0, u - a + 1] * weight[1, v - b + 1]
                for w in range(max(c - 1, 0), min(c + 2, nz)):
                    cell = slot[(u * ny + v) * nz + w]
                    if cell >= 0:
                        share = part * weight[2, w - c + 1]
                        for k in range(10):
                            total[k] += share * sums[cell, k]
        if total[0] >= fewest:
            codes[i] = _code(total, flat)
        else:
            done[p] = False
    return done


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _code(sums: NDArray[np.float64], flat: float) -> int:  # pragma: no cover - compiled
    """Octahedral code of the plane through samples, of which the moments are given; 0 where they make none."""
    count = sums[0]
    mx, my, mz = sums[1] / count, sums[2] / count, sums[3] / count
    xx, xy, xz = sums[4] - sums[1] * mx, sums[5] - sums[1] * my, sums[6] - sums[1] * mz
    yy, yz, zz = sums[7] - sums[2] * my, sums[8] - sums[2] * mz, sums[9] - sums[3] * mz
    scale = max(xx, yy, zz)
    if scale <= 0.0:
        return 0
    xx, xy, xz, yy, yz, zz = xx / scale, xy / scale, xz / scale, yy / scale, yz / scale, zz / scale
    # Eigenvalues in closed form (O. K. Smith, CACM 4(4), 1961).
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if spread <= 1e-9:
        return 0
    product = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = math.acos(min(1.0, max(-1.0, product / (2.0 * spread**3)))) / 3.0
    least = mean + 2.0 * spread * math.cos(angle + 2.0 * math.pi / 3.0)
    middle = mean + 2.0 * spread * math.cos(angle - 2.0 * math.pi / 3.0)
    if least > flat * middle:
        return 0
    # Rows of the matrix minus its least eigenvalue stand across the eigenvector: the longest of their products is it.
    a, b, c = xx - least, yy - least, zz - least
    px, py, pz = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    qx, qy, qz = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    rx, ry, rz = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    pp, qq, rr = px * px + py * py + pz * pz, qx * qx + qy * qy + qz * qz, rx * rx + ry * ry + rz * rz
    if qq >= pp and qq >= rr:
        px, py, pz, pp = qx, qy, qz, qq
    elif rr >= pp:
        px, py, pz, pp = rx, ry, rz, rr
    if pp <= 1e-12:
        return 0  # along a line
    size = 1.0 / (abs(px) + abs(py) + abs(pz))
    u, v = px * size, py * size
    if pz < 0.0:
        u, v = (1.0 - abs(v)) * (1.0 if u >= 0.0 else -1.0), (1.0 - abs(u)) * (1.0 if v >= 0.0 else -1.0)
    code = int(u * 127.0 + 127.5) | (int(v * 127.0 + 127.5) << 8)
    return code if code != 0 else 254 << 8
