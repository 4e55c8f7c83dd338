"""Below the drawn nodes: how far apart samples are in parts of a cell whose own clouds are not drawn.

Where a scan is even, a half without a drawn node of its own shows the spacing of the node above. Where it is not, that
average says little: in the thin part of a cell samples are much further apart. The index knows (`lpc.density`), so the
table of places goes on below the drawn nodes, as far as cells are uneven and their samples more than a pixel apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.index import IndexTree

    from .camera import Camera


WORTH = 0.5
"""Pixels between samples, on average, from which it is worth knowing where they are further apart."""


@dataclass(frozen=True, slots=True)
class Below:
    """Rows of `Places` that the index adds to those of the drawn nodes: theirs first, then of cells below them.

    Parameters
    ----------
    link : (n + m, 2) int32
        Row of a half among the added ones, -1 for none.
    spacing : (n + m, 2) float64
        Spacing that a half shows, model units; the largest of it where a link goes deeper. Negative where a node is
        missing. NaN: the index knows nothing better than the node above.
    spread : (n + m,) float64
        How much further apart samples are there than all of the model's would be.
    levels : int
        How far the added rows go down.
    """

    link: NDArray[np.int32]
    spacing: NDArray[np.float64]
    spread: NDArray[np.float64]
    levels: int


def look_below(
    index: IndexTree,
    camera: Camera,
    nodes: NDArray[np.int64],
    drawn: NDArray[np.bool_],
    missing: NDArray[np.bool_],
) -> Below:
    """Look below the nodes of a cut.

    Parameters
    ----------
    nodes : (n,) int64
    drawn, missing : (n, 2) bool
        Which of their children are drawn, and which should be.
    """
    density, eye = index.density, np.array(camera.eye)
    spreads = [1.0 / np.sqrt(density.drawn[nodes])]
    link, spacing = np.full(drawn.shape, -1, dtype=np.int32), np.full(drawn.shape, np.nan)
    uneven = np.flatnonzero(density.uneven[nodes])
    children = np.where(drawn[uneven], -1, index.children[nodes[uneven]])
    at, half = np.nonzero((children >= 0) & index.known[children])
    # Cells of one level: the row and half they belong to, and what spreads their samples.
    row, cell = uneven[at], children[at, half].astype(np.int64)
    spread = np.where(missing[row, half], -1.0, 1.0) * spreads[0][row]
    hung = []
    while len(cell):
        apart = density.full[cell] * spread
        spacing[row, half] = apart
        away = np.linalg.norm(index.center[cell] - eye, axis=1) - index.radius[cell]
        deeper = density.uneven[cell] & (np.abs(apart) * camera.focal > WORTH * away)
        row, half, cell, spread, apart = row[deeper], half[deeper], cell[deeper], spread[deeper], apart[deeper]
        first = len(link)
        link[row, half] = first + np.arange(len(row))
        hung.append((first, row, half))
        link = np.concatenate([link, np.full((len(row), 2), -1, dtype=np.int32)])
        spacing = np.concatenate([spacing, np.stack([apart, apart], axis=1)])
        spreads.append(np.abs(spread))
        children = index.children[cell]
        at, half = np.nonzero((children >= 0) & index.known[children])
        row, cell, spread = first + at, children[at, half].astype(np.int64), spread[at]
    for first, row, half in reversed(hung):
        largest = np.abs(spacing[first : first + len(row)]).max(axis=1)
        spacing[row, half] = np.copysign(largest, spacing[row, half])
    return Below(link, spacing, np.concatenate(spreads), len(hung))
