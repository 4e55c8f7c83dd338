"""What a run leaves on disk."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from support.streaming import stream

from lpc.errors import StoreError
from pointview.render.picture import TINT, YELLOW
from pointview.stream.report import _pictured, prepare_folder

CONTRACT = [
    "link", "clock", "samples", "bytes", "requests", "link_utilisation", "first_picture_s", "settled_s", "tolerance",
    "curve",
]  # fmt: skip
EXTRA = [
    "model", "priority", "splat_rule", "occlusion", "occluded", "left_out", "prefetch",
    "speculative_bytes", "idle_bytes", "wasted_bytes",
    "size", "seconds", "model_samples", "model_bytes", "payload_bytes", "wanted_s",
    "frames", "errors",
]  # fmt: skip
ENTRY = [
    "t", "bytes", "requests", "resident_clouds", "splats", "starved_fraction", "max_spacing_px", "psnr_db", "ssim",
]  # fmt: skip


def pixels(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


@pytest.fixture(scope="module")
def folder(small, tmp_path_factory):
    folder = tmp_path_factory.mktemp("thirty") / "deep" / "report"
    stream(small, folder, "--seconds", 30, "--size", "96x72", link="400k,80ms")
    return folder


def test_names_of_the_figures(folder):
    report = json.loads((folder / "report.json").read_text())
    assert set(report) == {*CONTRACT, *EXTRA}
    for entry in report["curve"]:
        assert list(entry) == ENTRY
    assert report["link"] == "400k,80ms"
    assert report["clock"] == "virtual"
    assert report["tolerance"] == 1.0
    assert report["errors"] == []


def test_pictures_at_1_10_20_and_30_seconds_with_their_twins(folder):
    stems = [f"frame-{t:06.1f}s" for t in (1, 10, 20, 30)]
    assert stems[0] == "frame-0001.0s"
    assert {path.name for path in folder.glob("*.png")} == {
        "curve.png", *(f"{stem}.png" for stem in stems), *(f"{stem}-starved.png" for stem in stems),
    }  # fmt: skip
    for stem in stems:
        assert pixels(folder / f"{stem}.png").shape == pixels(folder / f"{stem}-starved.png").shape == (72, 96, 3)


def test_starved_regions_are_yellow_and_nothing_else_is(folder):
    report = json.loads((folder / "report.json").read_text())
    plain = pixels(folder / "frame-0001.0s.png").astype(float)
    twin = pixels(folder / "frame-0001.0s-starved.png").astype(float)
    tinted = (plain != twin).any(axis=2)
    assert tinted.any()
    np.testing.assert_allclose(twin[tinted], plain[tinted] * (1 - TINT) + np.array(YELLOW) * TINT, atol=0.6)
    background = (plain == plain[0, 0]).all(axis=2)
    entry = next(entry for entry in report["curve"] if entry["t"] == 1.0)
    share = tinted.sum() / (~background).sum()
    assert share == pytest.approx(entry["starved_fraction"], abs=0.02)
    settled = [pixels(folder / f"frame-0030.0s{twin}.png") for twin in ("", "-starved")]
    np.testing.assert_array_equal(*settled)


def test_the_plot_can_be_opened(folder):
    plot = pixels(folder / "curve.png")
    assert min(plot.shape[:2]) > 500
    assert len(np.unique(plot.reshape(-1, 3), axis=0)) > 50


def test_only_times_within_the_run_have_pictures(small, tmp_path):
    stream(small, tmp_path, "--seconds", 0.7)
    assert {path.name for path in tmp_path.glob("frame*.png")} == {"frame-0000.7s.png", "frame-0000.7s-starved.png"}


def test_pictures_are_named_by_the_asked_times_though_a_real_clock_is_late():
    late = [SimpleNamespace(t=t) for t in (0.106, 0.96, 1.07, 9.52, 10.08, 12.31)]
    chosen = {name: moment.t for name, moment in _pictured(late, 12.0).items()}
    assert chosen == {"frame-0001.0s": 0.96, "frame-0010.0s": 10.08, "frame-0012.0s": 12.31}


def test_a_run_without_any_picture_still_has_a_report(small, tmp_path):
    report = stream(small, tmp_path, "--seconds", 0.3, link="32k")
    assert report["first_picture_s"] is None
    assert report["settled_s"] is None
    assert report["samples"] == 0
    assert {entry["splats"] for entry in report["curve"]} <= {0}


def test_pictures_of_an_earlier_run_go_and_other_files_stay(tmp_path):
    old = ["frame-0020.0s.png", "frame-0020.0s-starved.png", "curve.png", "report.json"]
    for name in [*old, "frame-of-mine.png", "notes.txt"]:
        (tmp_path / name).write_text("old")
    prepare_folder(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"frame-of-mine.png", "notes.txt"}


def test_a_folder_that_cannot_be_is_known_at_once(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        prepare_folder(tmp_path / "file" / "report")
