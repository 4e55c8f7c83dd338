"""What every renderer takes and gives: the one interface over the CPU and OpenGL."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from lpc.cloud import Cloud
    from pointview.camera import Camera
    from pointview.refine import Cut

Take = Callable[[int], "Cloud"]
"""Node number to its decoded cloud; asked only for nodes of the cut, and once while the backend keeps it."""

Rgb = tuple[int, int, int]

Splat = Literal["square", "round", "disc", "blended"]
"""What a splat of more than a few pixels is: a square of pixels as in the paper, a disc that faces the eye, or a disc
in the tangent plane of its sample where there is a normal. Blended: such discs, and the mean of all samples that a
pixel shows instead of the nearest one.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Style:
    """How a cut looks.

    Parameters
    ----------
    background : (r, g, b)
        0 to 255.
    surface : (r, g, b)
        Colour of models that carry none.
    two_sided : bool
        Light both sides of a surface and drop no sample that faces away: for normals that may point inward.
    splat : {"square", "round", "disc"}
        See `Splat`.
    close_holes : bool
        Paint pixels that a nearer surface encloses within a splat's width with that surface, see `splats`.
    edl_strength : float
        Eye-dome lighting of models without normals: slope that darkens by 1/e, see `shading`; 0 switches it off.
    """

    background: Rgb = (18, 21, 26)
    surface: Rgb = (214, 208, 196)
    two_sided: bool = False
    splat: Splat = "disc"
    close_holes: bool = True
    edl_strength: float = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """A finished picture and what it took.

    Parameters
    ----------
    rgb : (h, w, 3) uint8
    depth : (h, w) float32
        Distance along the viewing direction, model units; infinite where nothing was drawn.
    node : (h, w) int32
        The node whose sample is seen; -1 where nothing was drawn.
    starved : (h, w) bool
        Pixels whose sample lies where a node is missing: the yellow patches of LPC figure 5.
    splats, clouds : int
        Samples and clouds submitted.
    uploads : int
        Clouds that were not yet in the backend's memory.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    node: NDArray[np.int32]
    starved: NDArray[np.bool_]
    splats: int
    clouds: int
    uploads: int


class Backend(Protocol):
    """Draws cuts of one model. Not safe to share between threads."""

    @property
    def name(self) -> str:
        """``cpu`` or ``gl``, and on what."""
        ...

    def draw(self, cut: Cut, take: Take, camera: Camera, style: Style) -> Frame:
        """Draw a cut; `take` gives the clouds that the backend does not hold."""
        ...

    def close(self) -> None:
        """Give back memory, threads and contexts."""
        ...
