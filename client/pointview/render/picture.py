"""Frames as files, and the twin that shows where data is missing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lpc.errors import StoreError

if TYPE_CHECKING:
    from pointview.refine import Cut

    from .backend import Frame

YELLOW = (255, 214, 10)
TINT = 0.5
"""Share of yellow in a starved pixel; the rest keeps the shading readable."""


def save_png(rgb: NDArray[np.uint8], path: Path) -> None:
    """Write a (h, w, 3) uint8 picture.

    Raises
    ------
    StoreError
        If the file cannot be written.
    """
    from PIL import Image  # a quarter of a second that only pictures need

    try:
        Image.fromarray(rgb).save(path, format="PNG")
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error


def starved_pixels(frame: Frame, cut: Cut) -> NDArray[np.bool_]:
    """Pixels (h, w) whose sample belongs to a starved node: the yellow patches of LPC figure 5."""
    starved = cut.nodes[cut.starved]
    if len(starved) == 0:
        return np.zeros(frame.node.shape, dtype=bool)
    place = np.minimum(np.searchsorted(starved, frame.node), len(starved) - 1)
    return starved[place] == frame.node


def tint_starved(frame: Frame, cut: Cut) -> NDArray[np.uint8]:
    """Return the picture with its starved pixels tinted yellow."""
    rgb = frame.rgb.copy()
    where = starved_pixels(frame, cut)
    rgb[where] = np.rint(rgb[where] * (1 - TINT) + np.array(YELLOW) * TINT).astype(np.uint8)
    return rgb
