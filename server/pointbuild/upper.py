"""The upper tree: how many samples each of its nodes takes of every bucket.

A node takes the M smallest priorities in its cell that its ancestors left. So the *shares* say it all: the samples of a
bucket in the order of their priorities belong to the root, as many as its share of the bucket is, then to the next node
on the way down, and at last to the bucket's own tree. They come from candidates, the samples of small priority that
the scatter set aside. Equal samples have equal priorities and are in one bucket; a share may end between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .priority import COPY

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .plan import Cell, Plan
    from .scatter import Candidates

ALL = np.uint64(2**64 - 1)


@dataclass(frozen=True, slots=True)
class UpperNode:
    """A node above the buckets.

    Parameters
    ----------
    parent, half : int
        Its parent among the upper nodes (-1: it is the root), and which half of the parent's cell it is.
    cell : Cell
    subtree, samples : int
        Of the node with its descendants, and of its own cloud.
    """

    parent: int
    half: int
    cell: Cell
    subtree: int
    samples: int


@dataclass(frozen=True, slots=True)
class Upper:
    """The upper tree in preorder, and for each bucket the way down to it.

    Parameters
    ----------
    nodes : list of UpperNode
    parent, half : list of int
        For each bucket the upper node above it, and which half of that cell it is; -1 and 0 for a lone bucket.
    shares : list of lists of int
        For each bucket how many of its samples the nodes above it take, from the root down.
    """

    nodes: list[UpperNode]
    parent: list[int]
    half: list[int]
    shares: list[list[int]]

    def above(self, bucket: int) -> list[int]:
        """Upper nodes from the root down to the bucket."""
        path, node = [], self.parent[bucket]
        while node >= 0:
            path.append(node)
            node = self.nodes[node].parent
        return path[::-1]


def candidate_limits(plan: Plan, cloud_size: int, slack: float) -> NDArray[np.uint64]:
    """Priorities up to which the samples of each bucket may be taken by the upper tree.

    The expected threshold of a node is T / C of the range of samples that are no copies, with C the samples of its cell
    and T those drawn there by LPC equation 1; `slack` is how many standard deviations of T are added, and how many
    32nds of T because others are copies.
    """
    limits = np.zeros(len(plan.buckets), np.uint64)

    def visit(cell: Cell, drawn: float, most: int) -> None:
        if cell.is_bucket:
            limits[cell.buckets[0]] = most
            return
        drawn += cloud_size
        enough = drawn * (1 + slack / 32) + slack * math.sqrt(drawn) + 4 * slack
        most = max(most, min(int(enough / cell.count * 2.0**63), int(ALL)))
        for child in cell.children:
            if child is not None:
                visit(child, drawn * child.count / cell.count, most)

    visit(plan.root, 0.0, 0)
    return limits


def share_out(plan: Plan, candidates: Candidates, limits: NDArray[np.uint64], cloud_size: int) -> Upper | None:
    """Say which node takes how many samples.

    Parameters
    ----------
    plan : Plan
    candidates : Candidates
        All samples whose priority is at most that of their bucket in `limits`.
    limits : ndarray, (buckets,) uint64
    cloud_size : int
        M.

    Returns
    -------
    Upper or None
        None if some node wants a sample that is no candidate; try larger limits.
    """
    order = np.lexsort((candidates.priority, candidates.bucket))
    priority, bucket = candidates.priority[order], candidates.bucket[order]
    copy = 1 + np.flatnonzero((priority[1:] == priority[:-1]) & (bucket[1:] == bucket[:-1]))
    priority[copy] |= COPY
    order = np.lexsort((priority, bucket))
    priority = priority[order]
    first = np.searchsorted(bucket, np.arange(len(plan.buckets) + 1))
    count = np.array([entry.count for entry in plan.buckets])
    used = np.zeros(len(plan.buckets), np.int64)  # candidates of each bucket that are taken, in order of priority
    upper = Upper([], [-1] * len(plan.buckets), [0] * len(plan.buckets), [[] for _ in plan.buckets])

    def visit(cell: Cell, parent: int, half: int) -> bool:
        begin, end = cell.buckets
        inside = slice(begin, end)
        left = int((count[inside] - used[inside]).sum())
        if cell.is_bucket or not left:
            upper.parent[inside] = [parent] * (end - begin)
            upper.half[inside] = [half] * (end - begin)
            return True
        free = np.concatenate([priority[first[b] + used[b] : first[b + 1]] for b in range(begin, end)])
        take = min(left, cloud_size)
        if len(free) < take:
            return False
        threshold = np.partition(free, take - 1)[take - 1]
        if take < left and threshold > limits[inside].min():
            return False
        spare = take - int((free < threshold).sum())  # of those at the threshold
        for b in range(begin, end):
            own = priority[first[b] + used[b] : first[b + 1]]
            below, upto = np.searchsorted(own, threshold), np.searchsorted(own, threshold, side="right")
            share = int(below) + min(int(upto - below), spare)
            spare -= share - int(below)
            used[b] += share
            upper.shares[b].append(share)
        node = UpperNode(parent, half, cell, left, take)
        upper.nodes.append(node)
        number = len(upper.nodes) - 1
        return all(visit(child, number, side) for side, child in enumerate(cell.children) if child is not None)

    return upper if visit(plan.root, -1, 0) else None
