"""Frames as files, and the twin that shows where data is missing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

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


FORMATS = {
    ".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WEBP", ".tif": "TIFF", ".tiff": "TIFF", ".bmp": "BMP",
    ".ppm": "PPM",
}  # fmt: skip
"""Formats of pictures by suffix."""
LOSS: dict[str, dict[str, Any]] = {"JPEG": {"quality": 95, "subsampling": 0}, "WEBP": {"lossless": True}}
"""What the formats are written with: splats are small, and colours of half the resolution would blur them."""


def save_picture(rgb: NDArray[np.uint8], path: Path) -> None:
    """Write a (h, w, 3) uint8 picture in the format that the suffix says.

    Raises
    ------
    StoreError
        If the suffix is none of `FORMATS`, or the file cannot be written.
    """
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise StoreError(f"{path}: the suffix says the format of a picture; use one of {', '.join(FORMATS)}")
    from PIL import Image  # a quarter of a second that only pictures need

    try:
        Image.fromarray(rgb).save(path, format=kind, **LOSS.get(kind, {}))
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error


def tint_starved(frame: Shown) -> NDArray[np.uint8]:
    """Return the picture with its starved pixels tinted yellow."""
    rgb = frame.rgb.copy()
    rgb[frame.starved] = np.rint(rgb[frame.starved] * (1 - TINT) + np.array(YELLOW) * TINT).astype(np.uint8)
    return rgb
