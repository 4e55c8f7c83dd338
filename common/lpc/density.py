"""How dense the scan is in each cell, and how coarse a picture is that ends at a node: for scans that are uneven.

A node's spacing r_j is an average over its cell: area over samples. Where one part of the cell is a hundred times
denser than another, nearly all samples of a random subset are there, and what the other part shows is far coarser than
r_j says. The index tells where: by equation 1 of LPC the share of a cell in its parent's samples is that of its
subtree, so of the T_j samples that the whole model has in the cell, D_j are drawn when the node and its ancestors are:

    T_j = T_p N_j / (N_p - M_p),    T of the root: all samples
    D_j = T_j - N_j + M_j

The scan's own spacing there is R_j = r_j sqrt(D_j / T_j), and a cell c below j that is drawn with no more than j and
its ancestors shows samples R_c / sqrt(D_j / T_j) apart.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from .index import IndexTree

EVEN = 1.1
"""Root mean square spacing over the average up to which a cell counts as even: measured areas differ by as much."""


class Density:
    """What the records known so far say about the density of their cells; zero where nothing is known.

    Attributes
    ----------
    full : (nodes,) float64
        R_j: spacing of all of the model's samples in the cell, model units.
    drawn : (nodes,) float64
        Share of them that the node and its ancestors hold.
    own : (nodes,) float64
        Share of them that the node holds.
    coarseness : (nodes,) float64
        Spacing that a picture shows where it ends at the node, model units: r_j, or in an uneven cell the root of the
        mean square over its area, as far as the index is known.
    uneven : (nodes,) bool
    area : (nodes,) float64
        Of the surface that the samples in the cell are spread over, model units squared.
    contrast : (nodes,) float64
        Root mean square of R over that area, over R_j: 1 where the scan is even, or nothing below is known.
    """

    def __init__(self, nodes: int) -> None:
        self.full = np.zeros(nodes)
        self.drawn = np.zeros(nodes)
        self.own = np.zeros(nodes)
        self.coarseness = np.zeros(nodes)
        self.uneven = np.zeros(nodes, bool)
        self.area = np.zeros(nodes)
        self.contrast = np.zeros(nodes)
        self._inside = np.zeros(nodes)  # T_j
        self._square = np.zeros(nodes)  # area times mean square of R over it

    def add(self, index: IndexTree, levels: Sequence[NDArray[np.int64]]) -> None:
        """Take in nodes whose records have come and whose ancestors' had or do: level by level, from the top."""
        for nodes in levels:
            self._measure(index, nodes)
        changed = np.empty(0, np.int64)
        for nodes in reversed(levels):
            changed = self._add_up(index, np.concatenate([nodes, changed]))
        while len(changed):
            changed = self._add_up(index, changed)

    def _measure(self, index: IndexTree, nodes: NDArray[np.int64]) -> None:
        above, subtree = index.parent[nodes], index.subtree[nodes]
        below = np.maximum(index.subtree[above] - index.samples[above], 1)
        inside = np.where(above < 0, subtree, self._inside[above] * subtree / below)
        count = inside - subtree + index.samples[nodes]
        self._inside[nodes], self.drawn[nodes] = inside, count / inside
        self.own[nodes] = index.samples[nodes] / inside
        self.full[nodes] = index.spacing[nodes] * np.sqrt(count / inside)
        self.area[nodes] = index.spacing[nodes] ** 2 * count
        self._square[nodes] = self.area[nodes] * self.full[nodes] ** 2
        self.coarseness[nodes] = index.spacing[nodes]
        self.contrast[nodes] = 1.0

    def _add_up(self, index: IndexTree, changed: NDArray[np.int64]) -> NDArray[np.int64]:
        """Tell parents about their children, where all of these are known; return them."""
        parents = np.unique(index.parent[changed]).astype(np.int64)
        parents = parents[parents >= 0]
        children = index.children[parents]
        exists = children >= 0
        whole = (index.known[children] & (self._inside[children] > 0) | ~exists).all(axis=1)
        parents, children, exists = parents[whole], children[whole], exists[whole]
        square = np.where(exists, self._square[children], 0.0).sum(axis=1)
        area = np.where(exists, self.area[children], 0.0).sum(axis=1)
        mean = np.sqrt(square / np.where(area > 0, area, 1.0))
        self._square[parents] = mean**2 * self.area[parents]
        full = self.full[parents]  # 0: all samples of the cell coincide
        self.contrast[parents] = np.divide(mean, full, out=np.ones(len(parents)), where=full > 0)
        self.uneven[parents] = self.contrast[parents] > EVEN
        shown = np.maximum(mean / np.sqrt(self.drawn[parents]), index.spacing[parents])
        self.coarseness[parents] = np.where(self.uneven[parents], shown, index.spacing[parents])
        return parents
