"""What the benchmark of aliasing compares with: the surfaces that it samples, and their pictures."""

from __future__ import annotations

import aliasing
import numpy as np
import pytest

from pointview.camera import Camera


@pytest.mark.parametrize("surface", aliasing.SURFACES, ids=lambda surface: surface.name)
def test_samples_lie_on_the_surface_evenly(surface):
    xyz = surface.sample(40_000)
    assert np.abs(surface.value(xyz)).max() < 1e-9
    normal = surface.normal(xyz)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-6)
    # Area seen along an axis, from the front: the mean of |n . axis| over samples that are even by area is that of the
    # silhouette over half the area, the same along all axes of a surface that is the same along them.
    shadows = np.abs(normal).mean(axis=0)
    assert np.ptp(shadows) < 0.01
    octants = np.bincount((xyz > 0) @ [1, 2, 4], minlength=8) / len(xyz)
    assert np.abs(octants - 1 / 8).max() < 0.01


def test_values_are_no_more_than_distances():
    surface = aliasing.SURFACES[-1]
    rng = np.random.default_rng(0)
    on = surface.sample(20_000)
    away = rng.normal(size=(300, 3)) * 0.6
    nearest = np.sqrt(((away[:, None] - on[None]) ** 2).sum(axis=2).min(axis=1))
    assert (np.abs(surface.value(away)) <= nearest + 1e-6).all()


def test_the_reference_is_the_mean_of_rays():
    surface = aliasing.SURFACES[1]
    camera = Camera(eye=(0, -40, 0), target=(0, 0, 0), up=(0, 0, 1), width=9, height=9)
    picture, covered = aliasing.traced_picture(surface, camera)
    assert covered[4, 4] == pytest.approx(np.pi * (camera.focal / 40) ** 2, rel=0.1)
    assert covered[0].max() == 0
    np.testing.assert_allclose(picture[0], np.broadcast_to(aliasing.PLAIN.background, (9, 3)), atol=1e-4)


def test_equal_pictures_have_no_error_and_a_shift_is_an_error_of_all():
    rng = np.random.default_rng(0)
    truth = [(rng.uniform(0, 200, (20, 20, 3)), np.ones((20, 20)))] * 2
    assert min(aliasing.compare([truth[0][0], truth[1][0]], truth)) > 200
    off = [truth[0][0] + 25.5, truth[1][0] + 25.5]
    inside, everywhere, change = aliasing.compare(off, truth)
    assert inside == pytest.approx(20.0)
    assert everywhere == pytest.approx(20.0)
    assert change > 200
