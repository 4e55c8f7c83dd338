"""What is asked for first: the order of the wants follows what each cloud takes from the picture's error."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from oracles import surfaces
from support import models

from lpc.points import PointBatch
from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style
from pointview.render.cpu import CpuBackend
from pointview.render.seen import contrast_by_cell
from pointview.urgency import INSIDE, Contrast, expected, extent, removed_per_byte

STYLE = Style(two_sided=True)


@pytest.fixture(scope="module")
def halves():
    """A sphere, painted with a pattern where x > 0, plain elsewhere; a smaller one inside is never seen."""
    outer, inner = surfaces.sphere(12_000, seed=1), surfaces.sphere(4_000, seed=2, radius=0.6)
    xyz, normal = np.concatenate([outer.xyz, inner.xyz]), np.concatenate([outer.normal, inner.normal])
    dark = (np.floor(xyz * 7).sum(axis=1) % 2 > 0) & (xyz[:, 0] > 0)
    color = np.where(dark[:, None], 20, 200).astype(np.uint8).repeat(3, axis=1)
    return models.build(PointBatch(xyz, {"normal": normal, "color": color}), 0.035, cloud_size=128)


def camera_at(eye, target=(0.0, 0.0, 0.0)):
    return Camera(eye=eye, target=target, up=(0, 0, 1), width=200, height=160)


def look(model, camera, resident, *, tolerance=1.0, stride=1):
    """What the picture of the resident clouds shows, and the wants in the order that follows."""
    cut = refine(model.index, camera, tolerance, resident, cull_backfaces=False)
    backend = CpuBackend(model.header)
    frame = backend.draw(cut, model.take, camera, STYLE)
    contrast = Contrast(model.header.nodes)
    contrast.look(model.index, cut, camera, frame, stride=stride)
    return cut, frame, contrast.shown


def test_contrast_is_summed_up_in_the_cells_that_the_pixels_show(halves):
    """By hand for the two halves of the root: pixels by place, their differences by shifting the picture."""
    camera = camera_at((0.3, -3.0, 0.8))
    cut, frame, _ = look(halves, camera, halves.everything, tolerance=2.0)
    sums = contrast_by_cell(frame, cut, camera, reach=0.0)
    rgb, (height, width) = frame.rgb.astype(float), frame.depth.shape
    total, count = np.zeros((height, width)), np.zeros((height, width))
    for rows, columns in (((1, 0), (0, 0)), ((0, 1), (0, 0)), ((0, 0), (1, 0)), ((0, 0), (0, 1))):
        here = (slice(rows[0], height - rows[1]), slice(columns[0], width - columns[1]))
        there = (slice(rows[1], height - rows[0]), slice(columns[1], width - columns[0]))
        total[here] += ((rgb[here] - rgb[there]) ** 2).sum(axis=2)
        count[here] += 1
    covered = frame.node >= 0
    np.testing.assert_allclose(sums[0].sum(), (total / count)[covered].sum(), rtol=1e-9)
    drawn = np.searchsorted(cut.nodes, halves.index.children[0])
    np.testing.assert_allclose(sums[0], sums[drawn].sum(axis=1), rtol=1e-9)


def test_a_part_of_the_pixels_tells_nearly_as_much(halves):
    camera = camera_at((0.3, -3.0, 0.8))
    resident = halves.first(30)
    every, quarter = (look(halves, camera, resident, stride=stride)[2] for stride in (1, 2))
    large = every > np.nanmax(every) / 10
    np.testing.assert_allclose(quarter[large], every[large], rtol=0.3)


def test_what_the_picture_shows_in_blots_comes_first(halves):
    """Both sides of the sphere are seen alike and as coarse: the painted one is more wrong."""
    camera, resident = camera_at((0.0, -3.0, 0.0)), halves.first(16)
    cut, _, shown = look(halves, camera, resident)
    order = refine(halves.index, camera, 1.0, resident, cull_backfaces=False, priority="error", contrast=shown).wants
    assert sorted(order.tolist()) == sorted(cut.wants.tolist())
    front = order[halves.index.center[order][:, 1] < -0.3]
    place = halves.index.center[front][:, 0]
    first = len(front) // 3
    assert (place[:first] > 0).mean() > 0.8
    assert (place[-first:] < 0).mean() > 0.8


def test_what_is_behind_comes_last(halves):
    """The inner sphere and the far side fill as large a disc as what is in front of them."""
    camera, resident = camera_at((0.0, -3.0, 0.0)), halves.first(24)
    _, _, shown = look(halves, camera, resident)
    order = refine(halves.index, camera, 1.0, resident, cull_backfaces=False, priority="error", contrast=shown).wants
    far = halves.index.center[order][:, 1] > 0.4
    assert far.any()
    assert np.flatnonzero(far).mean() > 1.5 * np.flatnonzero(~far).mean()


def test_the_order_is_by_contrast_fall_of_spacing_and_bytes(halves):
    """The formula again, a node at a time, for cells that the picture shows."""
    camera, resident, index = camera_at((0.4, -2.5, 0.8)), halves.first(20), halves.index
    cut, _, shown = look(halves, camera, resident)
    nodes = cut.wants[shown[cut.wants] > 0]
    assert len(nodes) > 8
    removed = removed_per_byte(index, camera, 1.0, nodes, shown)
    for node, value in zip(nodes.tolist(), removed.tolist(), strict=True):
        gap = math.dist(index.center[node], camera.eye) - index.radius[node]
        scale = camera.focal / max(gap, INSIDE * index.radius[node])
        before = index.density.coarseness[index.parent[node]] * scale
        after = max(index.density.coarseness[node] * scale, 0.5)
        assert value == pytest.approx(shown[node] * max(1 - after / before, 0) / index.size[node], rel=1e-6)


def test_what_no_picture_showed_takes_its_part_of_the_cell_around_it(halves):
    camera, index = camera_at((0.4, -2.5, 0.8)), halves.index
    resident = halves.first(8)
    _, _, shown = look(halves, camera, resident)
    later = refine(index, camera, 1.0, halves.first(30), cull_backfaces=False).wants
    later = later[np.isnan(shown[later])]
    assert len(later) > 8
    for node, value in zip(later.tolist(), expected(index, camera, later, shown).tolist(), strict=True):
        around = node
        while np.isnan(shown[around]):
            around = int(index.parent[around])
        both = extent(index, camera, np.array([node, around]))
        if shown[around] > 0:
            assert value >= shown[around] * both[0] / both[1] * (1 - 1e-9)


def test_what_is_outside_the_window_is_not_said_to_be_plain(halves):
    """A turned camera finds there what is usual elsewhere."""
    camera, resident, index = camera_at((0.0, -2.0, 0.0), target=(2.0, 0.0, 0.0)), halves.first(40), halves.index
    _, _, shown = look(halves, camera, resident)
    known = np.flatnonzero(index.known)
    outside = known[extent(index, camera, known) == 0]
    assert len(outside) > 0
    assert np.isnan(shown[outside]).all()
    turned = replace(camera, target=(-2.0, 0.0, 0.0))
    wants = refine(index, turned, 1.0, resident, cull_backfaces=False).wants
    assert (expected(index, turned, wants, shown) > 0).all()


def test_an_eye_among_the_samples_still_tells_clouds_apart(halves):
    """Where spheres hold the eye, the nearest point of each is at it: as coarse as can be, before and after."""
    camera, resident = camera_at((0.0, 0.0, 0.0), target=(1.0, 0.2, 0.0)), halves.first(20)
    wants = refine(halves.index, camera, 1.0, resident, cull_backfaces=False).wants
    removed = removed_per_byte(halves.index, camera, 1.0, wants, None)
    assert np.isfinite(removed).all()
    assert (removed > 0).mean() > 0.9


def test_before_the_first_picture_the_window_decides(halves):
    camera, resident = camera_at((1.6, -1.6, 0.0), target=(1.0, -0.2, 0.0)), halves.first(20)
    wants = refine(halves.index, camera, 1.0, resident, cull_backfaces=False).wants
    removed = removed_per_byte(halves.index, camera, 1.0, wants, None)
    seen = extent(halves.index, camera, wants)
    assert ((removed > 0) <= (seen > 0)).all()
    contrast = Contrast(halves.header.nodes)
    assert np.isnan(contrast.shown).all()
    np.testing.assert_array_equal(removed_per_byte(halves.index, camera, 1.0, wants, contrast.shown) > 0, removed > 0)
