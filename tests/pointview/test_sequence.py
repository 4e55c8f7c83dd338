"""Numbered pictures along a path and around a model, and the animated file beside them."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from oracles import surfaces
from oracles.build import build_bytes
from PIL import Image

from pointstream.command import run as command
from pointview.camera import Camera
from pointview.sequence import numbered, path_views, turntable_views
from pointview.stream.path import ViewPath


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    data = build_bytes(surfaces.torus(8000), cloud_size=256, page_nodes=16, spacing=0.044)
    path = tmp_path_factory.mktemp("models") / "torus.lpc"
    path.write_bytes(data)
    return path


def render(capsys, *arguments):
    capsys.readouterr()
    assert command(["render", *map(str, arguments), "--size", "80x60", "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def view(x):
    return {"eye": [x, -4, 1], "target": [0, 0, 0], "up": [0, 0, 1], "fov_y": 45}


@pytest.mark.parametrize("kind", ["gif", "webp", "apng"])
def test_a_path_becomes_numbered_pictures_and_a_film(model_file, tmp_path, capsys, kind):
    path = tmp_path / "path.json"
    path.write_text(json.dumps([{"t": 0.5, **view(-2)}, {"t": 1.5, **view(2)}]))
    report = render(capsys, model_file, tmp_path / "o.png", "--path", path, "--fps", 4, "--animation", kind)
    assert report["pictures"] == 5
    assert (report["first"], report["last"], report["animation"]) == ("o-0001.png", "o-0005.png", f"o.{kind}")
    assert sorted(file.name for file in tmp_path.glob("o-*.png")) == [f"o-000{n}.png" for n in range(1, 6)]
    pictures = [np.asarray(Image.open(tmp_path / f"o-000{n}.png")) for n in range(1, 6)]
    assert all((one != other).any() for one, other in itertools.pairwise(pictures))
    with Image.open(tmp_path / f"o.{kind}") as film:
        assert (film.n_frames, film.size) == (5, (80, 60))


def test_a_turntable_of_blended_and_of_antialiased_pictures(model_file, tmp_path, capsys):
    shown = []
    for options in ((), ("--splat", "disc"), ("--antialias", 2)):
        render(capsys, model_file, tmp_path / "o.png", "--turntable", 2, "--animation", "none", *options)
        shown.append(np.asarray(Image.open(tmp_path / "o-0002.png")).tobytes())
    assert len(set(shown)) == 3


ITS_PIPES = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
"""imageio-ffmpeg leaves pipes open."""


@ITS_PIPES
@pytest.mark.parametrize("size", ["80x60", "81x61"])
def test_a_film_in_mp4_shows_the_pictures(model_file, tmp_path, capsys, size):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    capsys.readouterr()
    arguments = ["render", model_file, tmp_path / "o.png", "--turntable", 6, "--fps", 3, "--size", size, "--json"]
    assert command([*map(str, arguments)]) == 0
    assert json.loads(capsys.readouterr().out)["animation"] == "o.mp4"
    frames = ffmpeg.read_frames(str(tmp_path / "o.mp4"))
    facts = next(frames)
    assert (facts["fps"], facts["duration"], facts["codec"]) == (3.0, 2.0, "h264")
    width, height = facts["size"]
    shown = [np.frombuffer(data, dtype=np.uint8).reshape(height, width, 3).astype(int) for data in frames]
    assert len(shown) == 6
    for number, picture in enumerate(shown, 1):
        drawn = np.asarray(Image.open(tmp_path / f"o-000{number}.png")).astype(int)
        assert (width - drawn.shape[1], height - drawn.shape[0]) == (drawn.shape[1] % 2, drawn.shape[0] % 2)
        assert np.abs(picture[: drawn.shape[0], : drawn.shape[1]] - drawn).mean() < 6  # H.264 has its losses


@ITS_PIPES
def test_a_film_that_cannot_be_written_is_one_line(model_file, tmp_path, capsys):
    pytest.importorskip("imageio_ffmpeg")
    (tmp_path / "o.mp4").mkdir()
    arguments = ["render", str(model_file), str(tmp_path / "o.png"), "--turntable", "2", "--animation", "mp4"]
    assert command([*arguments, "--size", "80x60"]) == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("pointstream: cannot write")


def test_each_picture_is_that_of_its_view(model_file, tmp_path, capsys):
    path, still = tmp_path / "path.json", tmp_path / "view.json"
    path.write_text(json.dumps([{"t": 0, **view(-2)}, {"t": 1, **view(2)}]))
    still.write_text(json.dumps(view(2)))
    render(capsys, model_file, tmp_path / "o.png", "--path", path, "--fps", 1, "--animation", "none")
    render(capsys, model_file, tmp_path / "alone.png", "--view", still)
    assert (tmp_path / "o-0002.png").read_bytes() == (tmp_path / "alone.png").read_bytes()
    assert not list(tmp_path.glob("o.*"))


def test_a_turntable_goes_once_around(model_file, tmp_path, capsys):
    report = render(capsys, model_file, tmp_path / "t.png", "--turntable", 3, "--animation", "none")
    assert (report["pictures"], report["animation"]) == (3, None)


def test_the_turntable_keeps_the_whole_model_in_every_picture():
    camera = Camera.frame_box((-3, -1, -0.5, 3, 1, 0.5), backward=(0, -1, 0), up=(0, 0, 1), width=200, height=100)
    corners = np.array(np.meshgrid((-3, 3), (-1, 1), (-0.5, 0.5))).reshape(3, 8).T
    views = turntable_views(camera, 7, (-3, -1, -0.5, 3, 1, 0.5))
    distances = set()
    for each in views:
        around = Camera.from_view(each, width=200, height=100)
        pixel, depth = around.project(corners)
        assert (depth > 0).all()
        assert (pixel >= -1e-6).all()
        assert (pixel <= np.array([200, 100]) + 1e-6).all()
        distances.add(round(float(np.linalg.norm(around.eye)), 6))
    assert len(distances) == 1
    assert len({tuple(np.round(each["eye"], 6)) for each in views}) == 7


def test_times_of_a_path():
    path = ViewPath((1.0, 2.0), (view(0), view(10)))
    assert [each["eye"][0] for each in path_views(path, 2.0)] == [0, 5, 10]
    assert len(path_views(ViewPath.still(view(0)), 10.0)) == 1


def test_as_many_digits_as_it_takes(tmp_path):
    assert numbered(tmp_path / "a.png", 3)[2].name == "a-0003.png"
    assert numbered(tmp_path / "a.png", 12_345)[0].name == "a-00001.png"


@pytest.mark.parametrize("arguments", [("--turntable", 1), ("--path", "p.json", "--turntable", 3), ("--fps", "nan")])
def test_wrong_arguments(model_file, tmp_path, arguments):
    assert command(["render", str(model_file), str(tmp_path / "o.png"), *map(str, arguments)]) == 2


def test_an_encoder_that_is_not_there_is_said_before_any_work(model_file, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("pointview.sequence._has_ffmpeg", lambda: False)
    arguments = ["render", str(model_file), str(tmp_path / "o.png"), "--turntable", "2", "--animation", "mp4"]
    assert command(arguments) == 1
    assert "imageio-ffmpeg" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
