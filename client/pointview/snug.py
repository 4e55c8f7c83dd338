"""Snug splats: how far below the size for a lone sheet of random samples a place's splats may stay.

`splats.CLOSING` closes a surface by splats alone, to 0.3%. Larger splats than pixels need less: the gaps that smaller
ones leave are closed in the picture (`splats.HOLE`), and what a splat reaches over a rim, into the sky or over what
lies behind, is error. So where splats are more than `FINE` pixels apart they shrink to `SNUG` of their size, but not

- where a cell holds a surface that folds: a ball of a thousand samples is all rim, and snug splats would dent it. Its
  samples' area is then larger than the disc of its bounding sphere;
- where density falls within a cell or the one above: gaps are wider there than its average spacing says.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.index import IndexTree

SNUG = 0.85
"""Least share of the size."""
FINE = 2.0
"""Pixels between samples up to which splats keep their size: the picture closes no gap that is less than a pixel."""
FLAT, FOLDED = 0.75, 1.1
"""Area of a cell's samples over that of the disc of its sphere: up to the first a sheet, from the second on folded. A
flat cell has about 2/3, a ball in one cell 4."""
EVEN, FALLING = 1.02, 1.06
"""Root mean square spacing over the average: up to the first even, from the second on falling."""


def snug(index: IndexTree, nodes: NDArray[np.int64], spacing_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of the size that the splats of places where these nodes are the deepest need.

    Parameters
    ----------
    nodes : (n,) int64
        Nodes whose records are known.
    spacing_px : (n,) float64
        Their projected spacing, pixels; may be infinite.
    """
    density = index.density
    folds = density.area[nodes] / (np.pi * np.maximum(index.radius[nodes], 1e-300) ** 2)
    falls = np.maximum(density.contrast[nodes], density.contrast[np.maximum(index.parent[nodes], 0)])
    lone = np.maximum(np.interp(folds, [FLAT, FOLDED], [0.0, 1.0]), np.interp(falls, [EVEN, FALLING], [0.0, 1.0]))
    return np.maximum(SNUG + (1.0 - SNUG) * lone, FINE / np.maximum(spacing_px, FINE))
