"""Rendering on a budget (LPC 4): the finest cut that has at most a given number of splats.

The paper searches for the pixel threshold by repeated traversals "with the same refinement logic used for rendering",
that only count. One of them is enough: a cloud is drawn at every tolerance up to the least projected spacing of its
ancestors, its *limit*, so sorting the clouds by it counts the splats of all tolerances at once.

One threshold may step over many clouds: those below a coarser ancestor share its limit, and an eye inside a sphere
makes it infinite. So the budget does not end at a threshold but at a cloud: clouds come by limit, those of equal limit
by node number, the order in which they would be fetched. Parents come before their children both ways, so any beginning
of that order is a cut. It ends from below within one cloud of the budget.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .refine import Cut, refine

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.index import IndexTree

    from .camera import Camera

    Nodes = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Allowance:
    """What of a view a budget allows.

    Parameters
    ----------
    tolerance : float
        Pixels; infinite where only nodes around the eye are refined, or none.
    unrefined : ndarray of int64
        Nodes that are coarser than the tolerance and not refined all the same.
    alone : int
        A node that is drawn without its sibling, the last one; -1 if there is none.
    """

    tolerance: float
    unrefined: Nodes
    alone: int = -1


def allowance(
    index: IndexTree,
    camera: Camera,
    budget: int,
    resident: NDArray[np.bool_],
    *,
    at_least: float,
    cull_backfaces: bool = True,
    **options: Any,
) -> Allowance:
    """Find the finest cut within a budget.

    Parameters
    ----------
    budget : int
        Splats, > 0. The coarsest cut is allowed always.
    resident : (n_nodes,) bool
        Nodes to count as drawable: those that are here, or all that are known.
    at_least : float
        The tolerance if the budget allows it, pixels.
    **options
        Of `refine`.
    """
    nodes = refine(index, camera, at_least, resident, cull_backfaces=cull_backfaces, **options).nodes
    samples = index.samples[nodes]
    nothing = np.empty(0, dtype=np.int64)
    if int(samples.sum()) <= budget or len(nodes) < 2:
        return Allowance(tolerance=at_least, unrefined=nothing)
    limit = _limits(index, camera, nodes)
    order = np.argsort(-limit, kind="stable")  # the root first: its limit is infinite and its number the least
    parents = index.parent[nodes[order]].astype(np.int64)
    allowed = int(np.searchsorted(np.cumsum(samples[order]), budget, side="right"))
    allowed = max(allowed, 1)
    # Siblings stand together, so a family is cut apart only at the very end.
    apart = allowed > 1 and parents[allowed - 1] == parents[allowed]
    return Allowance(
        tolerance=float(limit[order[allowed - 1]]),
        unrefined=np.setdiff1d(parents[allowed:], parents[:allowed]),
        alone=int(nodes[order[allowed - 1]]) if apart else -1,
    )


def refine_within(
    index: IndexTree, camera: Camera, within: Allowance, resident: NDArray[np.bool_], **options: Any
) -> Cut:
    """Compute the cut of one frame as `refine` does, within an allowance."""
    pruned = index
    if len(within.unrefined):
        pruned = copy.copy(index)
        pruned.children = index.children.copy()
        pruned.children[within.unrefined] = -1
    if within.alone < 0:
        return refine(pruned, camera, within.tolerance, resident, **options)
    # The sibling is missing on purpose: splats grow in its place, and nobody asks for it.
    parent = int(index.parent[within.alone])
    left_out = index.children[parent][index.children[parent] != within.alone]
    here = resident.copy()
    here[left_out] = False
    cut = refine(pruned, camera, within.tolerance, here, **options)
    starved = cut.starved.copy()
    if resident[within.alone]:
        starved[cut.nodes == parent] = False
    return replace(cut, starved=starved, wants=cut.wants[~np.isin(cut.wants, left_out)])


def _limits(index: IndexTree, camera: Camera, nodes: Nodes) -> NDArray[np.float64]:
    """Largest tolerance that draws each node of a cut, pixels; infinite for the root."""
    offset = index.center[nodes] - np.array(camera.eye)
    gap = np.sqrt(np.einsum("ij,ij->i", offset, offset)) - index.radius[nodes]
    spacing_px = np.full(len(nodes), math.inf)
    np.divide(index.density.coarseness[nodes] * camera.focal, gap, out=spacing_px, where=gap > 0)
    limit = np.full(len(nodes), math.inf)
    above = np.searchsorted(nodes, index.parent[nodes])
    starts = np.flatnonzero(np.diff(index.level[nodes])) + 1  # nodes ascend, and so do their levels
    for start, stop in zip(starts, [*starts[1:], len(nodes)], strict=True):
        parents = above[start:stop]
        limit[start:stop] = np.minimum(limit[parents], spacing_px[parents])
    return limit
