"""A run from the first request to the settled picture, on a virtual clock."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import surfaces
from oracles.build import build_bytes
from support.streaming import stream

from pointview.stream.report import PICTURE_TIMES
from pointview.stream.session import look_times


@given(st.floats(0.1, 120.0))
def test_moments_to_look_at(seconds):
    times = look_times(seconds)
    assert times == sorted(set(times))
    assert times[0] <= 0.1
    assert times[-1] == seconds
    assert {t for t in PICTURE_TIMES if t <= seconds} <= set(times)
    assert max(after - before for before, after in pairwise([0.0, *times])) <= 0.51


@pytest.fixture(scope="module")
def settled(small, tmp_path_factory):
    return stream(small, tmp_path_factory.mktemp("report"), "--seconds", 2)


def test_bytes_only_grow_and_so_does_what_is_here(settled):
    for before, after in pairwise(settled["curve"]):
        assert before["t"] < after["t"]
        for key in ("bytes", "requests", "resident_clouds"):
            assert before[key] <= after[key]
    assert settled["curve"][-1]["bytes"] == settled["bytes"]
    assert settled["curve"][-1]["requests"] == settled["requests"]


def test_the_settled_picture_is_that_of_everything_resident(settled):
    assert 0.1 < settled["first_picture_s"] < settled["settled_s"] < 2.0
    for entry in settled["curve"]:
        if entry["t"] > settled["settled_s"]:
            assert (entry["psnr_db"], entry["ssim"], entry["starved_fraction"]) == (None, 1.0, 0.0)
    early = next(entry for entry in settled["curve"] if entry["t"] > settled["first_picture_s"])
    assert early["psnr_db"] < 35
    assert 0 < early["starved_fraction"] <= 1
    assert early["max_spacing_px"] > settled["curve"][-1]["max_spacing_px"]
    assert 12_000 < settled["samples"] <= settled["model_samples"] == 24_000
    # Between the arrival of all that a frame wanted and the next frame nothing is wanted.
    assert settled["settled_s"] - 0.1 < settled["wanted_s"] <= settled["settled_s"]


def test_before_the_first_picture_nothing_is_shown(settled):
    for entry in settled["curve"]:
        if entry["t"] < settled["first_picture_s"]:
            assert entry["splats"] == 0
            assert entry["starved_fraction"] == 1.0
        else:
            assert entry["splats"] > 0


def test_the_line_carries_payload_while_anything_is_wanted(endless, tmp_path):
    report = stream(endless, tmp_path, "--seconds", 13, "--tolerance", 0.01)
    assert report["settled_s"] is None
    assert 12.9 < report["wanted_s"] <= 13.0
    assert 0.95 <= report["link_utilisation"] <= 1.0
    assert report["link_utilisation"] == pytest.approx(
        (report["payload_bytes"] - report["idle_bytes"]) / (1.25e6 / 8 * report["wanted_s"])
    )
    assert report["payload_bytes"] <= report["bytes"] <= 13.0 * 1.25e6 / 8
    assert report["first_picture_s"] <= 0.6
    assert report["curve"][-1]["psnr_db"] > report["curve"][5]["psnr_db"]


def test_a_large_header_leaves_the_first_picture_early(tmp_path):
    crs = 'PROJCRS["' + "a description of the datum, " * 1600 + '"]'
    data = build_bytes(surfaces.bumpy(20_000), cloud_size=1024, page_nodes=128, crs=crs)
    assert len(crs) > 40_000
    (tmp_path / "model.lpc").write_bytes(data)
    assert stream(tmp_path / "model.lpc", tmp_path / "report", "--seconds", 1)["first_picture_s"] <= 0.6


def test_two_runs_are_the_same_run(small, tmp_path):
    for name in "ab":
        stream(small, tmp_path / name, "--seconds", 1.2, "--priority", "error")
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert "frame-0001.0s-starved.png" in files
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def test_a_truncated_model_streams_what_is_there(small, tmp_path):
    data = small.read_bytes()
    cut_short = tmp_path / "short.lpc"
    here = 3 * len(data) // 4  # some leaves are there and some are not
    cut_short.write_bytes(data[:here])
    report = stream(cut_short, tmp_path / "report", "--seconds", 2)
    last = report["curve"][-1]
    assert report["settled_s"] is None
    assert 0.9 * here < report["bytes"] <= here
    assert 0 < last["starved_fraction"] < 1
    assert (last["psnr_db"], last["ssim"]) == (None, 1.0)  # the reference has no more of it
    assert report["wanted_s"] < 1.0  # what cannot come is not waited for


def test_a_path_settles_and_moves_on(small, tmp_path):
    path = tmp_path / "path.json"
    path.write_text(
        '[{"t": 0, "eye": [0, -3, 1], "target": [0, 0, 0], "up": [0, 0, 1], "fov_y": 45},'
        ' {"t": 2, "eye": [3, 0, 1], "target": [0, 0, 0], "up": [0, 0, 1], "fov_y": 45}]'
    )
    report = stream(small, tmp_path / "report", "--seconds", 2, "--path", path)
    assert report["settled_s"] < 2
    assert len({entry["splats"] for entry in report["curve"][-6:]}) > 1  # other clouds at other places
    assert report["curve"][-1]["psnr_db"] is None  # compared with the same place of the path


def test_a_view_up_close_needs_less(small, tmp_path):
    view = tmp_path / "view.json"
    view.write_text('{"eye": [1.6, 0, 0.2], "target": [1, 0, 0], "up": [0, 0, 1], "fov_y": 8}')
    report = stream(small, tmp_path / "report", "--seconds", 1.5, "--view", view)
    assert report["curve"][-1]["ssim"] == 1.0
    assert report["samples"] < 18_000
