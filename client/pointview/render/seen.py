"""Which cells of the tree a picture shows: what occlusion culling learns from a finished frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from . import picture_kernels
from .tables import HALVING, PLACE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pointview.camera import Camera
    from pointview.refine import Cut

    from .backend import Frame


def place_table(cut: Cut) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return a cut's places as the kernels read them: of the nodes, and the halvings of the levels."""
    if cut.places is None:
        return np.empty(0, dtype=PLACE), np.empty(0, dtype=HALVING)
    places = np.empty(len(cut.places.link), dtype=PLACE)
    places["lower"], places["upper"] = cut.places.link.T
    places["lower_spacing"], places["upper_spacing"] = cut.places.spacing.T
    places["spread"] = cut.places.spread
    halvings = np.empty(len(cut.places.axis), dtype=HALVING)
    halvings["axis"], halvings["half"] = cut.places.axis, cut.places.half
    return places, halvings


def look_ups(cut: Cut, part: slice, thin: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Levels of the nodes whose samples look up how large they are, each its own size; -1 for nodes of one spacing.

    Parameters
    ----------
    part : slice
        Which nodes of the cut.
    thin : (n,) bool
        Whether some of their samples are in thin parts of the cloud.
    """
    if cut.places is None:
        return np.full(len(thin), -1, dtype=np.int32)
    return np.where(cut.places.uniform[part] & ~thin, np.int32(-1), cut.places.level[part])


def pixels_by_cell(depth: NDArray[np.float32], cut: Cut, camera: Camera, *, stride: int = 1) -> NDArray[np.int64]:
    """Count the pixels that show a surface in each half of the cell of each node of a cut, (n, 2).

    Parameters
    ----------
    depth : (h, w) float32
        `Frame.depth` of that cut.
    stride : int
        Count every so many pixels of every so many lines.
    """
    places, halvings = place_table(cut)
    counts = np.zeros((max(len(places), len(cut.nodes)), 2), dtype=np.int64)
    if cut.places is not None and len(places):
        eye = (np.array(camera.eye) - cut.places.corner[0]).astype(np.float32)
        looked = np.ascontiguousarray(depth[::stride, ::stride])
        picture_kernels.count_cells(
            counts, looked, places, halvings, eye, camera.rotation().astype(np.float32), camera.focal / stride
        )
    return counts[: len(cut.nodes)]


def contrast_by_cell(frame: Frame, cut: Cut, camera: Camera, *, reach: float, stride: int = 1) -> NDArray[np.float64]:
    """Sum up how much the pixels in each half of the cell of each node of a cut differ from others near them.

    Parameters
    ----------
    frame : Frame
        The picture of that cut.
    reach : float
        How far the others are, over the spacing that the pixel shows; a pixel at least.
    stride : int
        Look at every so many pixels of every so many lines; the sums are of the whole picture all the same.

    Returns
    -------
    (n, 2) float64
        Mean squared difference from four others, summed over channels, in squared levels, and over pixels.
    """
    places, halvings = place_table(cut)
    sums = np.zeros((max(len(places), len(cut.nodes)), 2))
    if cut.places is not None and len(places):
        eye, turn = (np.array(camera.eye) - cut.places.corner[0]).astype(np.float32), camera.rotation()
        picture_kernels.contrast_by_cell(
            sums, frame.rgb, frame.depth, places, halvings, eye, turn.astype(np.float32), camera.focal, reach, stride
        )
    return np.asarray(sums[: len(cut.nodes)] * stride**2)
