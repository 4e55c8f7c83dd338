"""Recorded paths hold every stretch of the way, and end where the camera was."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lpc.errors import StoreError
from pointview.camera import Camera
from pointview.stream.path import ViewPath
from pointview.window.recorder import APART, Recorder, free_name


def camera(x):
    return Camera(eye=(x, -5.0, 1.0), target=(x, 0.0, 0.0), up=(0, 0, 1))


@given(st.lists(st.floats(0.001, 1.0), min_size=1, max_size=40))
def test_a_path_passes_through_the_views_and_ends_with_the_last(steps):
    recorder, now = Recorder(100.0), 100.0
    recorder.note(now, camera(0.0))
    for step in steps:
        now += step
        recorder.note(now, camera(now - 100.0))
    now += 0.01
    recorder.note(now, camera(now - 100.0), last=True)
    times = [entry["t"] for entry in recorder.entries]
    assert times[0] == 0.0
    assert times == sorted(set(times))
    assert len(times) <= (now - 100.0) / APART + 3
    for entry in recorder.entries:
        assert entry["eye"][0] == pytest.approx(entry["t"], abs=1e-3)
    assert times[-1] == pytest.approx(now - 100.0, abs=1e-3)


def test_a_written_path_is_one_that_streams_replay(tmp_path):
    recorder = Recorder(0.0)
    for now in (0.0, 0.5, 1.0):
        recorder.note(now, camera(now))
    file = free_name(tmp_path, "torus-path", ".json")
    recorder.write(file)
    assert len(json.loads(file.read_text())) == 3
    path = ViewPath.read(file)
    assert path.at(0.25)["eye"][0] == pytest.approx(0.25)
    assert free_name(tmp_path, "torus-path", ".json").name == "torus-path-0002.json"


def test_a_path_that_cannot_be_written_is_one_line(tmp_path):
    recorder = Recorder(0.0)
    recorder.note(0.0, camera(0.0))
    with pytest.raises(StoreError, match="cannot be written there"):
        recorder.write(tmp_path / "none" / "path.json")
