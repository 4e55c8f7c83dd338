"""Which missing cloud to ask for first: how much of the picture's error a byte of it removes.

What a cloud removes is estimated from the picture that is shown. Where splats are too coarse, those next to each other
differ by about as much as the picture is wrong there: shading in steps, blots of texture, fat rims before the
background. So the *contrast* of a node's cell is a sum over the pixels that show its surface: of the squared difference
from the pixels half a spacing away. That is visible area times squared error, with whatever hides the cell taken into
account. Refining the cell takes from it what it takes from the projected spacing:

    removed = contrast * (1 - s' / s) / bytes,    s, s' projected spacing in pixels before and after

where s' below half the tolerance is as good as that. A cell that was not in the picture, or whose node came after it,
takes its part of the nearest cell around it that was shown, by *extent*: the part of its bounding sphere's disc that is
in the window, times its projected spacing. Where there is no picture yet, extent stands for contrast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .render.seen import contrast_by_cell

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.index import IndexTree

    from .camera import Camera
    from .refine import Cut
    from .render import Frame

    Nodes = NDArray[np.int64]
    Values = NDArray[np.float64]

REACH = 0.5
"""How far from a pixel its contrast is looked for, spacings: half of the pixels meet another splat there."""

INSIDE = 0.3
"""Least distance of a cell from the eye, radii of its sphere. At the nearest point of a sphere around the eye nothing
is ever fine enough, and all clouds would be worth the same: nothing."""

LEAST = 1e-3
"""Contrast of a cell that the picture does not show, over what is usual for its extent: it may show up yet."""


class Contrast:
    """What the last picture of one view of one model showed in each cell.

    Parameters
    ----------
    nodes : int
        Of the model.

    Attributes
    ----------
    shown : (nodes,) float64
        Contrast, squared levels times pixels; NaN where the picture did not tell.
    """

    def __init__(self, nodes: int) -> None:
        self.shown = np.full(nodes, np.nan)

    def look(self, index: IndexTree, cut: Cut, camera: Camera, frame: Frame, *, stride: int = 1) -> None:
        """Learn from the picture of a cut that was refined by the rule "place".

        Parameters
        ----------
        stride : int
            Look at every so many pixels of every so many lines.
        """
        if cut.places is None:
            return
        children = index.children[cut.nodes]
        sums = contrast_by_cell(frame, cut, camera, reach=REACH, stride=stride)[children >= 0]
        nodes = children[children >= 0].astype(np.int64)
        inside = np.ones(len(nodes), dtype=bool)
        known = index.known[nodes]
        inside[known] = extent(index, camera, nodes[known]) > 0
        self.shown = np.full(len(self.shown), np.nan)
        self.shown[nodes[inside]] = sums[inside]


def removed_per_byte(
    index: IndexTree, camera: Camera, tolerance: float, nodes: Nodes, shown: Values | None
) -> NDArray[np.float64]:
    """Estimate the error that each of some missing nodes removes from the picture, per byte.

    Parameters
    ----------
    tolerance : float
        Pixels.
    nodes : (n,) int64
        Not the root. Unknown ones come first (infinite): their page costs little and hides what else is wanted.
    shown : (nodes of the model,) float64, optional
        `Contrast.shown`; None before the first picture.

    Returns
    -------
    (n,) float64
        To be compared with each other only.
    """
    removed = np.full(len(nodes), np.inf)
    known = index.known[nodes]
    nodes = nodes[known]
    scale = camera.focal / _away(index, camera, nodes)
    before = index.density.coarseness[index.parent[nodes]] * scale
    after = np.maximum(index.density.coarseness[nodes] * scale, 0.5 * tolerance)
    fall = np.clip(1.0 - after / np.maximum(before, 1e-300), 0.0, 1.0)
    removed[known] = expected(index, camera, nodes, shown) * fall / np.maximum(index.size[nodes], 1)
    return removed


def expected(index: IndexTree, camera: Camera, nodes: Nodes, shown: Values | None) -> Values:
    """Contrast of the cells of some known nodes: as shown, or the part of it that they have in a cell around them."""
    own = extent(index, camera, nodes)
    if shown is None:
        return own
    around = nodes
    while (unseen := np.isnan(shown[around]) & (around > 0)).any():
        around = np.where(unseen, index.parent[around], around)
    there, total = shown[around], extent(index, camera, around)
    rate = np.divide(there, total, out=np.full(len(nodes), np.nan), where=total > 0)
    usual = float(np.median(rate[rate > 0])) if (rate > 0).any() else 1.0
    return np.asarray(own * np.where(np.isnan(rate), usual, np.maximum(rate, LEAST * usual)))


def extent(index: IndexTree, camera: Camera, nodes: Nodes) -> Values:
    """Part of the discs of known nodes' spheres that is in the window, square pixels, times the projected spacing."""
    place, radius = camera.to_camera(index.center[nodes]), index.radius[nodes]
    scale = camera.focal / np.maximum(np.maximum(place[:, 2], radius), 1e-300)
    reach = np.maximum(radius * scale, 0.5)
    area = np.ones(len(nodes))
    for axis, side in enumerate((camera.width, camera.height)):
        middle = place[:, axis] * scale
        area *= np.maximum(np.minimum(middle + reach, side / 2) - np.maximum(middle - reach, -side / 2), 0.0)
    shown = index.density.coarseness[np.maximum(index.parent[nodes], 0)]
    return np.asarray(area * shown * camera.focal / _away(index, camera, nodes))


def _away(index: IndexTree, camera: Camera, nodes: Nodes) -> Values:
    """Distance of the cells from the eye."""
    radius = index.radius[nodes]
    gap = np.linalg.norm(index.center[nodes] - np.array(camera.eye), axis=1) - radius
    return np.maximum(np.maximum(gap, INSIDE * radius), 1e-300)
