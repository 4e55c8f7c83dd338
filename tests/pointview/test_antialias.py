"""Several samples a pixel: the mean of their light, and the nearest of them."""

from __future__ import annotations

import numpy as np
import pytest
from oracles.blending import to_levels, to_linear
from support import models

from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style, antialias
from pointview.render.cpu import CpuBackend


@pytest.mark.parametrize("finer", [1, 2, 3])
def test_each_pixel_is_that_of_a_box_of_a_larger_picture(finer):
    model = models.torus(6000, color=True)
    view = {"eye": (1, -2.5, 2), "target": (0, 0, 0), "up": (0, 0, 1)}
    camera = Camera(**view, width=41, height=35)
    large = Camera(**view, width=41 * finer, height=35 * finer)
    cut = refine(model.index, camera, 1.0, model.first(6))
    backend = CpuBackend(model.header)
    frame = antialias.draw(backend, cut, model.take, camera, Style(), finer=finer)
    whole = backend.draw(cut, model.take, large, Style())
    assert frame.starved.any()
    assert (frame.splats, frame.clouds) == (whole.splats, whole.clouds)
    for row in range(35):
        for column in range(41):
            box = np.s_[row * finer : (row + 1) * finer, column * finer : (column + 1) * finer]
            light = to_linear(whole.rgb[box]).mean(axis=(0, 1))
            assert np.abs(frame.rgb[row, column] - to_levels(light)).max() <= 0.51
            nearest = np.unravel_index(np.argmin(whole.depth[box]), (finer, finer))
            assert frame.depth[row, column] == whole.depth[box][nearest]
            assert frame.node[row, column] == whole.node[box][nearest]
            assert frame.starved[row, column] == whole.starved[box][nearest]


def test_a_tall_picture_is_shrunk_in_parts():
    rgb = np.random.default_rng(0).integers(0, 256, (2 * antialias.ROWS * 2 + 6, 4, 3), dtype=np.uint8)
    light = to_linear(rgb).reshape(-1, 2, 2, 2, 3).mean(axis=(1, 3))
    assert np.abs(antialias.shrink(rgb, 2) - to_levels(light)).max() <= 0.51
