"""The partition of *Layered Point Clouds*, section 5, by plain recursion over exact fractions: slow and obvious.

The builder must put the same samples into the same nodes. Only the priorities are taken from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

BITS = 48
COINCIDENT = 65535


@dataclass(frozen=True)
class Node:
    """`own`: samples of the node's cloud; `cell`: all in its cell; `subtree`: those of them that no ancestor took."""

    depth: int
    own: frozenset[int]
    subtree: frozenset[int]
    cell: frozenset[int]
    path: tuple[int, ...]


def partition(
    xyz: NDArray[np.float64],
    low: NDArray[np.float64],
    extent: NDArray[np.float64],
    priority: NDArray[np.uint64],
    cloud_size: int,
) -> list[Node]:
    """All nodes, breadth first, of the root box from `low` on; what lies outside is on its face."""
    places = []
    for sample in xyz:
        place = []
        for axis in range(3):
            part = Fraction(max(float((sample[axis] - low[axis]) / extent[axis]), 0.0)) if extent[axis] else Fraction(0)
            place.append(min(Fraction(int(part * 2**BITS), 2**BITS), 1 - Fraction(1, 2**BITS)))
        places.append(tuple(place))
    order = [int(value) for value in priority]
    nodes: list[Node] = []
    # A cell: its corner and its halvings per axis, in units of the root box.
    level = [(frozenset(range(len(xyz))), frozenset(range(len(xyz))), (Fraction(0),) * 3, (0, 0, 0), ())]
    while level:
        below = []
        for cell, left, corner, halved, path in level:
            one_place = len({places[sample] for sample in cell}) == 1
            take = max(COINCIDENT, cloud_size) if one_place else cloud_size
            own = frozenset(sorted(left, key=order.__getitem__)[:take])
            nodes.append(Node(len(path), own, left, cell, path))
            rest = left - own
            if not rest:
                continue
            sides = [float(extent[axis]) / 2 ** halved[axis] if halved[axis] < BITS else 0.0 for axis in range(3)]
            axis = sides.index(max(sides))
            assert sides[axis] > 0 or one_place
            middle = corner[axis] + Fraction(1, 2 ** (halved[axis] + 1))
            upper = frozenset(sample for sample in cell if sides[axis] and places[sample][axis] >= middle)
            for half, part in enumerate((cell - upper, upper)):
                if rest & part:
                    start = list(corner)
                    if half:
                        start[axis] = middle
                    count = list(halved)
                    count[axis] += 1
                    below.append((part, rest & part, tuple(start), tuple(count), (*path, half)))
        level = below
    return nodes
