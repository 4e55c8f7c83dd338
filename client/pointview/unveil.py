"""Settling a still picture without fetching what is hidden: coarse pictures tell what finer ones need not ask for."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    import numpy as np
    from numpy.typing import NDArray

    from pointstream.layer import AccessLayer

    from .camera import Camera
    from .occlusion import Occlusion
    from .refine import Cut
    from .render import Frame

    Hidden = NDArray[np.bool_] | None
    Look = Callable[[AccessLayer], Cut]

COARSER = (16.0, 8.0, 4.0, 2.0)
"""Multiples of the tolerance of the pictures on the way."""

MOST_PASSES = 4
"""Pictures at the tolerance itself: the first may show what the coarser ones did not."""


async def unveil(
    layer: AccessLayer,
    occlusion: Occlusion,
    cut_of: Callable[[AccessLayer, float, Hidden], Cut],
    settle: Callable[[AccessLayer, Look], Awaitable[Cut]],
    draw: Callable[[Cut], tuple[Camera, Frame]],
) -> tuple[Look, Cut]:
    """Fetch a view, coarse to fine, and return how to look at it and what it shows.

    Parameters
    ----------
    occlusion : Occlusion
        Of this view; afterwards its verdict says whether anything was left out.
    cut_of : callable
        Cut of what is here, at so many times the tolerance, without hidden nodes.
    settle : callable
        Fetches until a look misses nothing.
    draw : callable
        Draws a cut.
    """
    for factor in COARSER + MOST_PASSES * (1.0,):
        hidden = occlusion.hidden if len(occlusion.hidden) == layer.header.nodes else None
        look = partial(_look, cut_of=cut_of, factor=factor, hidden=hidden)
        cut = await settle(layer, look)
        if hidden is None or occlusion.verdict is not None:
            break  # the model was replaced meanwhile, or hides too little
        camera, frame = draw(cut)
        if not occlusion.look(layer.index, cut, camera, frame) and factor == 1.0:
            return look, cut
    look = partial(_look, cut_of=cut_of, factor=1.0, hidden=hidden if occlusion.verdict is None else None)
    return look, await settle(layer, look)


def _look(
    layer: AccessLayer, *, cut_of: Callable[[AccessLayer, float, Hidden], Cut], factor: float, hidden: Hidden
) -> Cut:
    return cut_of(layer, factor, hidden if hidden is not None and len(hidden) == layer.header.nodes else None)
