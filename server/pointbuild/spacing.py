"""Spacings of the model and of its nodes, from areas."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lpc.spacing import spacings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .assemble import Nodes


def model_spacing(spacing: NDArray[np.float64], weight: NDArray[np.integer]) -> float:
    """R of the whole model: the median over the samples of the spacing of their region.

    Parameters
    ----------
    spacing, weight : ndarray, (n,)
        Of regions, and how many samples each has. Regions whose samples all coincide do not count.

    Returns
    -------
    float
        In the unit of `spacing`; 0 if there is no region.
    """
    if not len(spacing):
        return 0.0
    order = np.lexsort((weight, spacing))
    reached = np.cumsum(weight[order])
    return float(spacing[order][np.searchsorted(reached, (reached[-1] + 1) // 2)])


def node_spacings(nodes: Nodes, spacing: float, step: float) -> tuple[NDArray[np.float32], tuple[float, float, float]]:
    """Spacing r_j to store for each node, and its ratio to LPC equations 1 and 2.

    A node drawn with its ancestors shows `Nodes.drawn` samples on the surface of its cell, so their spacing is the
    square root of area over samples: where the scan is uniform that is what the equations give, and where it is not
    it keeps the surface closed. No spacing is below the lattice step, beyond which positions say nothing.

    Parameters
    ----------
    nodes : Nodes
    spacing : float
        r of the model, lattice steps, as the areas of nodes.
    step : float
        Of the lattice, model units.

    Returns
    -------
    stored : ndarray, (n,) float32
        Model units.
    ratio : tuple of three floats
        5, 50 and 95 % of the nodes have a smaller ratio of the stored spacing to that of the equations.
    """
    if spacing == 0.0:
        return np.zeros(len(nodes), np.float32), (1.0, 1.0, 1.0)
    stored = (np.maximum(np.sqrt(nodes.area / nodes.drawn), 1.0) * step).astype(np.float32)
    uniform = spacings(nodes.subtree, nodes.samples, nodes.parent, spacing * step)
    low, middle, high = np.percentile(stored / uniform, [5, 50, 95]).tolist()
    return stored, (low, middle, high)
