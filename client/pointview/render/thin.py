"""Thin parts of a cloud: how far apart samples are where a scan is much less dense than around it.

A node's spacing is an average over its cell, and what the index knows ends with the cells (`uneven`). Where density
falls inside a cell, as at the edge of a closer scan, few of its samples lie in the thin part, and splats of the average
spacing leave it full of holes. A cloud is a random part of its cell's samples, so it tells how dense they are anywhere,
when it is packed: most of its samples have company in the cells of a grid around them and follow their place; of the
others the nearest neighbour in each quarter of their plane is looked for, in wider and wider grids.

In samples without order the square of such a distance is 4/pi r^2 on average.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numba
import numpy as np

from .rules import direction
from .tables import STEPS

if TYPE_CHECKING:
    from numpy.typing import NDArray

FEWEST = 24
"""Samples of a cloud that say anything about density."""
CELL = 1.6
"""Side of a cell, spacings of the cloud's own samples."""
COMPANY = 9
"""Samples in the 27 cells around a sample, itself among them, from which it is not alone."""
USUAL = 23
"""Median of that which cells are made for: as the largest face of the cloud's box has it, if the surface is even and
does not fold. Else cells are tried again."""
TRIES = 4
WIDER = 2.0
"""Side of the cells of the next grid over that of the last."""
GRIDS = 6
LARGEST_GRID = 64
"""Cells along an axis."""
EDGE = 2.0
"""No quarter counts with more than this times the second nearest: it may face a rim of the surface."""
THIN = 1.3
"""Spacing over the usual one of the cloud from which a sample is in a thin part."""
BENT = 0.5
"""Sine of the angle between a sample's plane and the way to a neighbour, and LIKE the cosine of that between their
planes, up to which they are on one surface. Leaves and strays are not, and being alone they are no larger."""
LIKE = 0.5
AGREED = 2.0
"""Most spacing of a sample over the second largest of those of its four neighbours, which is to be a thin one too."""
TINY = 1e-9
"""Spacing of a sample of no surface."""


def thin(position: NDArray[np.uint16], normal: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Spacing of the cloud's samples around each of them, where it is thin.

    Parameters
    ----------
    position : (k, 3) uint16
    normal : (k,) uint16
        Normals of either sign in two octahedral bytes; 0: none.

    Returns
    -------
    (k,) uint8
        `2 ** (code / STEPS)` units of `position`; 0: as usual in the cloud.
    """
    codes = np.zeros(len(position), dtype=np.uint8)
    if len(position) < FEWEST:
        return codes
    low = position.min(axis=0).astype(np.float64)
    extent = (position.max(axis=0) - low + 1.0).tolist()
    area = max(extent[0] * extent[1], extent[1] * extent[2], extent[2] * extent[0])
    least = max(extent) / LARGEST_GRID
    better = max(CELL * math.sqrt(area / len(position)), least)
    for _ in range(TRIES):
        side = better
        company = _company(position, low, 1.0 / side, _shape(extent, side))
        median = float(np.median(company))
        better = max(side * math.sqrt(USUAL / median), least)
        if USUAL / 1.5 <= median <= USUAL * 1.5 or better == side:
            break
    usual = 3.0 * side / math.sqrt(median)
    pending = np.flatnonzero((company < COMPANY) & (normal != 0))
    if not len(pending):
        return codes
    apart, around = np.zeros(len(pending)), np.full((len(pending), 4), -1)
    for grid in range(GRIDS):
        todo = np.flatnonzero(apart == 0.0)
        if not len(todo):
            break
        last = grid == GRIDS - 1 or side > max(extent)
        apart[todo], around[todo] = _apart(
            position, normal, low, 1.0 / side, _shape(extent, side), pending[todo], EDGE, BENT, LIKE, last
        )
        if last:
            break
        side *= WIDER
    # What is thin is so around its neighbours too, or it is a stray.
    spacing = np.full(len(position) + 1, usual)
    spacing[pending], spacing[-1] = apart, 0.0
    agreed = np.partition(spacing[around], 2, axis=1)[:, 2]
    apart = np.minimum(apart, AGREED * agreed)
    found = (apart > THIN * usual) & (agreed > THIN * usual)
    codes[pending[found]] = np.clip(np.rint(STEPS * np.log2(apart[found])), 1, 255)
    return codes


def _shape(extent: list[float], side: float) -> tuple[int, int, int]:
    """Cells of a grid along each axis, with one more on each side."""
    return int(extent[0] / side) + 3, int(extent[1] / side) + 3, int(extent[2] / side) + 3


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _company(
    position: NDArray[np.uint16], low: NDArray[np.float64], inverse: float, shape: tuple[int, int, int]
) -> NDArray[np.int32]:  # pragma: no cover - compiled
    """Count the samples in the 27 cells around each sample."""
    nx, ny, nz = shape
    count = np.zeros(nx * ny * nz, np.int32)
    cell = np.empty(len(position), np.int32)
    for i in range(len(position)):
        cell[i] = _cell(position[i], low, inverse, shape)
        count[cell[i]] += 1
    around = np.full(len(count), -1, np.int32)
    company = np.zeros(len(position), np.int32)
    for i in range(len(position)):
        at = cell[i]
        if around[at] < 0:
            total = np.int32(0)
            for u in range(-1, 2):
                for v in range(-1, 2):
                    row = at + (u * ny + v) * nz
                    total += count[row - 1] + count[row] + count[row + 1]
            around[at] = total
        company[i] = around[at]
    return company


@numba.njit(nogil=True, cache=True, inline="always")
def _cell(
    place: NDArray[np.uint16], low: NDArray[np.float64], inverse: float, shape: tuple[int, int, int]
) -> int:  # pragma: no cover - compiled
    """Cell of a sample, never an outermost one."""
    a = math.floor((place[0] - low[0]) * inverse) + 1
    b = math.floor((place[1] - low[1]) * inverse) + 1
    c = math.floor((place[2] - low[2]) * inverse) + 1
    return (a * shape[1] + b) * shape[2] + c


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _apart(
    position: NDArray[np.uint16],
    normal: NDArray[np.uint16],
    low: NDArray[np.float64],
    inverse: float,
    shape: tuple[int, int, int],
    pending: NDArray[np.int64],
    edge: float,
    bent: float,
    like: float,
    last: bool,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:  # pragma: no cover - compiled
    """Spacing around the pending samples, and their neighbours, -1 for none.

    The spacing is 0 where a quarter of their plane holds no sample within a cell's side, and tiny where the nearest
    samples make no surface. Quarters that leave the box do not count: what is there is in other clouds. With `last`, no
    empty ones do.
    """
    _, ny, nz = shape
    start = np.zeros(shape[0] * ny * nz + 1, np.int32)
    cell = np.empty(len(position), np.int32)
    for i in range(len(position)):
        cell[i] = _cell(position[i], low, inverse, shape)
        start[cell[i] + 1] += 1
    for at in range(1, len(start)):
        start[at] += start[at - 1]
    order, filled = np.empty(len(position), np.int32), start[:-1].copy()
    highest = np.zeros(3)
    lowest = np.full(3, 65536.0)
    for i in range(len(position)):
        order[filled[cell[i]]] = i
        filled[cell[i]] += 1
        for axis in range(3):
            highest[axis] = max(highest[axis], position[i, axis])
            lowest[axis] = min(lowest[axis], position[i, axis])
    side = 1.0 / inverse
    apart = np.zeros(len(pending))
    nearest, around = np.empty(4), np.full((len(pending), 4), -1, np.int64)
    for p in range(len(pending)):
        i = pending[p]
        nx, ny_, nz_ = _unit(normal[i])
        # Two directions in the plane.
        if abs(nx) < 0.6:
            ux, uy, uz = 0.0, nz_, -ny_
        else:
            ux, uy, uz = -nz_, 0.0, nx
        size = 1.0 / math.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux * size, uy * size, uz * size
        vx, vy, vz = ny_ * uz - nz_ * uy, nz_ * ux - nx * uz, nx * uy - ny_ * ux
        nearest[:] = np.inf
        x, y, z = float(position[i, 0]), float(position[i, 1]), float(position[i, 2])
        for a in range(-1, 2):
            for b in range(-1, 2):
                row = cell[i] + (a * ny + b) * nz
                for k in range(start[row - 1], start[row + 2]):
                    j = order[k]
                    dx, dy, dz = position[j, 0] - x, position[j, 1] - y, position[j, 2] - z
                    away = dx * dx + dy * dy + dz * dz
                    if away == 0.0:
                        continue
                    along, across = dx * ux + dy * uy + dz * uz, dx * vx + dy * vy + dz * vz
                    quarter = (1 if along > 0.0 else 0) + (2 if across > 0.0 else 0)
                    if away < nearest[quarter]:
                        nearest[quarter], around[p, quarter] = away, j
        whole = True
        for quarter in range(4):
            if nearest[quarter] > side * side:
                step_u = side * 0.5 * (1.0 if quarter & 1 else -1.0)
                step_v = side * 0.5 * (1.0 if quarter & 2 else -1.0)
                inside = True
                for axis in range(3):
                    to = position[i, axis] + step_u * (ux, uy, uz)[axis] + step_v * (vx, vy, vz)[axis]
                    inside = inside and lowest[axis] <= to <= highest[axis]
                if inside and not last:
                    whole = False
                    break
                if not inside:
                    nearest[quarter], around[p, quarter] = np.inf, -1
        if not whole:
            continue
        for quarter in range(4):
            if nearest[quarter] < np.inf:
                j = around[p, quarter]
                rise = nx * (position[j, 0] - x) + ny_ * (position[j, 1] - y) + nz_ * (position[j, 2] - z)
                ax, ay, az = _unit(normal[j])
                alike = abs(nx * ax + ny_ * ay + nz_ * az) >= like and normal[j] != 0
                whole = whole and alike and rise * rise <= bent * bent * nearest[quarter]
        if not whole:
            apart[p] = TINY
            continue
        nearest.sort()
        total, count = 0.0, 0
        for quarter in range(4):
            if nearest[quarter] < np.inf:
                total += min(nearest[quarter], edge * edge * nearest[min(1, quarter)])
                count += 1
        if count > 2:
            apart[p] = math.sqrt(math.pi / 4.0 * total / count)
        elif count > 0:  # at a corner of the box one distance says little: the lesser
            apart[p] = math.sqrt(math.pi / 4.0 * nearest[0])
        elif last:
            apart[p] = TINY
    return apart, around


@numba.njit(nogil=True, cache=True, inline="always")
def _unit(code: int) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """Return the normal of a code."""
    a, b, c = direction(np.int32(code))
    size = 1.0 / math.sqrt(a * a + b * b + c * c)
    return float(a * size), float(b * size), float(c * size)
