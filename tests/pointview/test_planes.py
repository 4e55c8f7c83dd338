"""Planes of samples without normals: right where there is a surface, none where there is not."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import surfaces
from support import models

from lpc.octahedral import decode_normals
from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style
from pointview.render.cpu import CpuBackend
from pointview.render.planes import FEWEST, planes


def lattice(xyz):
    """Positions as a cloud has them."""
    low = xyz.min(axis=0)
    return np.rint((xyz - low) * (65_000 / np.ptp(xyz, axis=0).max())).astype(np.uint16)


def directions(codes):
    return decode_normals(np.stack([codes & 0xFF, codes >> 8], axis=1).astype(np.uint8))


def lean(codes, normals):
    """Angles between the planes found and the true ones, degrees."""
    found = codes > 0
    return np.degrees(np.arccos(np.minimum(np.abs((directions(codes) * normals).sum(axis=1))[found], 1.0)))


@pytest.mark.parametrize("surface", [surfaces.sphere, surfaces.torus])
@pytest.mark.parametrize("samples", [300, 2000])
def test_planes_of_a_surface(surface, samples):
    points = surface(samples, seed=3)
    codes = planes(lattice(points.xyz))
    assert np.count_nonzero(codes) > (0.97 if samples == 2000 else 0.8) * samples
    assert np.percentile(lean(codes, points.attributes["normal"]), 90) < (16 if samples == 2000 else 40)


def test_order_and_axes_do_not_matter():
    points = surfaces.torus(1500, seed=1)
    position, turn = lattice(points.xyz), np.random.default_rng(0).permutation(1500)
    np.testing.assert_array_equal(planes(position)[turn], planes(np.ascontiguousarray(position[turn])))
    assert (
        np.median(lean(planes(np.ascontiguousarray(position[:, [2, 0, 1]])), points.attributes["normal"][:, [2, 0, 1]]))
        < 9
    )


def test_strays_have_no_plane_and_take_none_from_the_others():
    points = surfaces.sphere(2000, seed=2)
    strays = np.array([[90.0, 0, 0], [0, -70.0, 3], [1, 2, 80.0]])
    codes = planes(lattice(np.concatenate([points.xyz, strays])))
    assert not codes[2000:].any()
    assert np.count_nonzero(codes[:2000]) > 1900
    assert np.percentile(lean(codes[:2000], points.attributes["normal"]), 90) < 15


def test_a_thin_end_is_found_too():
    """A hundred times fewer samples at one end: larger cells are tried there."""
    points = surfaces.sphere(60_000, seed=4)
    keep = np.random.default_rng(1).random(60_000) < 0.08 * 10.0 ** np.clip(points.xyz[:, 0] - 1, -2, 0)
    codes = planes(lattice(points.xyz[keep]))
    thin = points.xyz[keep, 0] < -0.7
    assert 10 < thin.sum() < 100
    assert np.count_nonzero(codes[thin]) > 0.6 * thin.sum()
    assert np.median(lean(codes, points.attributes["normal"][keep])) < 8


@pytest.mark.parametrize(
    "xyz",
    [
        np.zeros((50, 3)),
        np.linspace(0, 60_000, 400)[:, None] * np.ones(3),
        np.random.default_rng(0).uniform(0, 60_000, (FEWEST - 1, 3)),
        np.empty((0, 3)),
    ],
    ids=["one place", "a line", "too few", "none"],
)
def test_no_plane(xyz):
    assert not planes(xyz.astype(np.uint16)).any()


def test_a_cloud_of_volume_has_fewer_planes():
    inside = np.random.default_rng(5).uniform(0, 65_000, (2000, 3)).astype(np.uint16)
    assert np.count_nonzero(planes(inside)) < 800


def test_planes_shape_splats_but_light_and_cull_nothing():
    """Without normals both sides of a surface stay, and what is seen is as bright as it was."""
    bare = models.torus(8000, cloud_size=512, normals=False)
    camera = Camera(eye=(0.5, -2.0, 3.0), target=(0, 0, 0), up=(0, 0, 1), width=160, height=120)
    cut = refine(bare.index, camera, 4.0, bare.everything)
    backend = CpuBackend(bare.header)
    style = Style(edl_strength=0.0, surface=(200, 100, 50))
    frame = backend.draw(cut, bare.take, camera, style)
    np.testing.assert_array_equal(np.unique(frame.rgb[frame.node >= 0], axis=0), [[200, 100, 50]])
    behind = Camera(eye=(0.5, -0.9, 0.1), target=(1.1, 0.6, 0), up=(0, 0, 1), width=160, height=120)
    inside = backend.draw(refine(bare.index, behind, 4.0, bare.everything), bare.take, behind, style)
    assert (inside.node >= 0).mean() > 0.9
