"""Frames as files, and the twin that shows where data is missing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from lpc.errors import StoreError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


class Shown(Protocol):
    """A picture (h, w, 3) uint8 and its starved pixels (h, w) bool; a `Frame` is one."""

    @property
    def rgb(self) -> NDArray[np.uint8]:
        """Colours."""
        ...

    @property
    def starved(self) -> NDArray[np.bool_]:
        """Pixels of starved nodes."""
        ...


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


def tint_starved(frame: Shown) -> NDArray[np.uint8]:
    """Return the picture with its starved pixels tinted yellow."""
    rgb = frame.rgb.copy()
    rgb[frame.starved] = np.rint(rgb[frame.starved] * (1 - TINT) + np.array(YELLOW) * TINT).astype(np.uint8)
    return rgb
