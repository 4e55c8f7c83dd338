"""Fetching ahead of a moving camera, over ADSL on the virtual clock: what it gains, and that it never costs."""

from __future__ import annotations

import json
import math

import pytest
from support.streaming import stream

MOVES = (1.5, 4.5)
"""Seconds between which the camera flies over the field; at rest before and after."""


def fly(t):
    x = 0.6 + 0.35 * (min(max(t, MOVES[0]), MOVES[1]) - MOVES[0])
    return {"t": t, "eye": [x, 0.2, 0.6], "target": [x + 0.15, 1, 0], "up": [0, 0, 1], "fov_y": 45}


@pytest.fixture(scope="module")
def runs(endless, tmp_path_factory):
    folder = tmp_path_factory.mktemp("prefetch")
    (folder / "path.json").write_text(json.dumps([fly(t) for t in (0.0, *MOVES)]))
    given = ("--seconds", 6, "--path", folder / "path.json", "--tolerance", 5)
    return {kind: stream(endless, folder / kind, *given, "--prefetch", kind) for kind in ("off", "auto")}


def quality(entry):
    if entry["splats"] == 0:
        return -math.inf
    return math.inf if entry["psnr_db"] is None else entry["psnr_db"]


def test_a_moving_camera_sees_no_more_error_at_any_moment_and_less_at_some(runs):
    better = 0
    for off, auto in zip(runs["off"]["curve"], runs["auto"]["curve"], strict=True):
        assert off["t"] == auto["t"]
        assert quality(auto) >= quality(off) - 0.05
        assert auto["starved_fraction"] <= off["starved_fraction"] + 0.001
        better += quality(auto) > quality(off) + 1.0
    assert better >= 2
    assert runs["auto"]["wanted_s"] < 0.9 * runs["off"]["wanted_s"]


def test_what_came_ahead_is_counted(runs):
    off, auto = runs["off"], runs["auto"]
    assert (off["prefetch"], auto["prefetch"]) == ("off", "auto")
    assert off["speculative_bytes"] == off["wasted_bytes"] == 0
    assert auto["bytes"] - off["bytes"] <= auto["wasted_bytes"]  # what was used would have come anyway
    assert 0 <= auto["wasted_bytes"] < auto["speculative_bytes"] / 2
    assert off["idle_bytes"] < auto["idle_bytes"] < auto["bytes"]
    carried = 1.25e6 / 8 * auto["wanted_s"]
    assert auto["link_utilisation"] == pytest.approx((auto["payload_bytes"] - auto["idle_bytes"]) / carried)
    assert off["link_utilisation"] < auto["link_utilisation"] <= 1.0


def test_nothing_is_fetched_ahead_of_a_camera_at_rest(runs, endless, tmp_path):
    last = [entry["bytes"] for entry in runs["auto"]["curve"] if entry["t"] >= MOVES[1] + 0.5]
    assert len(last) >= 3
    assert len(set(last)) == 1
    still = tmp_path / "view.json"
    still.write_text(json.dumps({key: value for key, value in fly(0.0).items() if key != "t"}))
    report = stream(endless, tmp_path / "report", "--seconds", 3.5, "--view", still, "--tolerance", 5)
    assert report["settled_s"] < 3.0
    assert report["prefetch"] == "auto"
    assert report["speculative_bytes"] == report["wasted_bytes"] == 0
