"""The compiled splatter against a slow painter, and the pictures it must give."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support import models, placed

from lpc.octahedral import decode_normals
from pointview import splats
from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style, open_backend, shading
from pointview.render.cpu import CpuBackend
from pointview.render.picture import YELLOW, save_picture, tint_starved


def camera_at(eye, *, target=(0.0, 0.0, 0.0), width=90, height=70):
    return Camera(eye=eye, target=target, up=(0, 0, 1), fov_y=45.0, width=width, height=height)


def paint(model, cut, camera, *, cull, splat):
    """Depth and node of the foremost splat at every pixel centre, sample by sample in float64; and where two tie."""
    depth = np.full((camera.height, camera.width), np.inf)
    front = depth.copy()  # depth with the bulge
    node = np.full(depth.shape, -1)
    tied = np.zeros(depth.shape, dtype=bool)
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    ray = np.stack([(column - camera.width / 2), (camera.height / 2 - row)], axis=-1) / camera.focal
    ray = np.concatenate([ray, np.ones((*depth.shape, 1))], axis=-1)
    walk = placed.Walk(model, cut, camera)
    for number in cut.nodes.tolist():
        xyz = model.positions(number)
        pixel, z = camera.project(xyz)
        inside = camera.to_camera(xyz)
        spacings = walk.of_samples(number) if cut.places is not None else np.full(len(xyz), walk.spacing[number])
        normals = decode_normals(model.clouds[number].codes["normal"], 8).astype(float)
        for i in range(len(xyz)):
            if z[i] <= 0 or (cull and normals[i] @ (xyz[i] - camera.eye) > 0):
                continue
            side = min(splats.CLOSING * spacings[i] * camera.focal / z[i], splats.LARGEST)
            dx, dy = column - pixel[i, 0], row - pixel[i, 1]
            here = behind = np.full(depth.shape, z[i])
            if side <= 1:
                covered = (np.floor(column) == math.floor(pixel[i, 0])) & (np.floor(row) == math.floor(pixel[i, 1]))
            elif side <= splats.ROUND_FROM or splat == "square":
                covered = (np.abs(dx) <= side / 2) & (np.abs(dy) <= side / 2)
            else:
                radius = side * splats.ROUND / 2 * z[i] / camera.focal
                if splat == "disc":
                    toward = -inside[i] / np.linalg.norm(inside[i])
                    plane = camera.rotation() @ normals[i]
                    plane *= np.sign(plane @ toward) / np.linalg.norm(plane)
                    plane = plane + max(splats.STEEPEST - plane @ toward, 0) * toward
                    here = (plane @ inside[i]) / (ray @ plane)
                    apart = np.linalg.norm(here[..., None] * ray - inside[i], axis=-1)
                else:
                    apart = np.hypot(dx, dy) * z[i] / camera.focal
                covered = (apart <= radius) & (here > 0)
                behind = here + splats.BULGE * apart**2 / radius
            nearer = covered & (behind < front)
            tied[nearer] = False
            tied |= covered & (np.abs(behind - np.where(np.isfinite(front), front, -1)) < 1e-4 * behind)
            front[nearer], depth[nearer], node[nearer] = behind[nearer], here[nearer], number
    return depth, node, tied


@pytest.mark.parametrize(
    ("eye", "tolerance"), [((0, -3, 1), 1.0), ((0, -3, 1), 12.0), ((0.2, -12, 3), 1.0), ((0, -0.5, 0.1), 4.0)]
)
@pytest.mark.parametrize(("cull", "splat"), [(True, "disc"), (False, "disc"), (False, "round"), (True, "square")])
def test_agrees_with_the_painter(eye, tolerance, cull, splat):
    model = models.sphere(1500, cloud_size=100)
    camera = camera_at(eye)
    style = Style(two_sided=not cull, splat=splat, close_holes=False)
    cut = refine(model.index, camera, tolerance, model.everything, cull_backfaces=cull)
    frame = CpuBackend(model.header).draw(cut, model.take, camera, style)
    depth, node, tied = paint(model, cut, camera, cull=cull, splat=splat)
    different = np.isfinite(depth) != np.isfinite(frame.depth)
    both = np.isfinite(depth) & np.isfinite(frame.depth) & ~tied
    assert both.sum() > 100 or (cull and math.hypot(*eye) < 1)
    # A pixel centre on a splat's rim may fall either way in float32.
    assert different.mean() < 0.003
    assert (np.abs(depth[both] - frame.depth[both]) > 1e-5 * depth[both]).sum() <= 0.003 * depth.size
    assert (node != frame.node)[~tied].mean() < 0.003
    assert (frame.splats, frame.clouds) == (cut.splats, len(cut.nodes))
    assert (frame.rgb[frame.node < 0] == Style().background).all()


def test_holes_are_closed_by_the_wall_around_them_and_nothing_else_is():
    model = models.sphere(3000, cloud_size=100)
    camera = camera_at((0, -3, 1), width=120, height=120)
    cut = refine(model.index, camera, 1.0, model.everything)
    cut = replace(cut, spacing=cut.spacing * 0.6, places=None)  # too small to close the surface
    backend = CpuBackend(model.header)
    before = backend.draw(cut, model.take, camera, Style(close_holes=False))
    after = backend.draw(cut, model.take, camera, Style())
    changed = np.argwhere((before.node != after.node) | (before.depth != after.depth))
    assert len(changed) > 50
    kept = np.ones(before.node.shape, dtype=bool)
    kept[tuple(changed.T)] = False
    np.testing.assert_array_equal(before.rgb[kept], after.rgb[kept])
    side = splats.CLOSING * cut.spacing.max() * camera.focal / before.depth.min()
    for row, column in changed:
        walls, nearest = 0, []
        for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            for step in range(1, math.ceil(splats.HOLE * side) + 1):
                y, x = row + step * dy, column + step * dx
                if 0 <= y < 120 and 0 <= x < 120 and before.depth[y, x] < before.depth[row, column]:
                    walls += 1
                    nearest.append(before.depth[y, x])
                    break
        assert walls >= splats.WALLS
        assert after.depth[row, column] in nearest
        assert after.depth[row, column] < before.depth[row, column]


@pytest.mark.parametrize("normals", [True, False])
def test_the_picture_does_not_depend_on_threads_or_on_what_is_in_memory(normals):
    model = models.torus(6000, color=True, normals=normals)
    camera = camera_at((1, -2.5, 2), width=200, height=150)
    cut = refine(model.index, camera, 1.0, model.everything)
    frames = []
    for threads in (1, 2, 3):
        backend = open_backend("cpu", model.header, threads=threads)
        frames.append(backend.draw(cut, model.take, camera, Style()))
        model.taken.clear()
        frames.append(backend.draw(cut, model.take, camera, Style()))
        assert model.taken == []  # the backend keeps what it was given
        backend.close()
    assert [frame.uploads > 0 for frame in frames] == [True, False] * 3
    for frame in frames[1:]:
        np.testing.assert_array_equal(frame.rgb, frames[0].rgb)
        np.testing.assert_array_equal(frame.depth, frames[0].depth)
        np.testing.assert_array_equal(frame.node, frames[0].node)


def test_an_arena_that_must_grow_or_evict_gives_the_same_picture(monkeypatch):
    model = models.torus(6000, cloud_size=64)
    monkeypatch.setattr("pointview.render.cpu.FIRST_SAMPLES", 256)
    backend = CpuBackend(model.header)
    for eye in ((1, -2.5, 2), (0, 4, 0.5), (1, -2.5, 2), (1.2, 0.1, 0.1)):
        camera = camera_at(eye)
        for tolerance in (20.0, 1.0):
            cut = refine(model.index, camera, tolerance, model.everything)
            fresh = CpuBackend(model.header).draw(cut, model.take, camera, Style())
            np.testing.assert_array_equal(backend.draw(cut, model.take, camera, Style()).rgb, fresh.rgb)


def test_a_cloud_that_cannot_be_taken_leaves_the_backend_usable():
    model = models.torus(3000, cloud_size=64)
    camera = camera_at((1, -2.5, 2))
    cut = refine(model.index, camera, 1.0, model.everything)
    backend = CpuBackend(model.header)

    def broken(node):
        if node == cut.nodes[5]:
            raise OSError("gone")
        return model.take(node)

    with pytest.raises(OSError, match="gone"):
        backend.draw(cut, broken, camera, Style())
    fresh = CpuBackend(model.header).draw(cut, model.take, camera, Style())
    np.testing.assert_array_equal(backend.draw(cut, model.take, camera, Style()).rgb, fresh.rgb)


def test_an_empty_cut_is_background():
    model = models.torus(300)
    camera = camera_at((0, -4, 0), target=(0, -8, 0))
    cut = refine(model.index, camera, 1.0, model.everything)
    assert len(cut.nodes) == 0
    frame = open_backend("cpu", model.header, threads=2).draw(cut, model.take, camera, Style(background=(1, 2, 3)))
    assert (frame.rgb == [1, 2, 3]).all()
    assert np.isinf(frame.depth).all()
    assert (frame.splats, frame.clouds) == (0, 0)


def test_light_falls_from_the_upper_left_and_faces_are_seen():
    model = models.sphere(20_000)
    camera = camera_at((0, -4, 0), width=101, height=101)
    cut = refine(model.index, camera, 1.0, model.everything)
    frame = CpuBackend(model.header).draw(cut, model.take, camera, Style())
    grey = frame.rgb.astype(int).sum(axis=2)
    seen = np.isfinite(frame.depth)
    row, column = np.nonzero(seen & (grey == grey[seen].max()))
    assert row.mean() < 50
    assert column.mean() < 50
    assert grey[30, 30] > grey[70, 70]
    exact = 4 - math.sqrt(1 - 0.0)
    assert frame.depth[50, 50] == pytest.approx(exact, abs=0.03)


def test_inward_normals_show_nothing_one_sided_and_the_same_light_two_sided():
    outward = models.sphere(8000)
    inward = models.sphere(8000)
    for cloud in inward.clouds:
        flipped = -decode_normals(cloud.codes["normal"], 8)
        from lpc.octahedral import encode_normals

        cloud.codes["normal"][:] = encode_normals(flipped, 8)  # type: ignore[index]
    camera = camera_at((0, -3, 1), width=64, height=64)
    cut = refine(outward.index, camera, 4.0, outward.everything, cull_backfaces=False)
    shown = CpuBackend(outward.header).draw(cut, outward.take, camera, Style(two_sided=True))
    turned = CpuBackend(inward.header).draw(cut, inward.take, camera, Style(two_sided=True))
    np.testing.assert_array_equal(shown.node >= 0, turned.node >= 0)
    seen = shown.node >= 0
    assert (np.abs(shown.depth[seen] - turned.depth[seen]) > 1e-5 * shown.depth[seen]).mean() < 0.02
    assert (np.abs(shown.rgb.astype(int) - turned.rgb) > 2).mean() < 0.02
    one_sided = CpuBackend(inward.header).draw(cut, inward.take, camera, Style())
    nearest = CpuBackend(outward.header).draw(cut, outward.take, camera, Style())
    assert np.median(one_sided.depth[one_sided.node >= 0]) > np.median(nearest.depth[nearest.node >= 0]) + 0.5


def test_colours_are_the_samples():
    model = models.sphere(8000, color=True, normals=False)
    camera = camera_at((0.5, -3, 1), width=64, height=64)
    cut = refine(model.index, camera, 1.0, model.everything)
    frame = CpuBackend(model.header).draw(cut, model.take, camera, Style(edl_strength=0.0))
    colors = {tuple(color) for color in frame.rgb[frame.node >= 0].tolist()}
    assert colors == {(230, 60, 40), (40, 90, 220)}


def test_eye_dome_lighting_follows_its_formula():
    model = models.torus(8000, normals=False)
    camera = camera_at((1, -2.5, 2), width=60, height=50)
    cut = replace(refine(model.index, camera, 1.0, model.everything), places=None)
    backend = CpuBackend(model.header)
    plain = backend.draw(cut, model.take, camera, Style(edl_strength=0.0)).rgb
    frame = backend.draw(cut, model.take, camera, Style(edl_strength=0.4))
    spacing = dict(zip(cut.nodes.tolist(), cut.spacing.tolist(), strict=True))
    for row, column in np.argwhere(frame.node >= 0):
        here = float(frame.depth[row, column])
        side = splats.CLOSING * spacing[frame.node[row, column]] * camera.focal / here
        # The side is that of the sample, at the depth of its centre: a little nearer or farther than the pixel's.
        around = {max(int(shading.NEIGHBOUR * side * factor + 0.5), 1) for factor in (0.9, 1.0, 1.1)}
        found = []
        for away in around:
            total = 0.0
            for y, x in ((row + i * away, column + j * away) for i in (-1, 0, 1) for j in (-1, 0, 1)):
                if 0 <= y < 50 and 0 <= x < 60 and frame.node[y, x] >= 0:
                    total += max(0.0, math.log(here) - math.log(frame.depth[y, x]))
            shade = math.exp(-0.4 * camera.focal * total / (8 * away))
            found.append(plain[row, column] * (shading.DARKEST + (1 - shading.DARKEST) * shade))
        assert min(np.abs(frame.rgb[row, column] - expected).max() for expected in found) <= 1
    assert frame.rgb[frame.node >= 0].mean() < plain[frame.node >= 0].mean()


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (512_345.0, 6_012_345.0, 123.0)])
def test_survey_coordinates_do_not_jitter(at):
    """1 mm detail at 6,000,000 m: the same millimetres under the eye, wherever the model stands."""
    model = models.sphere(3000, radius=0.05, at=at)
    eye = (at[0], at[1] - 0.12, at[2])
    camera = camera_at(eye, target=at, width=200, height=200)
    cut = refine(model.index, camera, 1.0, model.everything, cull_backfaces=False)
    frame = CpuBackend(model.header).draw(cut, model.take, camera, Style(splat="round"))
    z = np.concatenate([camera.project(model.positions(node))[1] for node in cut.nodes.tolist()])
    drawn = np.unique(frame.depth[frame.node >= 0].astype(np.float64))
    nearest = np.abs(np.sort(z)[np.clip(np.searchsorted(np.sort(z), drawn), 1, len(z) - 1)] - drawn)
    nearest = np.minimum(
        nearest, np.abs(np.sort(z)[np.clip(np.searchsorted(np.sort(z), drawn) - 1, 0, len(z) - 1)] - drawn)
    )
    assert nearest.max() < 2e-8


def test_starved_pixels_are_tinted(tmp_path):
    model = models.torus(6000)
    camera = camera_at((1, -2.5, 2), width=120, height=90)
    cut = refine(model.index, camera, 1.0, model.first(6))
    frame = CpuBackend(model.header).draw(cut, model.take, camera, Style())
    where = frame.starved
    walk = placed.Walk(model, cut, camera)
    one_way = {node: found[1] for node in cut.nodes.tolist() if (found := walk.deepest_everywhere(node))}
    known = np.isin(frame.node, list(one_way))
    np.testing.assert_array_equal(where[known], [one_way[node] for node in frame.node[known].tolist()])
    assert not where[frame.node < 0].any()
    assert where.any()
    twin = tint_starved(frame)
    np.testing.assert_array_equal(twin[~where], frame.rgb[~where])
    np.testing.assert_allclose(twin[where], (frame.rgb[where] + np.array(YELLOW)) / 2, atol=0.51)
    full = refine(model.index, camera, 1.0, model.everything)
    whole = CpuBackend(model.header).draw(full, model.take, camera, Style())
    assert not whole.starved.any()
    from PIL import Image

    save_picture(twin, tmp_path / "twin.png")
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "twin.png")), twin)
