"""Hierarchical sample spacing: equations 1 and 2 of *Layered Point Clouds*, section 3."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def level_bounds(parent: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return where each level starts in a breadth-first order.

    Parameters
    ----------
    parent : ndarray, (n,) int
        Number of the parent of each node, -1 for the root, which is node 0. Breadth-first, so it never decreases.

    Returns
    -------
    ndarray, (levels + 1,) int64
        Level k is the nodes `bounds[k]` to `bounds[k + 1] - 1`.

    Raises
    ------
    ValueError
        If the order is not breadth-first or a parent does not come before its child.
    """
    parent = np.asarray(parent, dtype=np.int64)
    count = len(parent)
    if count == 0 or parent[0] != -1 or (parent[1:] < 0).any():
        raise ValueError("node 0, and no other, is the root")
    if (np.diff(parent) < 0).any() or (parent >= np.arange(count)).any():
        raise ValueError("nodes are not in breadth-first order")
    bounds = [0, 1]
    while bounds[-1] < count:
        bounds.append(int(np.searchsorted(parent, bounds[-1], side="left")))
    return np.array(bounds)


def spacings(
    subtree: NDArray[np.integer], samples: NDArray[np.integer], parent: NDArray[np.integer], r: float
) -> NDArray[np.float64]:
    """Average distance between samples in a node's region when the node and its ancestors are drawn together.

    LPC 3: the root has M_tot = M and spacing r sqrt(N / M); below it,

        M_tot(j) = N_j / (N_p - M_p) M_tot(p) + M_j                                  (1)
        r_j      = r_p sqrt(N_j M_tot(p) / ((N_p - M_p) M_tot(j)))                   (2)

    Parameters
    ----------
    subtree, samples : ndarray, (n,) int
        N_j, samples of the node and its descendants, and M_j, samples of its own cloud; nodes breadth-first.
    parent : ndarray, (n,) int
        Number of the parent, -1 for the root.
    r : float
        Spacing of the input samples, model units.

    Returns
    -------
    ndarray, (n,) float64
        r_j in the units of `r`.
    """
    own = np.asarray(samples, dtype=np.float64)
    total = np.asarray(subtree, dtype=np.float64)
    bounds = level_bounds(parent)
    drawn = np.empty_like(own)
    spacing = np.empty_like(own)
    drawn[0] = own[0]
    spacing[0] = r * np.sqrt(total[0] / own[0])
    for start, stop in pairwise(bounds[1:]):
        level = slice(start, stop)
        above = parent[level]
        share = total[level] / (total[above] - own[above])
        inherited = share * drawn[above]
        drawn[level] = inherited + own[level]
        spacing[level] = spacing[above] * np.sqrt(inherited / drawn[level])
    return spacing
