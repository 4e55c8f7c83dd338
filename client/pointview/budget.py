"""Rendering on a budget (LPC 4): the tolerance whose cut has a given number of splats.

The paper searches for the pixel threshold by repeated traversals "with the same refinement logic used for rendering",
that only count. One of them is enough: a cloud is drawn at every tolerance up to the least projected spacing of its
ancestors, so sorting the clouds by that limit counts the splats of all tolerances at once.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from .refine import drawn_up_to

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.index import IndexTree

    from .camera import Camera


def tolerance_for_budget(
    index: IndexTree,
    camera: Camera,
    budget: int,
    resident: NDArray[np.bool_],
    *,
    at_least: float,
    cull_backfaces: bool = True,
) -> float:
    """Find the smallest tolerance that keeps within a budget.

    Parameters
    ----------
    budget : int
        Splats, > 0.
    resident : (n_nodes,) bool
        Nodes to count as drawable: those that are here, or all that are known.
    at_least : float
        The tolerance if the budget allows it, pixels.

    Returns
    -------
    float
        Pixels. Infinite where even the coarsest cut has more splats.
    """
    limit, samples = drawn_up_to(index, camera, at_least, resident, cull_backfaces=cull_backfaces)
    order = np.argsort(-limit, kind="stable")
    fitting = int(np.searchsorted(np.cumsum(samples[order]), budget, side="right"))
    if fitting == len(order):
        return at_least
    return max(at_least, math.nextafter(float(limit[order[fitting]]), math.inf))
