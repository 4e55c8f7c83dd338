"""The camera against hand-computed values and a plain 4x4 pipeline."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import models

from lpc.errors import FormatError
from pointview.camera import Camera

VIEW = {"eye": [0, 0, 10], "target": [0, 0, 0], "up": [0, 1, 0], "fov_y": 90}


def vectors(limit: float) -> st.SearchStrategy[tuple[float, float, float]]:
    return st.tuples(*[st.floats(-limit, limit, allow_nan=False, width=32)] * 3)


def test_a_view_by_hand():
    camera = Camera.from_view(VIEW, width=200, height=100)
    assert camera.focal == pytest.approx(50)
    pixel, depth = camera.project([[0, 0, 0], [1, 2, 0], [-20, 10, 0]])
    np.testing.assert_allclose(pixel, [[100, 50], [105, 40], [0, 0]], atol=1e-9)
    np.testing.assert_allclose(depth, [10, 10, 10])


def test_view_and_back():
    camera = Camera.from_view(VIEW, width=3, height=2)
    assert Camera.from_view(camera.to_view(), width=3, height=2) == camera


def clip_coordinates(camera: Camera, point: tuple[float, float, float]) -> np.ndarray:
    """What OpenGL's look-at and perspective matrices make of a point, (4,)."""
    near, far = 0.01, 1000.0
    view = np.eye(4)
    view[:3, :3] = camera.rotation() * np.array([[1.0], [1.0], [-1.0]])
    view[:3, 3] = -view[:3, :3] @ np.array(camera.eye)
    tall = 1 / math.tan(math.radians(camera.fov_y) / 2)
    projection = np.array(
        [
            [tall * camera.height / camera.width, 0, 0, 0],
            [0, tall, 0, 0],
            [0, 0, (far + near) / (near - far), 2 * far * near / (near - far)],
            [0, 0, -1, 0],
        ]
    )
    return projection @ view @ np.array([*point, 1.0])


@given(vectors(100), vectors(100), vectors(100), st.floats(5, 150), vectors(50))
def test_projecting_agrees_with_matrices(eye, target, up, fov_y, point):
    if math.dist(eye, target) < 1e-3 or math.hypot(*up) < 1e-3:
        return
    camera = Camera(eye=eye, target=target, up=up, fov_y=fov_y, width=640, height=360)
    rotation = camera.rotation()
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(-1)  # right, up and *forward*: depth grows away from the eye
    pixel, depth = camera.project([point])
    if depth[0] < 0.01:
        return
    clip = clip_coordinates(camera, point)
    assert clip[3] == pytest.approx(depth[0], rel=1e-9, abs=1e-9)
    x, y = clip[0] / clip[3], clip[1] / clip[3]
    np.testing.assert_allclose(pixel[0], [(x + 1) * 320, (1 - y) * 180], rtol=1e-7, atol=1e-5)


@given(vectors(20), st.floats(0.01, 5))
def test_planes_never_cut_off_what_is_in_the_picture(center, radius):
    camera = Camera(eye=(3, -4, 5), target=(0, 1, 0), up=(0, 0, 1), fov_y=50, width=300, height=200)
    outside = (camera.frustum_planes() @ (np.array(center) - camera.eye) < -radius).any()
    rng = np.random.default_rng(0)
    inside = rng.normal(size=(200, 3))
    inside *= radius * rng.random((200, 1)) ** (1 / 3) / np.linalg.norm(inside, axis=1, keepdims=True)
    pixel, depth = camera.project(np.array(center) + inside)
    seen = (depth > 0) & (pixel > 0).all(axis=1) & (pixel < [300, 200]).all(axis=1)
    assert not (outside and seen.any())


@pytest.mark.parametrize("crs", [None, "a place"])
@pytest.mark.parametrize("size", [(400, 100), (100, 400)])
def test_the_default_view_frames_the_whole_model(crs, size):
    model = models.sphere(600, crs=crs, at=(5e5, 6e6, 100.0), radius=40.0)
    camera = Camera.frame_model(model.header, width=size[0], height=size[1])
    direction = (np.array(camera.target) - camera.eye) / math.dist(camera.target, camera.eye)
    np.testing.assert_allclose(direction, [0, 0, -1] if crs is None else [0, -1, 0], atol=1e-9)
    assert camera.up == ((0, 1, 0) if crs is None else (0, 0, 1))
    low, high = np.array(model.header.bounds).reshape(2, 3)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    pixel, depth = camera.project(corners)
    assert (depth > 0).all()
    assert (pixel >= 0).all()
    assert (pixel <= size).all()
    used = (pixel.max(axis=0) - pixel.min(axis=0)) / size
    assert used.max() > 0.9


def test_a_model_of_one_place_can_be_framed():
    camera = Camera.frame_box([6e6] * 6, backward=(0, 0, 1), up=(0, 1, 0), width=10, height=10)
    assert math.dist(camera.eye, camera.target) > 0


def test_up_along_the_view_is_replaced():
    camera = Camera(eye=(0, 0, 5), target=(0, 0, 0), up=(0, 0, 1))
    np.testing.assert_allclose(camera.rotation() @ camera.rotation().T, np.eye(3), atol=1e-12)


def test_depth_range_holds_the_spheres():
    camera = Camera(eye=(0, 0, 0), target=(1, 0, 0), up=(0, 0, 1))
    near, far = camera.depth_range(np.array([[10.0, 3, 0], [50.0, 0, 0]]), np.array([1.0, 2.0]))
    assert 8.9 < near <= 9
    assert 52 <= far < 52.1
    near, far = camera.depth_range(np.array([[0.0, 0, 0], [1e9, 0, 0]]), np.array([1.0, 2.0]))
    assert 0 < near < far
    near, far = camera.depth_range(np.array([[-10.0, 0, 0]]), np.array([1.0]))
    assert 0 < near < far


@pytest.mark.parametrize(
    "broken",
    [
        {"eye": None}, {"eye": [0, 0]}, {"eye": [0, 0, "a"]}, {"eye": [0, 0, math.nan]}, {"target": [0, 0, 10]},
        {"up": [0, 0, 0]}, {"fov_y": 0}, {"fov_y": 180}, {"fov_y": "wide"}, {"fov_y": True}, {"eye": [True, 0, 0]},
        {"eye": [1e400, 0, 0]},
    ],
)  # fmt: skip
def test_what_is_no_view_is_refused(broken):
    with pytest.raises(FormatError, match="view"):
        Camera.from_view({**VIEW, **broken}, width=10, height=10)


@pytest.mark.parametrize("view", [[], "text", 3, None])
def test_a_view_is_an_object(view):
    with pytest.raises(FormatError, match="view"):
        Camera.from_view(view, width=10, height=10)
