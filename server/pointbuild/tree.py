"""The tree of one bucket: nodes, and which node each sample belongs to (LPC 3 and 5).

Samples are in the order of their paths, so a cell is a range of them. A node takes the M smallest priorities among
the samples of its cell that are left; with M or fewer left it is a leaf and takes all. Samples that all stand at one
place never separate: a node of such a cell takes up to 65,535, and a chain of nodes takes more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from lpc.errors import BuildError
from lpc.header_checks import MAX_LEVELS
from lpc.page import COINCIDENT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .cells import Cells

TOO_MANY = (
    f"too many samples stand at one place for a tree of {MAX_LEVELS} levels of at most {COINCIDENT:,}: "
    "remove the duplicates"
)


@dataclass(frozen=True, slots=True)
class Tree:
    """Nodes of a bucket in preorder.

    Parameters
    ----------
    parent : ndarray, (n,) int64
        Among these nodes; -1 for the first.
    half : ndarray, (n,) int64
        Which half of the parent's cell.
    depth : ndarray, (n,) int64
    low, high : ndarray, (n,) int64
        Range of the samples in the node's cell, those that ancestors took included.
    subtree, samples : ndarray, (n,) int64
        Samples of the node with its descendants, and its own.
    """

    parent: NDArray[np.int64]
    half: NDArray[np.int64]
    depth: NDArray[np.int64]
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    subtree: NDArray[np.int64]
    samples: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.parent)

    def table(self) -> NDArray[np.int64]:
        """(7, n): what `Tree` is called with."""
        return np.stack([self.parent, self.half, self.depth, self.low, self.high, self.subtree, self.samples])


def grow(
    cells: Cells,
    fixed: NDArray[np.uint64],
    priority: NDArray[np.uint64],
    scratch: NDArray[np.uint64],
    depth: int,
    taken: NDArray[np.int64],
    floor: np.uint64,
    cloud_size: int,
) -> tuple[Tree, NDArray[np.int32]]:
    """Build the tree of a bucket.

    Parameters
    ----------
    cells : Cells
    fixed : ndarray, (n, 3) uint64
        Coordinates in the order of paths.
    priority : ndarray, (n,) uint64
    scratch : ndarray, (n,) uint64
        Overwritten.
    depth : int
        Of the bucket's cell.
    taken : ndarray, (t,) int64
        Samples that the upper tree takes.
    floor : int
        No other sample has a smaller priority.
    cloud_size : int
        M.

    Returns
    -------
    tree : Tree
    owner : ndarray, (n,) int32
        Node of each sample; -1 for those that the upper tree takes.

    Raises
    ------
    BuildError
        If more samples coincide than a chain of nodes can hold.
    """
    owner = np.full(len(fixed), -1, np.int32)
    free = np.ones(len(fixed), np.bool_)
    free[taken] = False
    left = np.flatnonzero(free)
    nodes = np.empty((7, 2 * (len(left) // cloud_size) + 3), np.int64)
    count = _grow(
        cells.axes, cells.shifts, fixed, left.astype(np.int32), priority[left], scratch,
        depth, floor, cloud_size, nodes, owner,
    )  # fmt: skip
    if count < 0:
        raise BuildError(TOO_MANY)
    return Tree(*nodes[:, :count].copy()), owner


@njit(cache=True, nogil=True)
def _grow(
    axes: Any, shifts: Any, fixed: Any, left: Any, priority: Any, scratch: Any,
    depth0: int, floor0: Any, cloud_size: int, nodes: Any, owner: Any,
) -> int:  # fmt: skip
    """Fill `nodes` and `owner`; the number of nodes, or -1 if a chain grows too deep.

    `left` and `priority` are the samples that are not taken yet; each cell keeps its own at the front of its part.
    """
    # A node that waits: range of samples, range in `left`, depth, threshold, parent, half. Depth bounds the number.
    waiting = np.empty((2 * 256 + 2, 7), np.int64)
    floors = np.empty(2 * 256 + 2, np.uint64)
    waiting[0] = (0, len(fixed), 0, len(left), depth0, -1, 0)
    floors[0] = floor0
    stacked, count = min(len(left), 1), 0
    while stacked:
        stacked -= 1
        low, high, begin, end, depth, parent, half = waiting[stacked]
        if depth > 255:
            return -1
        node = count
        count += 1
        coincide = True
        for axis in range(3):
            coincide = coincide and fixed[low, axis] == fixed[high - 1, axis]
        remain = end - begin
        take = min(remain, max(cloud_size, COINCIDENT) if coincide else cloud_size)
        nodes[0, node], nodes[1, node], nodes[2, node] = parent, half, depth
        nodes[3, node], nodes[4, node], nodes[5, node], nodes[6, node] = low, high, remain, take
        if take == remain:
            for i in range(begin, end):
                owner[left[i]] = node
            continue
        threshold, spare = _select(priority[begin:end], take, floors[stacked], scratch)
        kept = begin
        for i in range(begin, end):
            index, value = left[i], priority[i]
            if value < threshold or (value == threshold and spare > 0):
                owner[index] = node
                spare -= value == threshold
            else:
                left[kept] = index
                priority[kept] = value
                kept += 1
        split, part = high, kept
        if depth < len(axes):
            axis, shift = axes[depth], np.uint64(shifts[depth])
            split = _first_upper(fixed, axis, shift, low, high)
            part = begin + np.searchsorted(left[begin:kept], split)
        if part < kept:
            waiting[stacked] = (split, high, part, kept, depth + 1, node, 1)
            floors[stacked] = threshold
            stacked += 1
        if begin < part:
            waiting[stacked] = (low, split, begin, part, depth + 1, node, 0)
            floors[stacked] = threshold
            stacked += 1
    return count


@njit(cache=True, nogil=True)
def _first_upper(fixed: Any, axis: Any, shift: Any, low: Any, high: Any) -> Any:
    """First sample of a cell's range that is in the upper half."""
    while low < high:
        middle = (low + high) // 2
        if (fixed[middle, axis] >> shift) & np.uint64(1):
            high = middle
        else:
            low = middle + 1
    return low


@njit(cache=True, nogil=True)
def _select(priority: Any, take: Any, floor: Any, scratch: Any) -> Any:
    """Find the `take`-th smallest priority, and how many of those that equal it are among the first `take`.

    None is below `floor`, most are uniform, so few are looked at twice.
    """
    share = (take + 6.0 * np.sqrt(take) + 16.0) / len(priority)
    room = 9223372036854775808.0 - float(floor)  # of samples that are no copies
    if room <= 0.0:
        room += 9223372036854775808.0
    while True:
        reach = float(floor) + share * room
        limit = np.uint64(18446744073709551615)
        if reach < 18446744073709549568.0:
            limit = np.uint64(reach)
        found = 0
        for i in range(len(priority)):
            scratch[found] = priority[i]
            found += priority[i] <= limit
        if found >= take:
            break
        share *= 2.0
    low, high, wanted = 0, found - 1, take - 1
    while low < high:  # quickselect (Hoare 1961)
        pivot = scratch[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while scratch[i] < pivot:
                i += 1
            while scratch[j] > pivot:
                j -= 1
            if i <= j:
                scratch[i], scratch[j] = scratch[j], scratch[i]
                i += 1
                j -= 1
        if wanted <= j:
            high = j
        elif wanted >= i:
            low = i
        else:
            break
    threshold = scratch[wanted]
    spare = take
    for i in range(found):
        spare -= scratch[i] < threshold
    return threshold, spare
