"""Blended pictures: against the definition, and what they must show."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from oracles import blending as oracle
from oracles import surfaces
from support import models, placed

from lpc.octahedral import decode_normals
from lpc.points import PointBatch
from pointview import splats
from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style, blend_kernels, blending, shading, tables
from pointview.render.cpu import CpuBackend

BLENDED = Style(splat="blended", edl_strength=0.0)
DISCS = Style(edl_strength=0.0)


def camera_at(eye, *, target=(0.0, 0.0, 0.0), width=70, height=60, fov_y=45.0):
    return Camera(eye=eye, target=target, up=(0, 0, 1), fov_y=fov_y, width=width, height=height)


def draw(model, camera, style, *, tolerance=1.0, resident=None, threads=1):
    here = model.everything if resident is None else resident
    cut = refine(model.index, camera, tolerance, here, cull_backfaces=not style.two_sided)
    return CpuBackend(model.header, threads=threads).draw(cut, model.take, camera, style)


def lit(albedo, normal, inside):
    """Levels of a sample as `shading` has it; camera space."""
    lamp, toward_eye = shading.lamp(), -inside / np.linalg.norm(inside)
    toward = normal @ lamp
    mirror = 2 * toward * (normal @ toward_eye) - lamp @ toward_eye if toward > 0 else 0.0
    shine = shading.SPECULAR * max(mirror, 0.0) ** shading.SHININESS
    return np.minimum(albedo * (shading.AMBIENT + shading.DIFFUSE * max(toward, 0.0)) + 255 * shine, 255)


def samples_of(model, cut, camera):
    """What the oracle blends: (center, plane's normal, side of the splat, lit levels), camera space."""
    walk, found = placed.Walk(model, cut, camera), []
    for number in cut.nodes.tolist():
        xyz, codes = model.positions(number), model.clouds[number].codes
        inside, (_, depth) = camera.to_camera(xyz), camera.project(xyz)
        spacings = walk.of_samples(number) if cut.places is not None else np.full(len(xyz), walk.spacing[number])
        normals = decode_normals(codes["normal"], 8).astype(float) if "normal" in codes else np.zeros(xyz.shape)
        colors = codes["color"] if "color" in codes else np.full(xyz.shape, Style().surface)
        for i in range(len(xyz)):
            if depth[i] <= cut.depth_range[0] or normals[i] @ (xyz[i] - camera.eye) > 0:
                continue
            side = min(splats.CLOSING * spacings[i] * camera.focal / depth[i], splats.LARGEST)
            plane, levels = np.array([0.0, 0.0, -1.0]), colors[i].astype(float)
            if normals[i].any():
                normal = camera.rotation() @ normals[i]
                normal /= np.linalg.norm(normal)
                levels = lit(levels, normal, inside[i])
                toward = -inside[i] / np.linalg.norm(inside[i])
                plane = normal + max(splats.STEEPEST - normal @ toward, 0) * toward
                plane /= np.linalg.norm(plane)
            elif model.header.attributes and "normal" in codes:
                levels = levels * shading.UNLIT
            found.append((inside[i], plane, side, np.floor(levels + 0.5)))
    return found


@pytest.mark.parametrize(
    ("eye", "tolerance"), [((0, -3, 1), 1.0), ((0, -3, 1), 12.0), ((0.2, -30, 3), 1.0), ((0, -1.3, 0.1), 4.0)]
)
def test_agrees_with_the_definition(eye, tolerance):
    model, camera = models.sphere(700, cloud_size=100, color=True), camera_at(eye)
    cut = refine(model.index, camera, tolerance, model.everything)
    backend = CpuBackend(model.header)
    discs, frame = (backend.draw(cut, model.take, camera, style) for style in (DISCS, BLENDED))
    expected = oracle.blend(discs.rgb, discs.depth.astype(float), samples_of(model, cut, camera), camera.focal)
    covered = discs.node >= 0
    assert covered.sum() > 4
    off = np.abs(frame.rgb - expected).max(axis=2)
    # Whether a sample at the end of its kernel or slack counts may fall either way in float32.
    assert (off > 1.0).sum() <= 0.01 * covered.sum()
    assert (off[~covered] == 0).all()


@pytest.mark.parametrize("normals", [True, False])
def test_only_colours_differ_from_the_picture_of_discs(normals):
    model, camera = models.torus(6000, color=True, normals=normals), camera_at((1, -2.5, 2), width=120, height=90)
    resident = model.first(20)
    discs, frame = (draw(model, camera, style, resident=resident) for style in (Style(), Style(splat="blended")))
    for name in ("depth", "node", "starved"):
        np.testing.assert_array_equal(getattr(frame, name), getattr(discs, name))
    assert frame.starved.any()
    assert (frame.rgb != discs.rgb).any(axis=2)[frame.node >= 0].mean() > 0.1
    np.testing.assert_array_equal(frame.rgb[frame.node < 0], discs.rgb[frame.node < 0])


@pytest.mark.parametrize("chunk", [1 << 20, 700])
def test_the_picture_does_not_depend_on_threads_or_chunks(chunk, monkeypatch):
    model, camera = models.torus(6000, color=True), camera_at((1, -2.5, 2), width=120, height=90)
    expected = draw(model, camera, BLENDED)
    monkeypatch.setattr(blending, "CHUNK", chunk)
    for threads in (1, 2, 3, 97):
        np.testing.assert_array_equal(draw(model, camera, BLENDED, threads=threads).rgb, expected.rgb)


def test_one_colour_stays_that_colour():
    points = surfaces.sphere(3000, normals=False)
    model = models.build(PointBatch(points.xyz, {"color": np.full((3000, 3), [200, 100, 3], np.uint8)}), 0.065)
    for eye in ((0, -3, 1), (0, -0.4, 0), (0, -400, 0)):
        frame = draw(model, camera_at(eye), BLENDED)
        assert (frame.node >= 0).any()
        assert np.abs(frame.rgb[frame.node >= 0].astype(int) - [200, 100, 3]).max() <= 1


def test_far_away_a_pixel_shows_the_mean_of_what_is_in_it():
    rng = np.random.default_rng(0)
    xyz = np.stack([rng.uniform(-1, 1, 40_000), np.zeros(40_000), rng.uniform(-1, 1, 40_000)], axis=1)
    white = rng.random(40_000) < 0.5
    points = PointBatch(xyz, {"color": np.where(white[:, None], 255, 0).astype(np.uint8) * np.ones(3, np.uint8)})
    model = models.build(points, 0.01, cloud_size=1024)
    camera = camera_at((0, -40, 0), width=60, height=60)
    frame, discs = (draw(model, camera, style, tolerance=0.01) for style in (BLENDED, DISCS))
    inside = frame.rgb[29:31, 29:31, 0].astype(float)
    assert set(np.unique(discs.rgb[29:31, 29:31])) <= {0, 255}
    # 6,000 samples a pixel, half of them white: half the light is level 188, half the level is not.
    assert np.abs(inside - 188).max() < 3


def test_what_is_behind_does_not_shine_through():
    rng = np.random.default_rng(1)
    xyz = np.stack([rng.uniform(-1, 1, 8000), np.repeat([0.0, 0.5], 4000), rng.uniform(-1, 1, 8000)], axis=1)
    colors = np.where(np.arange(8000)[:, None] < 4000, [255, 0, 0], [0, 0, 255]).astype(np.uint8)
    model = models.build(PointBatch(xyz, {"color": colors}), 0.03)
    frame = draw(model, camera_at((0, -3, 0)), BLENDED)
    front = np.isfinite(frame.depth) & (frame.depth < 3.1)
    assert front.sum() > 500
    assert (frame.rgb[front] == [255, 0, 0]).all()


@pytest.mark.parametrize("normals", ["none", "zero"])
@pytest.mark.parametrize("count", [1, 7])
def test_few_samples_and_none_that_face_anywhere(normals, count):
    rng = np.random.default_rng(2)
    attributes = {"normal": np.zeros((count, 3), np.float32)} if normals == "zero" else {}
    model = models.build(PointBatch(rng.uniform(-0.1, 0.1, (count, 3)), attributes), 0.1)
    for eye in ((0, -3, 0.1), (0, -0.2, 0), (0, -1e5, 0)):
        frame = draw(model, camera_at(eye), BLENDED)
        surface = np.array(Style().surface) * (shading.UNLIT if normals == "zero" else 1.0)
        shown = frame.rgb[frame.node >= 0].astype(float)
        assert np.abs(shown - surface).max(initial=0) <= 1
        assert len(shown) or abs(eye[1]) < 1


def test_inside_a_model_and_with_wide_angles():
    model = models.torus(6000, color=True)
    for fov_y in (45.0, 150.0):
        camera = camera_at((1.0, 0.02, 0.03), target=(1.0, 1.0, 0.2), fov_y=fov_y)
        frame = draw(model, camera, Style(splat="blended", two_sided=True))
        assert (frame.node >= 0).mean() > 0.9


def numbers(low, high):
    return st.floats(low, high, width=32, allow_nan=False)


anywhere = st.tuples(
    numbers(-100, 100), numbers(-100, 100), numbers(2.0**-20, 1000.0),
    st.tuples(numbers(-1, 1), numbers(-1, 1), numbers(-1, 1)), st.sampled_from([1e-30, 1e-6, 0.5, 2.0, 37.0, 160.0]),
    st.tuples(numbers(0, 1), numbers(0, 1), numbers(0, 1)),
)  # fmt: skip


@settings(max_examples=200, deadline=None)
@example([(0.0, 100.0, 2.0**-20, (0.0, 1.0, 0.0), 37.0, (0.0, 0.0, 0.0))], 3.0)
@given(st.lists(anywhere, min_size=1, max_size=6), numbers(2.0**-20, 2000.0))
def test_no_sample_makes_a_colour_that_is_none(found, front):
    samples = np.zeros(len(found), dtype=tables.SAMPLE)
    for sample, (right, up, depth, normal, side, color) in zip(samples, found, strict=True):
        sample["right"], sample["up"], sample["depth"], sample["side"] = right, up, depth, side
        length = np.linalg.norm(normal)
        sample["nx"], sample["ny"], sample["nz"] = normal / length if length > 1e-3 else (0, 0, -1)
        sample["red"], sample["green"], sample["blue"] = color
    depth = np.full((9, 11), front, dtype=np.float32)
    depth[:, 3] = np.inf
    sums = np.zeros((9, 11, 4), dtype=np.float32)
    kernel = blending.kernel(focal=12.0)
    blend_kernels.gather(sums, samples, depth, 0, 9, kernel)
    assert np.isfinite(sums).all()
    assert (sums >= 0).all()
    assert (sums[:, 3] == 0).all()
    reached = sums[..., 3] > blending.LEAST
    means = sums[reached, :3] / sums[reached, 3:]
    colors = np.array([one[5] for one in found])
    assert (means <= colors.max(axis=0) + 1e-4).all()
    assert (means >= colors.min(axis=0) - 1e-4).all()
    rgb = np.full((9, 11, 3), 77, dtype=np.uint8)
    blend_kernels.mean(rgb, sums, 0, 9, blending.LEAST)
    assert (rgb[~reached] == 77).all()
    expected = oracle.to_levels(means.astype(float))
    assert np.abs(rgb[reached] - expected).max(initial=0) <= 0.51
