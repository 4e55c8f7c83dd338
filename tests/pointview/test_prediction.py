"""Motions that are known for all time, seen for a moment: the prediction goes on as they do."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import models

from pointview.camera import Camera
from pointview.lookahead import Lookahead, LookaheadOptions
from pointview.prediction import Motion, MotionOptions, carry_on
from pointview.refine import refine

FRAME = 1 / 30


def vectors(limit: float) -> st.SearchStrategy[tuple[float, float, float]]:
    return st.tuples(*[st.floats(-limit, limit, allow_nan=False, width=32)] * 3)


@st.composite
def cameras(draw: st.DrawFn, far: float = 1e3) -> Camera:
    eye, target, up = draw(vectors(far)), draw(vectors(far)), draw(vectors(1))
    assume(math.dist(eye, target) > 1e-2 * far)
    forward = np.subtract(target, eye) / math.dist(eye, target)
    assume(np.linalg.norm(np.cross(forward, up)) > 0.1)
    return Camera(eye=eye, target=target, up=up, width=64, height=48)


def turned(camera: Camera, center: object, turn: Rotation, *, shift: object = 0.0, grown: float = 1.0) -> Camera:
    """The camera carried along when all of space turns around a centre, grows from it, and shifts."""

    def move(point: object) -> tuple[float, ...]:
        return tuple(np.asarray(center) + grown * turn.apply(np.subtract(point, center)) + shift)

    return replace(camera, eye=move(camera.eye), target=move(camera.target), up=tuple(turn.apply(camera.up)))


def check_same(a: Camera | None, b: Camera, *, within: float = 1e-6) -> None:
    """Same eye, axes and distance."""
    assert a is not None
    reach = math.dist(b.eye, b.target) + math.dist(a.eye, a.target)
    size = within * (reach + max(map(abs, (*b.eye, *b.target))) * 1e-6)
    np.testing.assert_allclose(a.eye, b.eye, atol=size)
    np.testing.assert_allclose(a.target, b.target, atol=size)
    np.testing.assert_allclose(a.rotation(), b.rotation(), atol=10 * within)


steps = st.floats(-3.0, 10.0)


@given(cameras(), vectors(1e3), vectors(1), st.floats(1e-4, 0.25), steps)
def test_an_orbit_goes_on_around_its_centre(camera, center, axis, angle, further):
    assume(np.linalg.norm(axis) > 0.1)
    axis = np.array(axis) / np.linalg.norm(axis)
    assume(math.dist(center, camera.eye) < 10 * math.dist(camera.eye, camera.target))
    after = [turned(camera, center, Rotation.from_rotvec(axis * angle * k)) for k in (1.0, 1.0 + further)]
    check_same(carry_on(camera, after[0], further), after[1])


@given(cameras(), vectors(1), vectors(3), st.floats(-0.2, 0.2), st.floats(0.8, 1.25), steps)
def test_any_screw_and_zoom_repeats_itself(camera, axis, shift, angle, grown, further):
    """Whole steps by doing the motion again; the rest by halves: two halves make a whole."""
    assume(np.linalg.norm(axis) > 0.1)
    turn = Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle)
    seen = [camera]
    for _ in range(5):
        seen.append(turned(seen[-1], (1.0, 2.0, 3.0), turn, shift=shift, grown=grown))
    assume(math.dist(seen[0].eye, seen[1].eye) > 1e-3)
    for k in (1, 2, 4):
        check_same(carry_on(seen[0], seen[1], k), seen[1 + k])
        check_same(carry_on(seen[0], seen[1], -k / 2.0), carry_on(seen[1], seen[0], k / 2.0 - 1.0))
    check_same(carry_on(seen[0], seen[1], -1.0), seen[0])
    check_same(carry_on(seen[0], seen[2], further / 2), carry_on(carry_on(seen[0], seen[1], 0.0), seen[2], further))


@given(cameras(), vectors(100), steps)
def test_a_flight_goes_on_along_its_line(camera, velocity, further):
    assume(np.linalg.norm(velocity) > 1e-3)
    after = [turned(camera, (0, 0, 0), Rotation.identity(), shift=np.array(velocity) * k) for k in (1.0, 1.0 + further)]
    check_same(carry_on(camera, after[0], further), after[1])


@given(cameras(), vectors(1), st.floats(-0.3, 0.3), steps)
def test_a_head_that_turns_stays_where_it_is(camera, axis, angle, further):
    assume(np.linalg.norm(axis) > 0.1)
    assume(abs(angle) > 1e-6)
    axis = np.array(axis) / np.linalg.norm(axis)
    after = [turned(camera, camera.eye, Rotation.from_rotvec(axis * angle * k)) for k in (1.0, 1.0 + further)]
    check_same(carry_on(camera, after[0], further), after[1])


@given(cameras(), st.floats(0.5, 0.99), st.floats(0.0, 100.0))
def test_a_zoom_never_passes_what_it_approaches(camera, grown, further):
    closer = turned(camera, camera.target, Rotation.identity(), grown=grown)
    ahead = carry_on(camera, closer, further)
    if ahead is not None:
        left = math.dist(camera.eye, camera.target) * grown ** (1 + further)
        reach = math.dist(camera.eye, camera.target) + max(map(abs, camera.target))
        assert math.dist(ahead.eye, camera.target) == pytest.approx(left, abs=1e-9 * reach)
        np.testing.assert_allclose(ahead.target, camera.target, atol=1e-9 * reach)


def test_survey_coordinates_lose_nothing():
    center = np.array([6e6, 5e6, 300.0])
    first = Camera(eye=tuple(center + np.array([20.0, 0.0, 5.0])), target=tuple(center), up=(0, 0, 1))

    def at(angle):
        return turned(first, center, Rotation.from_rotvec([0, 0, angle]))

    ahead = carry_on(at(0.0), at(0.02), 40.0)
    np.testing.assert_allclose(ahead.eye, at(0.82).eye, atol=1e-5)


def orbit(t: float) -> Camera:
    return Camera(eye=(4 * math.cos(t), 4 * math.sin(t), 1.0), target=(0.0, 0.0, 0.5), up=(0.0, 0.0, 1.0))


def seen(views: list[Camera], options: MotionOptions | None = None) -> Motion:
    motion = Motion(options=options or MotionOptions())
    for number, camera in enumerate(views):
        motion.note(number * FRAME, camera)
    return motion


@given(st.integers(2, 60), st.floats(0.01, 2.0))
def test_frames_of_an_orbit_tell_where_it_will_be(frames, horizon):
    motion = seen([orbit(0.3 * k * FRAME) for k in range(frames)])
    check_same(motion.ahead(horizon), orbit(0.3 * ((frames - 1) * FRAME + horizon)))


def test_nothing_is_told_of_one_pose_of_none_or_of_rest():
    assert seen([]).ahead(1.0) is None
    assert seen([orbit(0.0)]).ahead(1.0) is None
    assert seen([orbit(0.0)] * 20).ahead(1.0) is None
    assert seen([orbit(k * FRAME) for k in range(20)] + [orbit(19 * FRAME)]).ahead(1.0) is None


def test_a_jump_is_no_motion_and_the_motion_after_it_is_another():
    far = [
        replace(orbit(0.1 * k * FRAME), target=(50.0, 0.0, 0.0), eye=(50.0, -3.0 - k * FRAME, 1.0)) for k in range(5)
    ]
    views = [orbit(k * FRAME) for k in range(20)] + far
    assert seen(views[:21]).ahead(0.5) is None
    check_same(seen(views).ahead(1e-3 * FRAME), far[-1], within=1e-3)
    for other in (replace(orbit(0.1), fov_y=30.0), replace(orbit(0.1), width=100), orbit(1.0)):
        assert seen([orbit(0.0), orbit(FRAME), other]).ahead(0.5) is None


def test_a_pause_without_frames_is_the_end_of_a_motion():
    motion = seen([orbit(k * FRAME) for k in range(10)])
    motion.note(20 * FRAME + 1.0, orbit(11 * FRAME))
    assert motion.ahead(0.5) is None
    motion.note(20 * FRAME, orbit(12 * FRAME))  # a clock that stands still or goes back says nothing
    assert motion.ahead(0.5) is None


def test_a_hand_that_shakes_is_averaged_over_the_memory():
    draw = np.random.default_rng(3)
    views = [orbit(0.5 * k * FRAME + draw.uniform(-0.3, 0.3) * FRAME) for k in range(60)]
    ahead = seen(views).ahead(0.5)
    assert math.dist(ahead.eye, orbit(0.5 * (59 * FRAME + 0.5)).eye) < 0.25 * math.dist(views[-1].eye, orbit(0.74).eye)


def test_what_the_next_views_lack_comes_nearest_first_and_once():
    model = models.sphere(40_000)
    resident = model.everything
    looked: list[Camera] = []

    def look(camera):
        looked.append(camera)
        return refine(model.index, camera, 4.0, resident)

    lookahead = Lookahead(options=LookaheadOptions(horizons=(0.25, 1.0), enough=10_000))
    for number in range(5):
        lookahead.note(number * FRAME, orbit(number * FRAME))
    views = [orbit(4 * FRAME + seconds) for seconds in (0.0, 0.25, 1.0)]
    here, near, far = (look(camera).nodes for camera in views)
    resident = np.zeros_like(resident)
    resident[here] = True
    looked.clear()
    nodes = lookahead.nodes(look)
    for camera, right in zip(looked, views[1:], strict=True):
        check_same(camera, right)
    assert len(np.unique(nodes)) == len(nodes) > 0
    assert not resident[nodes].any()
    assert set(nodes.tolist()) <= set(near.tolist()) | set(far.tolist())
    first = refine(model.index, views[1], 4.0, resident).asks
    assert nodes[: len(first)].tolist() == first.tolist()
    few = Lookahead(options=LookaheadOptions(horizons=(0.25, 1.0), enough=1), motion=lookahead.motion)
    looked.clear()
    few.nodes(look)
    assert len(looked) == 1
    lookahead.note(5 * FRAME, orbit(4 * FRAME))
    assert len(lookahead.nodes(look)) == 0


NOTHING = SimpleNamespace(asks=np.empty(0, dtype=np.int64))


def swinging(t: float, period: float) -> Camera:
    """An orbit whose sense changes every so many seconds."""
    angle = 0.8 * (period - abs(t % (2 * period) - period))
    return Camera(
        eye=(3 * math.cos(angle), 3 * math.sin(angle), 1), target=(0, 0, 0), up=(0, 0, 1), width=64, height=48
    )


@pytest.mark.parametrize(("period", "trusted"), [(1e9, 4), (1.0, 1), (0.4, 0)])
def test_a_motion_that_turns_round_is_foreseen_for_as_long_as_it_goes_on(period, trusted):
    """The horizons that are looked at, 0.25 to 2 s, are those that most predictions held over."""
    lookahead, looked = Lookahead(LookaheadOptions(enough=10**9)), []

    def look(camera: Camera) -> object:
        looked.append(camera)
        return NOTHING

    counts = []
    for frame in range(int(20 / FRAME)):
        t = frame * FRAME
        lookahead.note(t, swinging(t, period))
        looked.clear()
        lookahead.nodes(look)
        if t > 10:
            counts.append(len(looked))
    assert np.median(counts) == trusted


def test_a_rest_does_not_take_trust_away():
    lookahead, looked = Lookahead(LookaheadOptions(enough=10**9)), []

    def look(camera: Camera) -> object:
        looked.append(camera)
        return NOTHING

    moved = 0.0
    for frame in range(int(20 / FRAME)):
        t = frame * FRAME
        moved += FRAME * (t % 3.0 < 1.0)
        lookahead.note(t, swinging(moved, 1e9))
        if t % 3.0 < 0.9 and t > 15.3:
            looked.clear()
            lookahead.nodes(look)
            assert len(looked) == 4
