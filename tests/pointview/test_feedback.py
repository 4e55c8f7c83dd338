"""The tolerance follows frame time, and comes to rest when the camera does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointview.feedback import COARSEST, Feedback

ALLOWED = 0.05
MOST_FRAMES = 400


def smooth(scale):
    return lambda tolerance: scale / tolerance**2


def stepped(jumps):
    """Frame time that falls at some tolerances by any factor, as where one threshold drops many clouds."""
    at = np.sort([tolerance for tolerance, _ in jumps])
    times = np.sort([seconds for _, seconds in jumps])[::-1]
    return lambda tolerance: float(np.append(1.0, times)[np.searchsorted(at, tolerance)])


costs = st.one_of(
    st.floats(1e-4, 100.0).map(smooth),
    st.lists(st.tuples(st.floats(0.6, 60.0), st.floats(1e-3, 1.0)), min_size=1, max_size=6).map(stepped),
)


def run(cost, feedback, frames, *, moved=False, finest=1.0):
    tolerances = [feedback.tolerance]
    for _ in range(frames):
        feedback = feedback.step(cost(feedback.tolerance), allowed=ALLOWED, finest=finest, moved=moved)
        tolerances.append(feedback.tolerance)
    return feedback, tolerances


@given(cost=costs, start=st.floats(1.0, COARSEST))
def test_a_still_camera_comes_to_rest(cost, start):
    feedback, _ = run(cost, Feedback(tolerance=start), MOST_FRAMES)
    _, tolerances = run(cost, feedback, 20)
    assert len(set(tolerances)) == 1


@given(cost=costs, start=st.floats(1.0, COARSEST))
def test_what_was_too_slow_never_comes_back_under_a_still_camera(cost, start):
    feedback, tolerances = run(cost, Feedback(tolerance=start), 100)
    too_slow = 0.0
    for tolerance in tolerances[:-1]:
        assert tolerance > too_slow or tolerance in (COARSEST, feedback.worth)
        if cost(tolerance) > 1.15 * ALLOWED:
            too_slow = max(too_slow, tolerance)


@given(scale=st.floats(1e-3, 50.0), start=st.floats(1.0, COARSEST))
def test_frames_end_within_the_allowed_time_and_use_it(scale, start):
    cost = smooth(scale)
    _, tolerances = run(cost, Feedback(tolerance=start), MOST_FRAMES)
    end = tolerances[-1]
    assert cost(end) <= 1.15 * ALLOWED or end == COARSEST
    assert end == 1.0 or cost(end) >= 0.6 * ALLOWED


@given(fill=st.floats(1.3, 40.0), samples=st.floats(0.0, 0.3), start=st.floats(1.0, 6.0))
def test_where_pixels_take_the_time_the_picture_stays_fine(fill, samples, start):
    """Large splats on one another: coarser is no quicker, so nothing is given away for it."""

    def cost(tolerance):
        return ALLOWED * (fill + samples / tolerance**2)

    feedback, tolerances = run(cost, Feedback(tolerance=start), 60)
    assert max(tolerances) <= start * 1.5 * 1.5 * 1.4
    assert tolerances[-1] == pytest.approx(start, rel=1e-6)
    assert len(set(tolerances[-40:])) == 1
    _, tolerances = run(cost, feedback, 30, moved=True)
    assert max(tolerances) <= start * 3.0


def test_a_moving_camera_may_get_coarser_again_once_samples_take_the_time():
    feedback, _ = run(lambda _: 5 * ALLOWED, Feedback(tolerance=2.0), 30, moved=True)
    _, tolerances = run(smooth(80 * ALLOWED), feedback, 200, moved=True)
    assert smooth(80 * ALLOWED)(tolerances[-1]) < 1.3 * ALLOWED


@given(noise=st.lists(st.floats(0.5, 2.0), min_size=200, max_size=200))
def test_noise_moves_it_one_way_or_the_other_only_so_often(noise):
    """Frame times that jump by a factor of four change the direction at most a few times while the camera rests."""
    feedback, directions = Feedback(tolerance=4.0), []
    for factor in noise:
        after = feedback.step(0.8 / feedback.tolerance**2 * factor, allowed=ALLOWED, finest=1.0, moved=False)
        if after.tolerance != feedback.tolerance:
            directions.append(after.tolerance > feedback.tolerance)
        feedback = after
    assert int(np.count_nonzero(np.diff(directions))) <= 24
    assert feedback.tolerance <= COARSEST


def test_a_moving_camera_tries_again():
    feedback = Feedback(tolerance=8.0, too_slow=7.9)
    assert feedback.step(0.001, allowed=ALLOWED, finest=1.0, moved=False).tolerance == pytest.approx(8.0)
    assert feedback.step(0.001, allowed=ALLOWED, finest=1.0, moved=True).tolerance < 7.0


def test_never_finer_than_asked_for():
    assert Feedback(tolerance=2.0).step(0.0, allowed=ALLOWED, finest=1.9, moved=True).tolerance == 1.9
    assert Feedback(tolerance=2.0).step(1.0, allowed=ALLOWED, finest=90.0, moved=True).tolerance == 90.0
