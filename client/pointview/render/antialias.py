"""Pictures of several samples a pixel: drawn larger, and shrunk in linear light."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .backend import Backend, Frame, Style, Take
from .blending import linear_light

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pointview.camera import Camera
    from pointview.refine import Cut

ROWS = 64
"""Rows of the small picture at a time: light takes four times the memory of levels."""


def draw(backend: Backend, cut: Cut, take: Take, camera: Camera, style: Style, *, finer: int = 1) -> Frame:
    """Draw a cut with `finer * finer` samples a pixel.

    Colours are the mean of their light, depth, node and starvation those of the nearest sample.
    """
    if finer == 1:
        return backend.draw(cut, take, camera, style)
    large = replace(camera, width=finer * camera.width, height=finer * camera.height)
    frame = backend.draw(cut, take, large, style)
    depth = _boxes(frame.depth, finer)
    nearest = depth.argmin(axis=2)[..., None]

    def of_nearest(image: NDArray[Any]) -> NDArray[Any]:
        found: NDArray[Any] = np.take_along_axis(_boxes(image, finer), nearest, axis=2)[..., 0]
        return found

    return replace(
        frame,
        rgb=shrink(frame.rgb, finer),
        depth=of_nearest(frame.depth),
        node=of_nearest(frame.node),
        starved=of_nearest(frame.starved),
    )


def shrink(rgb: NDArray[np.uint8], finer: int) -> NDArray[np.uint8]:
    """Return the picture of the mean light of boxes of `finer * finer` pixels."""
    height, width = rgb.shape[0] // finer, rgb.shape[1] // finer
    small, light_of = np.empty((height, width, 3), dtype=np.uint8), linear_light()
    for top in range(0, height, ROWS):
        rows = light_of[rgb[top * finer : (top + ROWS) * finer]]
        light = rows.reshape(-1, finer, width, finer, 3).mean(axis=(1, 3))
        levels = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** np.float32(1 / 2.4) - 0.055)
        small[top : top + ROWS] = np.rint(255 * levels)
    return small


def _boxes(image: NDArray[Any], side: int) -> NDArray[Any]:
    """Pixels of each box side by side, (h, w, side * side)."""
    height, width = image.shape[0] // side, image.shape[1] // side
    return image.reshape(height, side, width, side).swapaxes(1, 2).reshape(height, width, side * side)
