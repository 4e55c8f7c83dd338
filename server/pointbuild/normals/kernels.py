"""Compiled loops of normal estimation."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, nogil=True)
def fit_planes(xyz: NDArray[np.float64], neighbours: NDArray[np.int32], out: NDArray[np.float32]) -> None:
    """Find the normal of the plane through each sample's neighbours: the eigenvector of their smallest variance.

    Parameters
    ----------
    xyz : ndarray, (n, 3) float64
    neighbours : ndarray, (m, k) int32
        Indices into `xyz`.
    out : ndarray, (m, 3) float32
        Unit vectors of either sign; zero where the neighbours stand on a line or a point.
    """
    k = neighbours.shape[1]
    for i in range(len(neighbours)):
        o = neighbours[i, 0]
        sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
        for j in range(k):
            p = neighbours[i, j]
            x, y, z = xyz[p, 0] - xyz[o, 0], xyz[p, 1] - xyz[o, 1], xyz[p, 2] - xyz[o, 2]
            sx += x
            sy += y
            sz += z
            xx += x * x
            xy += x * y
            xz += x * z
            yy += y * y
            yz += y * z
            zz += z * z
        xx -= sx * sx / k
        xy -= sx * sy / k
        xz -= sx * sz / k
        yy -= sy * sy / k
        yz -= sy * sz / k
        zz -= sz * sz / k
        out[i, 0], out[i, 1], out[i, 2] = _smallest_eigenvector(xx, xy, xz, yy, yz, zz)


@numba.njit(cache=True, nogil=True)
def _smallest_eigenvector(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float]:
    """Of a symmetric positive matrix, in closed form (O. K. Smith, CACM 4(4), 1961); zeros if it is not unique."""
    scale = max(xx, yy, zz)
    if scale <= 0.0:
        return 0.0, 0.0, 0.0
    xx, xy, xz, yy, yz, zz = xx / scale, xy / scale, xz / scale, yy / scale, yz / scale, zz / scale
    mean = (xx + yy + zz) / 3.0
    off = xy * xy + xz * xz + yz * yz
    spread = math.sqrt(((xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2.0 * off) / 6.0)
    if spread <= 1e-12:
        return 0.0, 0.0, 0.0
    a, b, c = (xx - mean) / spread, (yy - mean) / spread, (zz - mean) / spread
    d, e, f = xy / spread, xz / spread, yz / spread
    half = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / 2.0
    angle = math.acos(min(1.0, max(-1.0, half))) / 3.0
    low = mean + 2.0 * spread * math.cos(angle + 2.0 * math.pi / 3.0)
    # Rows of the matrix minus its eigenvalue stand across the eigenvector: the longest of their cross products is it.
    a, b, c = xx - low, yy - low, zz - low
    px, py, pz = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    qx, qy, qz = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    rx, ry, rz = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    pp, qq, rr = px * px + py * py + pz * pz, qx * qx + qy * qy + qz * qz, rx * rx + ry * ry + rz * rz
    if qq >= pp and qq >= rr:
        px, py, pz, pp = qx, qy, qz, qq
    elif rr >= pp:
        px, py, pz, pp = rx, ry, rz, rr
    if pp <= 1e-13:
        return 0.0, 0.0, 0.0
    length = math.sqrt(pp)
    return px / length, py / length, pz / length


@numba.njit(cache=True, nogil=True)
def rate_edges(
    xyz: NDArray[np.float64],
    normals: NDArray[np.float32],
    neighbours: NDArray[np.int32],
    doubt: NDArray[np.uint16],
    flip: NDArray[np.bool_],
) -> None:
    """Say of every sample and neighbour whether their normals must differ in sign, and how doubtful that is.

    The sign is that of Koenig and Gumhold (VMV 2009): one normal mirrored in the plane half way agrees with the other,
    which also holds around sharp edges. Doubt grows where the mirrored normals are askew and where the way from one
    sample to the other leaves the tangent planes, as between two sheets of a thin wall.

    Parameters
    ----------
    xyz, normals : ndarray, (n, 3)
    neighbours : ndarray, (n, k) int32
    doubt : ndarray, (n, k) uint16
        Out: 0 (sure) to 65,535; 65,535 where a normal is zero.
    flip : ndarray, (n, k) bool
        Out.
    """
    for i in range(len(neighbours)):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for j in range(neighbours.shape[1]):
            p = neighbours[i, j]
            mx, my, mz = normals[p, 0], normals[p, 1], normals[p, 2]
            ex, ey, ez = xyz[p, 0] - xyz[i, 0], xyz[p, 1] - xyz[i, 1], xyz[p, 2] - xyz[i, 2]
            length = math.sqrt(ex * ex + ey * ey + ez * ez)
            if length > 0.0:
                ex, ey, ez = ex / length, ey / length, ez / length
            en, em = ex * nx + ey * ny + ez * nz, ex * mx + ey * my + ez * mz
            mirrored = nx * mx + ny * my + nz * mz - 2.0 * en * em
            doubtful = 1.0 - abs(mirrored) + 0.5 * (abs(en) + abs(em))
            bare = nx * nx + ny * ny + nz * nz < 0.5 or mx * mx + my * my + mz * mz < 0.5
            doubt[i, j] = 65535 if bare else int(min(1.0, doubtful / 2.0) * 65534.0)
            flip[i, j] = mirrored < 0.0


@numba.njit(cache=True, nogil=True)
def join(
    order: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    flip: NDArray[np.bool_],
    parent: NDArray[np.int32],
    odd: NDArray[np.bool_],
) -> None:
    """Grow a minimum spanning forest (Kruskal) whose trees carry signs along.

    Parameters
    ----------
    order : ndarray of int64
        Edges as indices into the flattened `neighbours`, the surest first.
    neighbours, flip : ndarray, (n, k)
        As of `rate_edges`.
    parent : ndarray, (n,) int32
        In: 0, 1, ...; out: a sample of the same tree, the same for all of them.
    odd : ndarray, (n,) bool
        In: False; out: the sample's sign differs from that sample's.
    """
    k = neighbours.shape[1]
    size = np.ones(len(parent), np.int32)
    for edge in order:
        a, b = int(edge // k), int(neighbours[edge // k, edge % k])
        root_a, odd_a = _find(parent, odd, a)
        root_b, odd_b = _find(parent, odd, b)
        if root_a == root_b:
            continue
        if size[root_a] < size[root_b]:
            root_a, root_b = root_b, root_a
        parent[root_b] = root_a
        odd[root_b] = odd_a ^ odd_b ^ flip[edge // k, edge % k]
        size[root_a] += size[root_b]
    for i in range(len(parent)):
        root, is_odd = _find(parent, odd, i)
        parent[i], odd[i] = root, is_odd


@numba.njit(cache=True, nogil=True)
def _find(parent: NDArray[np.int32], odd: NDArray[np.bool_], i: int) -> tuple[int, bool]:
    """Root of a sample and whether their signs differ; halves the path on the way."""
    is_odd = False
    while parent[i] != i:
        above = parent[i]
        if parent[above] != above:
            odd[i] ^= odd[above]
            parent[i] = parent[above]
        is_odd ^= odd[i]
        i = parent[i]
    return i, is_odd


@numba.njit(cache=True, nogil=True)
def vote(
    xyz: NDArray[np.float64],
    normals: NDArray[np.float32],
    guides: NDArray[np.float64],
    guide_normals: NDArray[np.float32],
    nearest: NDArray[np.int64],
    out: NDArray[np.float32],
) -> None:
    """How far each normal agrees with the oriented ones around it, -1 to 1.

    A guide counts by how near it is, fifteen times less when it is off the tangent plane, and by how parallel it is.

    Parameters
    ----------
    xyz, normals : ndarray, (n, 3)
    guides, guide_normals : ndarray, (m, 3)
        Samples whose normals have the right sign.
    nearest : ndarray, (n, k) int64
        Guides of each sample.
    out : ndarray, (n,) float32
    """
    for i in range(len(xyz)):
        total = weight = 0.0
        for j in range(nearest.shape[1]):
            g = nearest[i, j]
            ex, ey, ez = guides[g, 0] - xyz[i, 0], guides[g, 1] - xyz[i, 1], guides[g, 2] - xyz[i, 2]
            along = ex * normals[i, 0] + ey * normals[i, 1] + ez * normals[i, 2]
            dot = (
                normals[i, 0] * guide_normals[g, 0]
                + normals[i, 1] * guide_normals[g, 1]
                + normals[i, 2] * guide_normals[g, 2]
            )
            near = 1.0 / (ex * ex + ey * ey + ez * ez + 15.0 * along * along + 1e-300)
            total += near * dot * abs(dot)
            weight += near
        out[i] = total / weight
