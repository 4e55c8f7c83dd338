"""How much surface each cell holds: the density of the scan, measured where it is.

The spacing of a region is sqrt(pi / 8) times the median distance to the eighth neighbour: a disc of that radius holds
eight samples of area r^2 each. (The mean distance to the *nearest* neighbour is about half of it.) Regions are cells
of at most 2 M samples. What a region holds does not depend on buckets or thresholds, so neither does the result.

Two kinds of regions have no area to speak of. Along a straight line the eight neighbours lie on both sides, so the
spacing is a quarter of the distance. A model of fewer than `FEWEST` samples has the smallest distance of any two: half
of it, the position error, then keeps them apart.

Lattice points that several samples share count once when distances are measured, and the surface is that of the points:
where samples are denser than the lattice, it is what a reader can see of them.

Surface adds up: an inner cell has the area of its halves. A cell of few samples takes the density of its sibling.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .cells import Cells

NEIGHBOURS = 8
BESIDE = 32
"""In the order of paths on either side: where neighbours are looked for first."""
FEWEST = 32
"""Samples of a region that is measured by its neighbours."""
STRAIGHT = 0.25
"""Of the spacing along a line: samples further from it make a surface."""
CLOSEST = 2.0**-40
"""Of the extent: closer samples of a small model do not count as two."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Probing:
    """How areas are measured; a function of the input's size and M only.

    Parameters
    ----------
    region : int
        Samples that a region has at most.
    queries : int
        Samples per region whose neighbours are looked for, at a cost of about 1 ns each for every sample.
    """

    region: int
    queries: int

    @classmethod
    def of(cls, samples: int, cloud_size: int) -> Probing:
        """Probe small models more densely: they have few regions."""
        return cls(region=max(2 * cloud_size, 256), queries=min(max(2**24 // samples, 16), 256))


@dataclass(frozen=True, slots=True)
class Areas:
    """Cells of a bucket in preorder, down to the regions.

    Parameters
    ----------
    low, high : ndarray, (n,) int64
        Samples of the cell, a range in the order of paths.
    area : ndarray, (n,) float64
        Nan for a lone cell with too few samples.
    region : ndarray, (n,) bool
    spacing : ndarray, (n,) float64
        Of measured regions; nan elsewhere.
    """

    low: NDArray[np.int64]
    high: NDArray[np.int64]
    area: NDArray[np.float64]
    region: NDArray[np.bool_]
    spacing: NDArray[np.float64]

    def of(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.float64]:
        """Area of cells given by their ranges: those of nodes, which may be smaller than a region."""
        out = np.empty(len(low))
        _look_up(self.low, self.high, self.area, self.region, low, high, out)
        return out


def measure(
    cells: Cells,
    probing: Probing,
    fixed: NDArray[np.uint64],
    xyz: NDArray[np.float64],
    priority: NDArray[np.uint64],
    depth: int,
) -> Areas:
    """Areas of all cells of a bucket.

    Parameters
    ----------
    cells, probing
    fixed : ndarray, (n, 3) uint64
        Coordinates in the order of paths.
    xyz : ndarray, (n, 3) float64
        The same samples; areas are in their unit, squared.
    priority : ndarray, (n,) uint64
        The smallest of a region make the queries.
    depth : int
        Of the bucket's cell.
    """
    most = 2 * len(fixed) * (cells.depths + 1 - depth) // (probing.region + 1) + 2
    table = np.empty((4, most), np.int64)
    count = _divide(cells.axes, cells.shifts, fixed, depth, probing.region, table)
    low, high, level, parent = table[:, :count].copy()
    # A region has no child: in preorder a child follows its parent at once.
    region = np.append(parent[1:] != np.arange(count - 1), True)
    spacing = np.full(count, np.nan)
    measured = np.flatnonzero(region & ((high - low >= FEWEST) | (level == 0)))
    faces = cells.faces(fixed[low[measured]], level[measured])
    pile = high[measured] - low[measured] > probing.region
    for cell, box in zip(measured[pile].tolist(), faces[pile], strict=True):
        here = slice(low[cell], high[cell])
        first = here.start + np.argsort(priority[here])[: probing.region]
        spacing[cell] = pile_spacing(xyz[first], priority[first], box, probing, here.stop - here.start)
    measured, faces = measured[~pile], faces[~pile]
    _probe(xyz, priority, low[measured], high[measured], faces, probing.queries, measured, spacing)
    area = spacing**2 * (high - low)
    _add_up(low, high, parent, region, area)
    return Areas(low, high, area, region, spacing)


def pile_spacing(
    xyz: NDArray[np.float64],
    priority: NDArray[np.uint64],
    face: NDArray[np.float64],
    probing: Probing,
    samples: int,
) -> float:
    """Spacing of `samples` that no path tells apart, from a region's number of them in the order of their priorities.

    Most piles are at one place exactly, but where an outlier has made the root large they may be a whole surface.
    """
    spacing = np.empty(1)
    low, high = np.zeros(1, np.int64), np.array([len(xyz)])
    _probe(xyz, priority, low, high, face[None], probing.queries, low, spacing)
    return float(spacing[0]) * math.sqrt(len(xyz) / samples)


def probe(
    xyz: NDArray[np.float64],
    priority: NDArray[np.uint64],
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    faces: NDArray[np.float64],
    probing: Probing,
) -> NDArray[np.float64]:
    """Spacing of cells given by their ranges and faces; see `measure`."""
    spacing = np.empty(len(low))
    _probe(xyz, priority, low, high, faces, probing.queries, np.arange(len(low)), spacing)
    return spacing


@njit(cache=True, nogil=True)
def _divide(axes: Any, shifts: Any, fixed: Any, depth0: int, region: int, table: Any) -> int:
    """Cells in preorder until a cell is a region."""
    waiting = np.empty((2 * 256 + 2, 4), np.int64)
    waiting[0] = (0, len(fixed), depth0, -1)
    stacked, count = 1, 0
    while stacked:
        stacked -= 1
        low, high, depth, parent = waiting[stacked]
        cell = count
        count += 1
        table[0, cell], table[1, cell], table[2, cell], table[3, cell] = low, high, depth, parent
        coincide = True
        for axis in range(3):
            coincide = coincide and fixed[low, axis] == fixed[high - 1, axis]
        if high - low <= region or coincide:
            continue
        axis, shift = axes[depth], np.uint64(shifts[depth])
        first, last = low, high
        while first < last:
            middle = (first + last) // 2
            if (fixed[middle, axis] >> shift) & np.uint64(1):
                last = middle
            else:
                first = middle + 1
        if first < high:
            waiting[stacked] = (first, high, depth + 1, cell)
            stacked += 1
        if low < first:
            waiting[stacked] = (low, first, depth + 1, cell)
            stacked += 1
    return count


@njit(cache=True, nogil=True)
def _probe(xyz: Any, priority: Any, lows: Any, highs: Any, faces: Any, queries: int, cell: Any, spacing: Any) -> None:
    """Spacing of regions."""
    chosen = np.empty(queries, np.int64)
    best = np.empty(queries, np.uint64)
    nearest = np.empty(8)
    distance = np.empty(queries)
    inside = np.empty(queries, np.bool_)
    for r in range(len(lows)):
        low, high = lows[r], highs[r]
        point, x, y, z = _points(xyz, low, high)
        if high - low < FEWEST:
            spacing[cell[r]] = _smallest_distance(x, y, z)
            continue
        squared = np.empty(len(x))
        count = 0
        for i in range(low, high):  # the samples of smallest priority
            if count < queries or priority[i] < best[count - 1]:
                at = min(count, queries - 1)
                while at > 0 and best[at - 1] > priority[i]:
                    best[at], chosen[at] = best[at - 1], chosen[at - 1]
                    at -= 1
                best[at], chosen[at] = priority[i], point[i - low]
                count = min(count + 1, queries)
        within = 0
        for q in range(count):
            px, py, pz = x[chosen[q]], y[chosen[q]], z[chosen[q]]
            for i in range(len(squared)):
                dx, dy, dz = x[i] - px, y[i] - py, z[i] - pz
                squared[i] = dx * dx + dy * dy + dz * dz
            found, limit = 0, np.inf
            # Neighbours in the order of paths come first: they are near, and after them hardly any other is nearer.
            begin, end = max(chosen[q] - BESIDE, 0), min(chosen[q] + BESIDE, len(squared))
            for first, last in ((begin, end), (0, begin), (end, len(squared))):
                for i in range(first, last):
                    value = squared[i]
                    if value < limit and value > 0.0:
                        at = min(found, 7)
                        while at > 0 and nearest[at - 1] > value:
                            nearest[at] = nearest[at - 1]
                            at -= 1
                        nearest[at] = value
                        found = min(found + 1, 8)
                        limit = nearest[7] if found == 8 else np.inf
            radius = np.sqrt(nearest[found - 1]) if found else 0.0
            distance[q] = radius * np.sqrt(np.pi / max(found, 1))
            inside[q] = (
                px - radius > faces[r, 0] and py - radius > faces[r, 1] and pz - radius > faces[r, 2]
                and px + radius < faces[r, 3] and py + radius < faces[r, 4] and pz + radius < faces[r, 5]
            )  # fmt: skip
            within += inside[q]
        if 2 * within >= count:  # a disc that leaves the cell may miss neighbours beyond the face
            kept = 0
            for q in range(count):
                if inside[q]:
                    distance[kept] = distance[q]
                    kept += 1
            count = kept
        ordered = np.sort(distance[:count])
        across = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2.0
        along = across * 2.0 / np.sqrt(np.pi * 8)
        apart = along if _width(x, y, z) < STRAIGHT * along else across
        spacing[cell[r]] = apart * np.sqrt(len(x) / (high - low))


@njit(cache=True, nogil=True)
def _points(xyz: Any, low: int, high: int) -> Any:
    """Different places among the samples of a range, and which of them each sample is at."""
    point = np.empty(high - low, np.int64)
    x, y, z = np.empty(high - low), np.empty(high - low), np.empty(high - low)
    count = 0
    for i in range(low, high):  # equal paths are neighbours
        if i == low or xyz[i, 0] != x[count - 1] or xyz[i, 1] != y[count - 1] or xyz[i, 2] != z[count - 1]:
            x[count], y[count], z[count] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            count += 1
        point[i - low] = count - 1
    return point, x[:count], y[:count], z[:count]


@njit(cache=True, nogil=True)
def _smallest_distance(x: Any, y: Any, z: Any) -> float:
    """Distance of the two closest samples that do not coincide; 0 if all do."""
    smallest, largest = np.inf, 0.0
    for i in range(len(x)):
        for j in range(i):
            value = np.sqrt((x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2 + (z[i] - z[j]) ** 2)
            largest = max(largest, value)
    for i in range(len(x)):
        for j in range(i):
            value = np.sqrt((x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2 + (z[i] - z[j]) ** 2)
            if value > CLOSEST * largest:
                smallest = min(smallest, value)
    return smallest if largest > 0.0 else 0.0


@njit(cache=True, nogil=True)
def _width(x: Any, y: Any, z: Any) -> float:
    """Largest distance from the line through two samples that are far apart."""
    a = _farthest(x, y, z, 0)
    b = _farthest(x, y, z, a)
    ux, uy, uz = x[b] - x[a], y[b] - y[a], z[b] - z[a]
    length = np.sqrt(ux * ux + uy * uy + uz * uz)
    if length == 0.0:
        return 0.0
    ux, uy, uz = ux / length, uy / length, uz / length
    widest = 0.0
    for i in range(len(x)):
        dx, dy, dz = x[i] - x[a], y[i] - y[a], z[i] - z[a]
        cx, cy, cz = dy * uz - dz * uy, dz * ux - dx * uz, dx * uy - dy * ux
        widest = max(widest, cx * cx + cy * cy + cz * cz)
    return np.sqrt(widest)


@njit(cache=True, nogil=True)
def _farthest(x: Any, y: Any, z: Any, start: int) -> int:
    best, farthest = start, 0.0
    for i in range(len(x)):
        value = (x[i] - x[start]) ** 2 + (y[i] - y[start]) ** 2 + (z[i] - z[start]) ** 2
        if value > farthest:
            best, farthest = i, value
    return best


@njit(cache=True, nogil=True)
def _add_up(low: Any, high: Any, parent: Any, region: Any, area: Any) -> None:
    """Areas of inner cells from their halves, then of unmeasured halves from their sibling."""
    count = len(low)
    known = np.zeros(count, np.int64)  # samples of the halves that were measured
    for cell in range(count):
        if not region[cell]:
            area[cell] = 0.0
    for cell in range(count - 1, -1, -1):
        if not region[cell]:
            area[cell] *= (high[cell] - low[cell]) / known[cell] if known[cell] else np.nan
        above = parent[cell]
        if above >= 0 and not np.isnan(area[cell]):
            known[above] += high[cell] - low[cell]
            area[above] += area[cell]
    for cell in range(1, count):
        if np.isnan(area[cell]):
            above = parent[cell]
            area[cell] = area[above] * (high[cell] - low[cell]) / (high[above] - low[above])


@njit(cache=True, nogil=True)
def _look_up(lows: Any, highs: Any, area: Any, region: Any, low: Any, high: Any, out: Any) -> None:
    """Areas of ranges: descend the preorder to the smallest cell that holds the range."""
    for i in range(len(low)):
        cell = 0
        while not region[cell] and (lows[cell] != low[i] or highs[cell] != high[i]):
            cell += 1
            while highs[cell] <= low[i]:  # not in the lower half: on to the upper one
                cell += 1
        out[i] = area[cell] * (high[i] - low[i]) / (highs[cell] - lows[cell])
