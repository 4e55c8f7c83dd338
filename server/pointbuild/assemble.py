"""The whole tree from the upper tree and the buckets' trees, in the order of the file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lpc.bounds import merge_boxes
from lpc.spacing import level_bounds

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .bucket import BucketTree
    from .plan import Cell, Plan
    from .upper import Upper


@dataclass(frozen=True, slots=True)
class Nodes:
    """All nodes, breadth first: by level, and inside a level by path, which is the Morton order of the cells.

    Parameters
    ----------
    parent, half : ndarray, (n,) int64
        -1 and 0 for the root, which is node 0.
    depth : ndarray, (n,) int64
    cell, subtree, samples : ndarray, (n,) int64
        Samples in the node's cell, those of them that no ancestor took, and those of its own cloud.
    area : ndarray, (n,) float64
        Surface in the cell, model units squared.
    box : ndarray, (n, 6) float64
        Of the subtree's samples.
    normals, bare : ndarray, (n, 3) and (n,) int64
        Sum of the subtree's normals (`bucket.NORMAL_UNIT`), and how many of its samples have none.
    run_start : ndarray, (n + 1,) int64
        Where each node's runs of rows begin in `run_first` and `run_count`.
    run_first, run_count : ndarray, (r,) int64
        Rows of each run.
    """

    parent: NDArray[np.int64]
    half: NDArray[np.int64]
    depth: NDArray[np.int64]
    cell: NDArray[np.int64]
    subtree: NDArray[np.int64]
    samples: NDArray[np.int64]
    area: NDArray[np.float64]
    box: NDArray[np.float64]
    normals: NDArray[np.int64]
    bare: NDArray[np.int64]
    run_start: NDArray[np.int64]
    run_first: NDArray[np.int64]
    run_count: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def drawn(self) -> NDArray[np.int64]:
        """Samples of the cell that the node and its ancestors hold: M_tot of LPC equation 1, counted."""
        return self.cell - self.subtree + self.samples


def assemble(plan: Plan, upper: Upper, buckets: list[BucketTree]) -> Nodes:
    """Join the trees and number the nodes."""
    offsets = len(upper.nodes) + np.concatenate([[0], np.cumsum([len(bucket.tree) for bucket in buckets])])
    parent, half = [np.array([node.parent for node in upper.nodes], np.int64)], [_ints(upper, "half")]
    for number, bucket in enumerate(buckets):
        own = bucket.tree.parent + offsets[number]
        sides = bucket.tree.half.copy()
        if len(own):
            own[0], sides[0] = upper.parent[number], upper.half[number]
        parent.append(own)
        half.append(sides)
    above, sides = np.concatenate(parent), np.concatenate(half)
    order = _breadth_first(above, sides)
    number_of = np.empty(len(order) + 1, np.int64)
    number_of[order], number_of[-1] = np.arange(len(order)), -1

    trees = [bucket.tree for bucket in buckets]
    depth = np.concatenate([[node.cell.depth for node in upper.nodes], *(tree.depth for tree in trees)])
    cell = np.concatenate([[node.cell.count for node in upper.nodes], *(tree.high - tree.low for tree in trees)])
    subtree = np.concatenate([_ints(upper, "subtree"), *(tree.subtree for tree in trees)])
    samples = np.concatenate([_ints(upper, "samples"), *(tree.samples for tree in trees)])
    area = _areas(plan, upper, buckets)

    clouds = [bucket.clouds for bucket in buckets] + [bucket.fragments for bucket in buckets]
    owner = number_of[np.concatenate([np.arange(offsets[0], offsets[-1]), *(bucket.upper for bucket in buckets)])]
    box = np.tile([math.inf] * 3 + [-math.inf] * 3, (len(order), 1))
    normals, bare = np.zeros((len(order), 3), np.int64), np.zeros(len(order), np.int64)
    boxes = np.concatenate([entry.box for entry in clouds])
    np.minimum.at(box[:, :3], owner, boxes[:, :3])
    np.maximum.at(box[:, 3:], owner, boxes[:, 3:])
    np.add.at(normals, owner, np.concatenate([entry.normals for entry in clouds]))
    np.add.at(bare, owner, np.concatenate([entry.bare for entry in clouds]))
    runs = np.argsort(owner, kind="stable")

    above = number_of[above[order]]
    box = np.concatenate(merge_boxes(box[:, :3], box[:, 3:], above), axis=1)
    _sum_up(above, normals)
    _sum_up(above, bare)
    return Nodes(
        parent=above,
        half=sides[order],
        depth=depth[order].astype(np.int64),
        cell=cell[order].astype(np.int64),
        subtree=subtree[order],
        samples=samples[order],
        area=area[order],
        box=box,
        normals=normals,
        bare=bare,
        run_start=np.searchsorted(owner[runs], np.arange(len(order) + 1)),
        run_first=np.concatenate([entry.first for entry in clouds])[runs],
        run_count=np.concatenate([entry.samples for entry in clouds])[runs],
    )


def _ints(upper: Upper, name: str) -> NDArray[np.int64]:
    return np.array([getattr(node, name) for node in upper.nodes], np.int64)


def _breadth_first(parent: NDArray[np.int64], half: NDArray[np.int64]) -> NDArray[np.int64]:
    """Nodes by level; inside a level in the order of their parents, lower half first."""
    child = np.full((len(parent), 2), -1, np.int64)
    inner = parent >= 0
    child[parent[inner], half[inner]] = np.flatnonzero(inner)
    level = np.flatnonzero(~inner)
    levels = []
    while len(level):
        levels.append(level)
        below = child[level].ravel()
        level = below[below >= 0]
    return np.concatenate(levels)


def _sum_up(parent: NDArray[np.int64], values: NDArray[np.int64]) -> None:
    """Add the values of each node to its parent's, deepest level first."""
    bounds = level_bounds(parent)
    for start, stop in zip(bounds[-2:0:-1], bounds[:1:-1], strict=True):
        np.add.at(values, parent[start:stop], values[start:stop])


def _areas(plan: Plan, upper: Upper, buckets: list[BucketTree]) -> NDArray[np.float64]:
    """Areas of the upper nodes' cells from those of the buckets, then of buckets too small to be measured.

    The same sums and quotients as `areas.measure` makes inside a bucket, so that the result does not depend on
    where the upper tree ends.
    """
    known: dict[tuple[int, int, int], float] = {}

    def up(cell: Cell) -> float:
        if cell.is_bucket:
            area = buckets[cell.buckets[0]].cell_area
        else:
            area, measured = 0.0, 0
            for child in reversed(cell.children):
                if child is not None and not math.isnan(part := up(child)):
                    measured += child.count
                    area += part
            area *= cell.count / measured
        known[cell.depth, *cell.buckets] = area
        return area

    def down(cell: Cell) -> None:
        for child in cell.children:
            if child is not None:
                if math.isnan(known[child.depth, *child.buckets]):
                    area = known[cell.depth, *cell.buckets] * child.count / cell.count
                    known[child.depth, *child.buckets] = area
                    tiny[child.buckets[0]] = area
                down(child)

    tiny: dict[int, float] = {}
    up(plan.root)
    down(plan.root)
    parts = [np.array([known[node.cell.depth, *node.cell.buckets] for node in upper.nodes])]
    for number, bucket in enumerate(buckets):
        tree = bucket.tree
        if number in tiny:
            parts.append(tiny[number] * (tree.high - tree.low) / plan.buckets[number].count)
        else:
            parts.append(bucket.area)
    return np.concatenate(parts)
