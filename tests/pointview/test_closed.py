"""Closed surfaces look closed, at every cut and wherever data is missing; against the analytic surface."""

from __future__ import annotations

import numpy as np
import pytest
from support import models

from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style
from pointview.render.cpu import CpuBackend

SIZE = 240


def trace(distance, camera):
    """Depth of the surface `distance(xyz) == 0` at each pixel, by sphere tracing; infinite where it is missed."""
    row, column = np.mgrid[0 : camera.height, 0 : camera.width]
    ray = np.stack(
        [
            (column + 0.5 - camera.width / 2) / camera.focal,
            (camera.height / 2 - row - 0.5) / camera.focal,
            np.ones(row.shape),
        ],
        axis=-1,
    )
    length = np.linalg.norm(ray, axis=-1)
    ray = (ray / length[..., None]) @ camera.rotation()
    along = np.zeros(row.shape)
    for _ in range(120):
        left = distance(np.array(camera.eye) + along[..., None] * ray)
        along = np.minimum(along + left, 50.0)
    return np.where(np.abs(left) < 1e-4, along / length, np.inf)


def sphere_distance(xyz):
    return np.linalg.norm(xyz, axis=-1) - 1


def torus_distance(xyz):
    ring = np.hypot(xyz[..., 0], xyz[..., 1]) - models.TORUS[0]
    return np.hypot(ring, xyz[..., 2]) - models.TORUS[1]


@pytest.fixture(scope="module", params=["sphere", "torus"])
def scene(request):
    if request.param == "sphere":
        model, distance = models.sphere(60_000, cloud_size=512), sphere_distance
    else:
        model, distance = models.torus(60_000, cloud_size=512), torus_distance
    camera = Camera(eye=(0.8, -2.4, 1.6), target=(0, 0, 0), up=(0, 0, 1), width=SIZE, height=SIZE)
    return model, camera, trace(distance, camera)


def residents(model):
    rng = np.random.default_rng(5)
    yield 1.0, model.everything
    yield 4.0, model.everything
    yield 9.0, model.everything
    for nodes in (1, 4, 20, 60):
        yield 1.0, model.first(nodes)
    scattered = rng.random(model.header.nodes) < 0.7
    scattered[0] = True
    yield 1.0, scattered


@pytest.mark.parametrize("one_sided", [True, False])
def test_no_holes(scene, one_sided):
    model, camera, exact = scene
    inside = np.isfinite(exact)
    backend = CpuBackend(model.header)
    shares = []
    for tolerance, resident in residents(model):
        cut = refine(model.index, camera, tolerance, resident, cull_backfaces=one_sided)
        frame = backend.draw(cut, model.take, camera, Style(two_sided=not one_sided))
        # Background, or something well behind the surface that should hide it.
        hole = inside & ~(frame.depth < exact + 0.3 + 1.5 * cut.spacing.max())
        shares.append(hole.sum() / inside.sum())
        # Sampling is random: of the few hundred splats of a first cloud one hole may be a hundred pixels.
        assert shares[-1] <= (0.0005 if cut.splats > 10_000 else 0.005), (tolerance, len(cut.nodes))
    assert np.mean(shares) <= 0.0005


def test_no_needless_fat(scene):
    model, camera, exact = scene
    inside = np.isfinite(exact)
    rim = inside & ~(np.roll(inside, 1, 0) & np.roll(inside, -1, 0) & np.roll(inside, 1, 1) & np.roll(inside, -1, 1))
    backend = CpuBackend(model.header)
    for tolerance, resident in residents(model):
        cut = refine(model.index, camera, tolerance, resident)
        frame = backend.draw(cut, model.take, camera, Style())
        grown = (np.isfinite(frame.depth) & ~inside).sum() / rim.sum()
        assert grown < 0.5 * max(1.0, cut.max_spacing_px), (tolerance, len(cut.nodes))
