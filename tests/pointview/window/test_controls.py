"""Camera motions: what they promise holds for any camera, as pure functions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointview.camera import Camera
from pointview.window import controls
from pointview.window.controls import Viewpoint
from pointview.window.inputs import AXES, KEYS, Inputs, Scene, moved

coordinates = st.floats(-50, 50)
points = st.tuples(coordinates, coordinates, coordinates)
offsets = st.sampled_from([0.0, 1e3, 6e6])  # survey coordinates keep their millimetres
angles = st.floats(-3, 3)
BOUNDS = (-3.0, -2.0, -1.0, 3.0, 2.0, 1.0)


@st.composite
def viewpoints(draw):
    shift = np.array([draw(offsets)] * 3)
    eye, target, pivot = (np.array(draw(points)) for _ in range(3))
    up = draw(st.sampled_from([(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)]))
    if math.dist(eye, target) < 0.1:
        target = eye + np.array([1.0, 2.0, 3.0])
    camera = Camera(
        eye=tuple((eye + shift).tolist()),
        target=tuple((target + shift).tolist()),
        up=up,
        fov_y=draw(st.floats(20, 90)),
        width=draw(st.integers(50, 2000)),
        height=draw(st.integers(50, 2000)),
    )
    return Viewpoint(camera=camera, pivot=tuple((pivot + shift).tolist()))


def near(view):
    return 1e-9 * max(1.0, *(abs(value) for value in view.camera.eye)) * 50


def steep(view, margin=0.1):
    """Whether the camera looks along the vertical, where the turntable stops."""
    forward = view.camera.rotation()[2]
    return abs(forward @ np.array(view.camera.up)) > math.cos(margin)


@given(view=viewpoints(), yaw=angles, pitch=angles)
def test_orbit_keeps_the_distance_to_the_pivot_and_the_horizon(view, yaw, pitch):
    after = controls.orbit(view, yaw, pitch)
    distance = math.dist(view.camera.eye, view.pivot)
    assert math.dist(after.camera.eye, after.pivot) == pytest.approx(distance, abs=near(view))
    right, _, forward = after.camera.rotation()
    vertical = np.array(view.camera.up)
    assert abs(right @ vertical) < 1e-6
    assert math.radians(0.5) < math.acos(np.clip(forward @ vertical, -1, 1)) < math.pi - math.radians(0.5)


@given(view=viewpoints(), yaw=angles, pitch=st.floats(-0.5, 0.5))
def test_orbit_keeps_the_pivot_at_its_pixel(view, yaw, pitch):
    if steep(view):
        return
    before = view.camera.to_camera([view.pivot])[0]
    after = controls.orbit(view, yaw, pitch).camera.to_camera([view.pivot])[0]
    np.testing.assert_allclose(after, before, atol=1e3 * near(view))


@given(view=viewpoints(), yaw=st.floats(-1, 1))
def test_orbit_back_is_where_it_was(view, yaw):
    if steep(view):
        return
    back = controls.orbit(controls.orbit(view, yaw, 0.0), -yaw, 0.0)
    np.testing.assert_allclose(back.camera.eye, view.camera.eye, atol=10 * near(view))


def test_orbiting_up_raises_the_eye_and_right_moves_it_right():
    view = Viewpoint.of(Camera(eye=(0, -5, 0), target=(0, 0, 0), up=(0, 0, 1)))
    assert controls.orbit(view, 0.0, 0.3).camera.eye[2] > 1
    assert controls.orbit(view, 0.3, 0.0).camera.eye[0] > 1


@given(
    view=viewpoints(),
    at=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    depth=st.floats(0.1, 200),
    factor=st.floats(0.2, 4),
)
def test_zoom_keeps_the_point_under_the_cursor(view, at, depth, factor):
    x, y = at[0] * view.camera.width, at[1] * view.camera.height
    anchor = controls.unproject(view.camera, x, y, depth)
    after = controls.zoom(view, factor, anchor)
    (pixel,), (now,) = after.camera.project([anchor])
    assert now == pytest.approx(depth * factor, rel=1e-6, abs=near(view))
    np.testing.assert_allclose(pixel, (x, y), atol=1e-3 + near(view) * view.camera.focal / min(now, 1.0))


def test_zoom_stops_before_the_point():
    view = Viewpoint.of(Camera(eye=(0, 0, 1), target=(0, 0, 0), up=(0, 1, 0)))
    for _ in range(300):
        view = controls.zoom(view, 0.8, (0, 0, 0), closest=0.01)
    assert 0.01 <= view.camera.eye[2] < 0.02
    assert controls.zoom(view, 2.0, (0, 0, 0), closest=1e9).camera.eye[2] > 0.02


@given(view=viewpoints(), dx=st.floats(-300, 300), dy=st.floats(-300, 300))
def test_pan_moves_the_pivots_plane_with_the_hand(view, dx, dy):
    (pixel,), (depth,) = view.camera.project([view.pivot])
    if depth < 0.5 or steep(view, 1e-3):
        return
    (after,), _ = controls.pan(view, dx, dy).camera.project([view.pivot])
    scale = near(view) * view.camera.focal / depth
    np.testing.assert_allclose(after - pixel, (dx, dy), atol=1e-3 + scale + 1e-6 * abs(pixel).max())


@given(view=viewpoints(), yaw=angles, pitch=angles)
def test_looking_around_leaves_the_eye(view, yaw, pitch):
    assert controls.look_around(view, yaw, pitch).camera.eye == view.camera.eye


def test_flying_goes_where_it_looks_and_leaves_the_pivot():
    view = Viewpoint.of(Camera(eye=(0, -5, 0), target=(0, 0, 0), up=(0, 0, 1)))
    after = controls.travel(view, 1.0, 2.0, 3.0)
    np.testing.assert_allclose(after.camera.eye, (1, -2, 2), atol=1e-12)
    assert after.pivot == view.pivot


@given(view=viewpoints(), x=st.floats(0, 1), y=st.floats(0, 1), depth=st.floats(0.1, 100))
def test_unproject_is_the_inverse_of_project(view, x, y, depth):
    x, y = x * view.camera.width, y * view.camera.height
    (pixel,), (found,) = view.camera.project([controls.unproject(view.camera, x, y, depth)])
    assert found == pytest.approx(depth, rel=1e-6, abs=near(view))
    np.testing.assert_allclose(pixel, (x, y), atol=1e-3 + near(view) * view.camera.focal / min(depth, 1.0))


@given(seed=st.integers(0, 500), x=st.floats(-20, 60), y=st.floats(-20, 60), reach=st.integers(0, 15))
def test_pick_finds_the_nearest_drawn_pixel(seed, x, y, reach):
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((40, 50)) < 0.004, rng.random((40, 50)) + 1, np.inf).astype(np.float32)
    camera = Camera(eye=(0, 0, 5), target=(0, 0, 0), up=(0, 1, 0), width=50, height=40)
    found = controls.pick(depth, camera, x, y, reach=reach)
    drawn = [
        ((c - int(x)) ** 2 + (r - int(y)) ** 2, r, c)
        for r, c in np.argwhere(np.isfinite(depth)).tolist()
        if abs(c - int(x)) <= reach and abs(r - int(y)) <= reach
    ]
    if not drawn:
        assert found is None
        return
    (pixel,), (at,) = camera.project([found])
    row, column = int(pixel[1]), int(pixel[0])
    assert at == pytest.approx(float(depth[row, column]), rel=1e-5)
    assert (column - int(x)) ** 2 + (row - int(y)) ** 2 == min(drawn)[0]


@pytest.mark.parametrize("vertical", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])
@pytest.mark.parametrize("axis", AXES.values())
def test_axis_views_frame_the_box_from_their_side(axis, vertical):
    view = Viewpoint.of(Camera(eye=(9, 9, 9), target=(0, 0, 0), up=vertical, width=300, height=200))
    after = controls.axis_view(view, BOUNDS, axis, vertical).camera
    corners = np.array(np.meshgrid((-3, 3), (-2, 2), (-1, 1))).reshape(3, 8).T
    pixel, depth = after.project(corners)
    assert (depth > 0).all()
    assert (pixel >= 0).all()
    assert (pixel <= (300, 200)).all()
    backward, up = controls.axis_directions(axis, vertical)
    assert -after.rotation()[2] @ np.array(backward) > 0.999
    assert after.rotation()[1] @ np.array(up) > 0.999
    assert after.up == vertical


def test_opposite_axis_views_are_opposite():
    for one, other in (("front", "back"), ("left", "right"), ("top", "bottom")):
        for vertical in ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)):
            towards, away = (np.array(controls.axis_directions(axis, vertical)[0]) for axis in (one, other))
            np.testing.assert_array_equal(towards, -away)


@given(view=viewpoints())
def test_fit_keeps_the_direction_and_shows_the_box(view):
    if steep(view, 1e-3):
        return
    after = controls.fit(view, BOUNDS).camera
    np.testing.assert_allclose(after.rotation()[2], view.camera.rotation()[2], atol=1e-6)
    pixel, depth = after.project(np.array(np.meshgrid((-3, 3), (-2, 2), (-1, 1))).reshape(3, 8).T)
    assert (depth > 0).all()
    assert (pixel >= -1).all()
    assert (pixel <= np.array([after.width, after.height]) + 1).all()


@pytest.fixture
def scene():
    home = Camera(eye=(0, -10, 0), target=(0, 0, 0), up=(0, 0, 1), width=200, height=100)
    depth = np.full((100, 200), np.inf, dtype=np.float32)
    depth[40:60, 80:120] = 9.0
    return Scene(bounds=BOUNDS, vertical=(0, 0, 1), home=home, depth=depth, shot=home)


def did(**changes):
    return replace(Inputs(seconds=0.1, size=(200, 100)), **changes)


def after(scene, fly=False, **changes):
    return moved(Viewpoint.of(scene.home), did(**changes), scene, fly=fly, speed=0.5)


def test_nothing_done_changes_nothing(scene):
    assert after(scene) == Viewpoint.of(scene.home)


def test_a_double_click_picks_the_pivot_from_the_depth_and_leaves_the_picture(scene):
    view = after(scene, picked=True, cursor=(100, 50))
    assert view.camera == scene.home
    assert view.pivot[1] == pytest.approx(-1.0)
    assert after(scene, picked=True, cursor=(5, 5)).pivot == scene.home.target


def test_the_wheel_zooms_towards_what_is_under_the_cursor(scene):
    view = after(scene, wheel=1.0, cursor=(110, 45))
    point = scene.pick(110, 45)
    assert math.dist(view.camera.eye, point) == pytest.approx(0.85 * math.dist(scene.home.eye, point))
    assert after(scene, wheel=-1.0, cursor=(5, 5)).camera.eye[1] < -10


def test_dragging_right_turns_the_model_right(scene):
    """The nearest point of the model follows the hand."""
    view = after(scene, turned=(10.0, 0.0))
    (pixel,), _ = view.camera.project([(0, -2, 0)])
    assert pixel[0] > 100
    assert after(scene, fly=True, turned=(10.0, 0.0)).camera.eye == scene.home.eye


def test_keys_fly_jump_and_return(scene):
    assert after(scene, held=frozenset("w")).camera.eye[1] > -10
    fast, slow = (after(scene, held=frozenset({"w", *more})).camera.eye[1] for more in (("shift",), ()))
    assert (fast + 10) == pytest.approx(4 * (slow + 10))
    assert after(scene, held=frozenset("ws")).camera == scene.home
    top = moved(Viewpoint.of(scene.home), did(pressed=frozenset("5")), scene, fly=False, speed=0.5)
    assert top.camera.eye[2] > 3
    assert moved(top, did(pressed=frozenset({"home"})), scene, fly=False, speed=0.5).camera == scene.home


def test_another_window_size_is_the_cameras(scene):
    camera = after(scene, size=(333, 222)).camera
    assert (camera.width, camera.height, camera.eye) == (333, 222, scene.home.eye)


def test_every_key_is_in_the_help():
    text = " ".join(key for key, _ in KEYS)
    for key in ("W A S D", "F1", "Home", "1 ... 6", "wheel", "double click", "Ctrl V"):
        assert key in text
