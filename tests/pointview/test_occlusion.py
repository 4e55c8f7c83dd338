"""What is hidden is left out, nothing else is, and culling stops where it does not pay."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import surfaces
from support import models, placed

from lpc.points import PointBatch
from pointview.camera import Camera
from pointview.occlusion import KEPT, PAUSE, TRIAL, Occlusion
from pointview.refine import refine
from pointview.render import Style
from pointview.render.cpu import CpuBackend
from pointview.render.seen import pixels_by_cell

STYLE = Style(two_sided=True)


@pytest.fixture(scope="module")
def onion():
    """Five spheres in one another: from outside only the largest is seen."""
    shells = [surfaces.sphere(6000, seed=number, radius=1 - 0.15 * number) for number in range(5)]
    points = PointBatch(
        np.concatenate([shell.xyz for shell in shells]),
        {"normal": np.concatenate([shell.normal for shell in shells])},
    )
    return models.build(points, 0.035, cloud_size=128)


def camera_at(eye, target=(0.0, 0.0, 0.0)):
    return Camera(eye=eye, target=target, up=(0, 0, 1), width=200, height=200)


class Viewer:
    """A frame loop: what each frame drew, with at most one third pass."""

    def __init__(self, model):
        self.model, self.backend = model, CpuBackend(model.header)
        self.occlusion = Occlusion(model.header.nodes)

    def cut(self, camera, *, culled=True, resident=None, tolerance=3.0):
        resident = self.model.everything if resident is None else resident
        hidden = self.occlusion.hidden if culled else None
        return refine(self.model.index, camera, tolerance, resident, cull_backfaces=False, hidden=hidden)

    def draw(self, cut, camera):
        return self.backend.draw(cut, self.model.take, camera, STYLE)

    def frame(self, camera, **options):
        cut = self.cut(camera, **options)
        frame = self.draw(cut, camera)
        if self.occlusion.look(self.model.index, cut, camera, frame):
            cut = self.cut(camera, **options)
            frame = self.draw(cut, camera)
        return cut, frame


def difference(frame, other):
    covered = (frame.node >= 0) | (other.node >= 0)
    return (frame.rgb != other.rgb).any(axis=2)[covered].mean()


def test_pixels_are_counted_in_the_cells_around_them(onion):
    viewer, camera = Viewer(onion), camera_at((0.4, -2.5, 1.0))
    cut = viewer.cut(camera, culled=False)
    frame = viewer.draw(cut, camera)
    counts = pixels_by_cell(frame.depth, cut, camera)
    row, column = np.nonzero(np.isfinite(frame.depth))
    ray = np.stack([(column + 0.5 - 100) / camera.focal, (100 - row - 0.5) / camera.focal, np.ones(len(row))], axis=1)
    at = np.array(camera.eye) + (ray * frame.depth[row, column, None].astype(float)) @ camera.rotation()
    for number in (0, 1, 5, len(cut.nodes) - 1):
        box, axis = placed.cell_of(onion.header, placed.path_of(onion.index, int(cut.nodes[number])))
        on_edge = (np.abs(at[:, None] - box) < 1e-5).any(axis=(1, 2))
        first = np.isclose(box[0], onion.header.bounds[:3])
        last = np.isclose(box[1], onion.header.bounds[3:])
        inside = (((at >= box[0]) | first) & ((at < box[1]) | last)).all(axis=1)
        upper = at[:, axis] >= box[:, axis].mean()
        expected = [(inside & ~upper).sum(), (inside & upper).sum()]
        np.testing.assert_allclose(counts[number], expected, atol=on_edge.sum() + 3)


def test_a_part_of_the_pixels_counts_as_many_for_each_cell(onion):
    viewer, camera = Viewer(onion), camera_at((0.4, -2.5, 1.0))
    cut = viewer.cut(camera, culled=False)
    frame = viewer.draw(cut, camera)
    every, quarter = (pixels_by_cell(frame.depth, cut, camera, stride=stride) for stride in (1, 2))
    large = every > 400
    np.testing.assert_allclose(4 * quarter[large], every[large], rtol=0.15)
    assert (quarter[every == 0] == 0).mean() > 0.99


def test_a_fine_picture_is_tried_although_a_coarse_one_hid_nothing():
    model = models.sphere(6000, cloud_size=64)
    viewer, camera = Viewer(model), camera_at((0, -3, 0))
    backend = CpuBackend(model.header)
    for tolerance in (9.0, 2.0):
        for _ in range(2 * TRIAL + KEPT):
            cut = refine(model.index, camera, tolerance, model.everything, hidden=viewer.occlusion.hidden)
            viewer.occlusion.look(model.index, cut, camera, backend.draw(cut, model.take, camera, STYLE))
            if viewer.occlusion.verdict is not None:
                break
        assert viewer.occlusion.verdict is not None
        fine = refine(model.index, camera, 2.0, model.everything, cull_backfaces=False)
        viewer.occlusion.look(model.index, fine, camera, backend.draw(fine, model.take, camera, STYLE))
        assert (viewer.occlusion.verdict is None) == (tolerance == 9.0)


def test_hidden_nodes_are_left_out_and_the_picture_stays(onion):
    viewer, camera = Viewer(onion), camera_at((0.4, -2.5, 1.0))
    full = viewer.cut(camera, culled=False)
    expected = viewer.draw(full, camera)
    for _ in range(2 * KEPT + 2):
        cut, frame = viewer.frame(camera)
    assert cut.splats < 0.5 * full.splats
    assert cut.culled.occluded > 0
    assert difference(frame, expected) < 0.002
    assert viewer.occlusion.verdict is None
    again, _ = viewer.frame(camera)
    assert again.nodes.tolist() == cut.nodes.tolist()


def test_a_still_camera_comes_to_rest(onion):
    """What is revealed under a still camera stays: nothing comes and goes for ever, from whatever side."""
    for eye in ((0.4, -2.5, 1.0), (1.9, 0.7, -0.4), (-1.0, 1.2, 1.9), (0.2, 1.3, 0.1)):
        viewer, camera = Viewer(onion), camera_at(eye)
        for _ in range(12):
            viewer.frame(camera)
        hidden = viewer.occlusion.hidden.copy()
        for _ in range(4):
            viewer.frame(camera)
            assert np.array_equal(viewer.occlusion.hidden, hidden)


def test_hidden_nodes_are_not_wanted(onion):
    viewer, camera = Viewer(onion), camera_at((0.4, -2.5, 1.0))
    for nodes in (1, 8, 30, 60, 100, 140, onion.header.nodes):
        for _ in range(KEPT):
            viewer.frame(camera, resident=onion.first(nodes))
    few = viewer.cut(camera, resident=onion.first(30))
    many = viewer.cut(camera, resident=onion.first(30), culled=False)
    assert set(few.wants.tolist()) < set(many.wants.tolist())
    assert not viewer.occlusion.hidden[few.wants].any()


def test_a_moving_camera_sees_what_was_hidden(onion):
    viewer = Viewer(onion)
    worst = 0.0
    for step in range(24):
        angle = np.radians(15 * step)
        # Round the model, and then into it.
        away = 2.5 if step < 16 else 2.5 - 0.2 * (step - 15)
        camera = camera_at((away * np.sin(angle), -away * np.cos(angle), 0.3))
        _, frame = viewer.frame(camera)
        worst = max(worst, difference(frame, viewer.draw(viewer.cut(camera, culled=False), camera)))
    assert worst < 0.005


def test_culling_stops_where_it_does_not_pay_and_says_so():
    model = models.sphere(6000, cloud_size=64)
    viewer, camera = Viewer(model), camera_at((0, -3, 0))
    looks = 0
    while viewer.occlusion.verdict is None:
        cut = refine(model.index, camera, 2.0, model.everything, hidden=viewer.occlusion.hidden)
        viewer.occlusion.look(model.index, cut, camera, viewer.draw(cut, camera))
        looks += 1
        assert looks <= TRIAL + KEPT
    assert "paused" in viewer.occlusion.verdict
    assert not viewer.occlusion.hidden.any()
    for _ in range(PAUSE):
        assert viewer.occlusion.verdict is not None
        viewer.occlusion.look(model.index, cut, camera, viewer.draw(cut, camera))
    assert viewer.occlusion.verdict is None


def test_nothing_is_known_of_what_the_frustum_left_out(onion):
    viewer = Viewer(onion)
    for _ in range(KEPT + 3):
        viewer.frame(camera_at((0.4, -2.5, 1.0), target=(0.9, 0.0, 0.6)))
    camera = camera_at((0.4, -2.5, 1.0))
    _, frame = viewer.frame(camera)
    assert difference(frame, viewer.draw(viewer.cut(camera, culled=False), camera)) < 0.005
