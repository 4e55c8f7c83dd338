"""Pixels that are passed over in the search for holes are in none."""

from __future__ import annotations

import numpy as np
import pytest

from pointview import splats
from pointview.render import picture_kernels


@pytest.mark.parametrize("largest", [1, 2, 5, 40])
def test_every_hole_is_found(monkeypatch, largest):
    rng = np.random.default_rng(largest)
    found = 0
    for covered in (0.3, 0.6, 0.9):
        shape = (37, 23)  # more rows than are looked through at a time
        depth = np.where(rng.random(shape) < covered, rng.choice([1.0, 1.1, 2.0], shape), np.inf).astype(np.float32)
        side = (rng.random(shape) * largest).astype(np.float32)
        options = (2, 36, 50.0, splats.HOLE, largest, splats.WALLS, splats.FACES, splats.FACE)
        holes, sources, slow_holes, slow_sources = np.zeros((4, depth.size), dtype=np.int32)
        count = picture_kernels.close_holes(depth, side, holes, sources, *options)
        with monkeypatch.context() as patch:
            patch.setattr(picture_kernels, "_between_walls", lambda deep, *_: deep.fill(-np.inf))  # passes over none
            assert picture_kernels.close_holes.py_func(depth, side, slow_holes, slow_sources, *options) == count
        np.testing.assert_array_equal(holes, slow_holes)
        np.testing.assert_array_equal(sources, slow_sources)
        found += count
    assert found > 0
