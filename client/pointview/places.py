"""How coarse a cut is at each place: the spacing that the splat of a sample must close.

LPC 4 gives one size to all splats of a cloud. But a cloud's samples lie in all of its descendants' cells: where some of
these are here and others not yet, one size is either too small for the one half or too large for the other. So a
sample's splat follows the deepest drawn node at the sample's place.

The cells of the tree are those of the build (docs/format.md, Cells): the box of all samples, halved again and again at
the middle of its longest side, so a sample's place is found by comparing one coordinate a level. A fat splat must not
end where its cell does, or a seam of half covered ground would show: a sample of the drawn ancestors as near to a
coarser cell as `splats.REACH` of that cell's spacings takes the size of that cell too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from lpc.header import Header

    from .uneven import Below

MOST_HALVINGS = 48
"""Of one axis; a build tells no samples apart beyond."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """The drawn part of the tree, for looking up the cell of a sample.

    Parameters
    ----------
    link : (n + m, 2) int32
        Row of the lower and upper half of the cell of each drawn node, -1 where that half ends here. The first n rows
        are those of the drawn nodes, the others those of cells below them (`uneven`).
    spacing : (n + m, 2) float32
        Spacing to close in each half, model units; the largest of it where a link goes deeper. Negative in a half
        that ends here because its node is missing.
    spread : (n + m,) float32
        How much further apart samples are where a half of the row ends than all of the model's would be.
    alone : (n,) float32
        The inverse of that for the samples of the node alone: `render.thin` knows how far apart these are.
    corner : (n, 3) float64
        Lowest corner of the node's cell, model space.
    level : (n,) int32
        Of the node.
    uniform : (n,) bool
        Whether both halves end here with one spacing, so that nothing need be looked up.
    axis : (levels,) int32
        Axis along which the cells of a level are halved.
    half : (levels,) float32
        Half the side of such a cell along that axis, model units.
    """

    link: NDArray[np.int32]
    spacing: NDArray[np.float32]
    spread: NDArray[np.float32]
    alone: NDArray[np.float32]
    corner: NDArray[np.float64]
    level: NDArray[np.int32]
    uniform: NDArray[np.bool_]
    axis: NDArray[np.int32]
    half: NDArray[np.float32]


def halvings(header: Header, levels: int) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Axis and half side, model units, by which the cells of each of so many levels are halved.

    Notes
    -----
    Below the level where nothing tells samples apart, cells have no extent: axis 0, half 0.
    """
    bounds = [float(value) for value in header.bounds]
    sides = [high - low for low, high in zip(bounds[:3], bounds[3:], strict=True)]
    used, axes, halves = [0, 0, 0], np.zeros(levels, dtype=np.int32), np.zeros(levels)
    for level in range(levels):
        left = [side if count < MOST_HALVINGS else 0.0 for side, count in zip(sides, used, strict=True)]
        axis = left.index(max(left))
        if left[axis] == 0.0:
            break
        sides[axis] /= 2
        used[axis] += 1
        axes[level], halves[level] = axis, sides[axis]
    return axes, halves


def places(
    header: Header,
    starts: Sequence[int],
    drawn: NDArray[np.bool_],
    missing: NDArray[np.bool_],
    own: NDArray[np.float64],
    shown: NDArray[np.float64],
    below: Below,
    alone: NDArray[np.float64],
) -> Places:
    """Lay out the drawn nodes.

    Parameters
    ----------
    starts : sequence of int
        Where the nodes of each level start, and where the last ends.
    drawn, missing : (n, 2) bool
        For each node, which children are drawn and which are missing.
    own, shown : (n,) float64
        The spacing that each node's own samples close (`snug`), and the largest shown around its samples.
    below : Below
        What the index says of the halves without a drawn node.
    alone : (n,) float64
        See `Places`.
    """
    count, levels = len(drawn), len(starts) - 1
    axes, halves = halvings(header, levels + below.levels)
    link, spacing = below.link.copy(), below.spacing.copy()
    link[:count][drawn] = np.arange(1, count)  # nodes stand in the order of the halves that hold them
    here = np.where(missing, -own[:, None], shown[:, None])
    here = np.where(np.isnan(spacing[:count]), here, spacing[:count])
    here[drawn] = shown[1:]
    spacing[:count] = here
    uniform = (link[:count, 0] < 0) & (link[:count, 1] < 0) & (here[:, 0] == here[:, 1])
    parent, half = np.nonzero(drawn)
    corner = np.empty((count, 3))
    corner[0] = header.bounds[:3]
    for depth in range(1, levels):
        some = slice(starts[depth], starts[depth + 1])
        above = slice(some.start - 1, some.stop - 1)  # the root has no parent
        corner[some] = corner[parent[above]]
        corner[some, axes[depth - 1]] += half[above] * halves[depth - 1]
    return Places(
        link=link,
        spacing=spacing.astype(np.float32),
        spread=below.spread.astype(np.float32),
        alone=alone.astype(np.float32),
        corner=corner,
        level=np.repeat(np.arange(levels, dtype=np.int32), np.diff(starts)),
        uniform=uniform,
        axis=axes,
        half=halves.astype(np.float32),
    )
