"""Cells of the tree: the root box halved again and again at the midpoint of its longest side (LPC 5).

Children halve the box of their *parent*, not the box of their samples, so all cells of one depth have equal sides and
are split along the same axis. A cell is therefore a prefix of one bit string per sample, its *path*: bit d says
which half the sample is in at depth d. Paths come from 48-bit fixed point coordinates, so cells are half open and
nobody ever compares with a rounded midpoint.

A *window* is a run of path bits as one integer; look-up tables spread the coordinates' bits over it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit

from lpc.errors import BuildError

if TYPE_CHECKING:
    from numpy.typing import NDArray

BITS = 48
"""Of a fixed point coordinate, as many as a stored position may have: samples that share all are at one place."""

LARGEST, SMALLEST = 1e36, 1e-24
"""Longest side of a root box, model units."""

_CHUNK = 10  # bits of a look-up table


class Window(NamedTuple):
    """Path bits `start` to `start + bits - 1`; see `Cells.window`.

    The rest says how to make the number: OR over the rows of ``table[row, (fixed[axis[row]] >> shift[row]) & mask]``.
    """

    start: int
    bits: int
    axis: NDArray[np.int64]
    shift: NDArray[np.uint64]
    table: NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class Cells:
    """The root box and the order in which its axes are halved.

    Parameters
    ----------
    low, extent : ndarray, (3,) float64
        Corner and sides of the root box.
    axes, shifts : ndarray, (depths,) uint8
        For each depth the axis that is halved there, and which bit of its fixed point coordinate tells the half.
    """

    low: NDArray[np.float64]
    extent: NDArray[np.float64]
    axes: NDArray[np.uint8]
    shifts: NDArray[np.uint8]

    @classmethod
    def over(cls, low: NDArray[np.float64], high: NDArray[np.float64]) -> Cells:
        """Cells of the box from `low` to `high`.

        Raises
        ------
        BuildError
            If the box is larger or smaller than spheres of float32 can say.
        """
        with np.errstate(over="ignore"):
            extent = high - low
        longest = float(extent.max())
        if longest > LARGEST or 0 < longest < SMALLEST:
            raise BuildError(
                f"the samples spread over {longest:.3g}: a model spans {SMALLEST:g} to {LARGEST:g} units; "
                "remove outliers or choose another unit"
            )
        sides, used = extent.copy(), np.zeros(3, dtype=np.int64)
        axes: list[int] = []
        shifts: list[int] = []
        while True:
            sides[used == BITS] = 0.0
            axis = int(np.argmax(sides))
            if sides[axis] == 0.0:
                return cls(low, extent, np.array(axes, np.uint8), np.array(shifts, np.uint8))
            axes.append(axis)
            used[axis] += 1
            shifts.append(BITS - used[axis])
            sides[axis] /= 2.0

    @property
    def depths(self) -> int:
        """Length of a path: below it nothing tells samples apart."""
        return len(self.axes)

    def fixed(self, xyz: NDArray[np.float64]) -> NDArray[np.uint64]:
        """48-bit coordinates (n, 3) of positions (n, 3); what is on or beyond the box is in its last cell."""
        out = np.empty(xyz.shape, np.uint64)
        _fix_all(xyz, self.low, self.extent, out)
        return out

    def window(self, start: int, bits: int) -> Window:
        """Return the window of `bits` path bits (at most 63) from depth `start`; fewer where the path ends."""
        bits = max(min(bits, self.depths - start), 0)
        rows: list[tuple[int, int, NDArray[np.uint64]]] = []
        for axis in range(3):
            depths = start + np.flatnonzero(self.axes[start : start + bits] == axis)
            for begin in range(0, len(depths), _CHUNK):
                run = depths[begin : begin + _CHUNK]
                shift = int(self.shifts[run[-1]])
                spread = np.zeros(1 << _CHUNK, np.uint64)
                numbers = np.arange(1 << _CHUNK, dtype=np.uint64)
                for depth in run:
                    bit = (numbers >> np.uint64(self.shifts[depth] - shift)) & np.uint64(1)
                    spread |= bit << np.uint64(start + bits - 1 - depth)
                rows.append((axis, shift, spread))
        axis_of = np.array([row[0] for row in rows], np.int64)
        shift_of = np.array([row[1] for row in rows], np.uint64)
        table = np.array([row[2] for row in rows], np.uint64).reshape(-1, 1 << _CHUNK)
        return Window(start, bits, axis_of, shift_of, table)

    def keys(self, xyz: NDArray[np.float64], window: Window) -> NDArray[np.uint64]:
        """Window values of positions (n, 3)."""
        out = np.empty(len(xyz), np.uint64)
        _keys(xyz, self.low, self.extent, window.axis, window.shift, window.table, out)
        return out

    def descend(
        self, xyz: NDArray[np.float64], window: Window, entries: NDArray[np.int32], cell: NDArray[np.int32]
    ) -> None:
        """Move samples that stand at a table one table down: ``cell = entries[-cell - 1, key]`` where cell < 0."""
        _descend(xyz, self.low, self.extent, window.axis, window.shift, window.table, entries, cell)

    def count(
        self, xyz: NDArray[np.float64], window: Window, cell: NDArray[np.int32], counts: NDArray[np.integer]
    ) -> None:
        """Add the samples that stand at a table: ``counts[-cell - 1, key] += 1`` where cell < 0."""
        _count(xyz, self.low, self.extent, window.axis, window.shift, window.table, cell, counts)

    def faces(self, fixed: NDArray[np.uint64], depth: NDArray[np.integer]) -> NDArray[np.float64]:
        """Boxes (n, 6) of the cells at `depth` that hold samples `fixed`; infinite where nothing lies beyond a face."""
        box = np.empty((len(fixed), 6))
        for axis in range(3):
            taken = np.concatenate([[0], np.cumsum(self.axes == axis)])[depth]
            rest = np.uint64(BITS) - taken.astype(np.uint64)
            low = (fixed[:, axis] >> rest) << rest
            high = low + (np.uint64(1) << rest)
            scale = self.extent[axis] * 2.0**-BITS
            box[:, axis] = np.where(low == 0, -np.inf, self.low[axis] + low * scale)
            box[:, 3 + axis] = np.where(high >> np.uint64(BITS) > 0, np.inf, self.low[axis] + high * scale)
        return box


@njit(cache=True, nogil=True)
def _fix(value: float, low: float, extent: float) -> Any:
    # A quotient, not a product with 1 / extent: halves, quarters, ... of the extent must come out exact.
    if extent == 0.0:
        return np.uint64(0)
    return min(np.uint64(np.int64(max(value - low, 0.0) / extent * 281474976710656.0)), np.uint64(281474976710655))


@njit(cache=True, nogil=True)
def _fix_all(xyz: Any, low: Any, extent: Any, out: Any) -> None:
    for i in range(len(xyz)):
        for axis in range(3):
            out[i, axis] = _fix(xyz[i, axis], low[axis], extent[axis])


@njit(cache=True, nogil=True)
def _key(xyz: Any, i: int, low: Any, extent: Any, axis: Any, shift: Any, table: Any) -> Any:
    x = _fix(xyz[i, 0], low[0], extent[0])
    y = _fix(xyz[i, 1], low[1], extent[1])
    z = _fix(xyz[i, 2], low[2], extent[2])
    key = np.uint64(0)
    for row in range(len(axis)):
        value = x if axis[row] == 0 else (y if axis[row] == 1 else z)
        key |= table[row, (value >> shift[row]) & np.uint64(1023)]
    return key


@njit(cache=True, nogil=True)
def _keys(xyz: Any, low: Any, extent: Any, axis: Any, shift: Any, table: Any, out: Any) -> None:
    for i in range(len(xyz)):
        out[i] = _key(xyz, i, low, extent, axis, shift, table)


@njit(cache=True, nogil=True)
def _descend(xyz: Any, low: Any, extent: Any, axis: Any, shift: Any, table: Any, entries: Any, cell: Any) -> None:
    for i in range(len(xyz)):
        if cell[i] < 0:
            cell[i] = entries[-cell[i] - 1, _key(xyz, i, low, extent, axis, shift, table)]


@njit(cache=True, nogil=True)
def _count(xyz: Any, low: Any, extent: Any, axis: Any, shift: Any, table: Any, cell: Any, counts: Any) -> None:
    for i in range(len(xyz)):
        if cell[i] < 0:
            counts[-cell[i] - 1, _key(xyz, i, low, extent, axis, shift, table)] += 1
