"""`pointstream render` from the command line: files, addresses, prefixes, and wrong arguments."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from oracles import surfaces
from oracles.build import build_bytes
from PIL import Image
from support import models
from support.servers import serve_in_thread

from lpc.points import PointBatch
from pointstream.command import run as command
from pointview.cli import render
from pointview.render import Style
from pointview.render.cpu import CpuBackend
from pointview.still import StillOptions, draw_still


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    data = build_bytes(surfaces.torus(20_000), cloud_size=256, page_nodes=16, spacing=0.0278)
    path = tmp_path_factory.mktemp("models") / "torus.lpc"
    path.write_bytes(data)
    return path


def run(*arguments):
    return CliRunner().invoke(render, [str(argument) for argument in arguments])


def test_a_picture_and_its_figures(model_file, tmp_path):
    out = tmp_path / "out.png"
    result = run(model_file, out, "--size", "200x120", "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert list(report) == [
        "backend",
        "splats",
        "clouds",
        "starved_clouds",
        "culled",
        "frame_ms",
        "bytes_read",
        "left_out",
    ]
    assert set(report["culled"]) == {"frustum", "backface", "occluded"}
    assert report["starved_clouds"] == 0
    assert report["splats"] > 1000
    assert 0 < report["bytes_read"] <= model_file.stat().st_size + 65536
    picture = np.asarray(Image.open(out))
    assert picture.shape == (120, 200, 3)
    assert (picture != picture[0, 0]).any(axis=2).mean() > 0.2


def test_view_tolerance_and_sides(model_file, tmp_path):
    view = tmp_path / "view.json"
    view.write_text(json.dumps({"eye": [0, -1.6, 0.4], "target": [0, 0, 0], "up": [0, 0, 1], "fov_y": 60}))
    fine = json.loads(run(model_file, tmp_path / "a.png", "--view", view, "--json").stdout)
    coarse = json.loads(run(model_file, tmp_path / "b.png", "--view", view, "--tolerance", "12", "--json").stdout)
    both = json.loads(run(model_file, tmp_path / "c.png", "--view", view, "--two-sided", "--json").stdout)
    assert coarse["splats"] < fine["splats"] <= both["splats"]
    assert coarse["bytes_read"] <= fine["bytes_read"]
    assert fine["culled"]["backface"] + fine["culled"]["occluded"] > 0
    assert both["culled"]["backface"] == 0


def test_kinds_of_splats_and_samples_a_pixel(model_file, tmp_path):
    pictures = []
    for options in ("square", "round", "disc", "blended"):
        out = tmp_path / f"{options}.png"
        result = run(model_file, out, "--size", "80x60", "--tolerance", "3", "--splat", options)
        assert result.exit_code == 0, result.output
        pictures.append(np.asarray(Image.open(out)))
    for options in (("--antialias", "2"), ("--antialias", "3", "--splat", "blended")):
        out = tmp_path / "fine.png"
        assert run(model_file, out, "--size", "80x60", "--tolerance", "3", *options).exit_code == 0
        pictures.append(np.asarray(Image.open(out)))
    assert all(picture.shape == (60, 80, 3) for picture in pictures)
    assert len({picture.tobytes() for picture in pictures}) == len(pictures)
    assert run(model_file, tmp_path / "a.png", "--size", "80x60", "--tolerance", "3").exit_code == 0
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), pictures[3])
    refused = run(model_file, tmp_path / "a.png", "--size", "9000x10", "--antialias", "2")
    assert refused.exit_code == 2
    assert "above 16384 pixels" in refused.output


@pytest.mark.parametrize("budget", [600, 5000, 12_000])
def test_a_budget_is_kept(model_file, tmp_path, budget):
    report = json.loads(run(model_file, tmp_path / "a.png", "--budget", budget, "--json").stdout)
    assert budget - 1500 <= report["splats"] <= budget
    assert report["starved_clouds"] == 0


def test_without_json_one_line(model_file, tmp_path):
    result = run(model_file, tmp_path / "a.png", "--size", "64x64", "--backend", "cpu")
    assert result.exit_code == 0
    assert result.stdout.count("\n") == 1
    assert "splats" in result.stdout
    assert result.stderr == ""


async def test_the_settled_picture_is_that_of_everything_resident(model_file):
    model = models.build(surfaces.torus(20_000), 0.0278, cloud_size=256)
    still = await draw_still(str(model_file), StillOptions(width=160, height=120, tolerance=2.0))
    from pointview.camera import Camera
    from pointview.refine import refine
    from pointview.render import Style

    camera = Camera.frame_model(model.header, width=160, height=120)
    cut = refine(model.index, camera, 2.0, model.everything)
    frame = CpuBackend(model.header).draw(cut, model.take, camera, Style())
    np.testing.assert_array_equal(still.cut.nodes, cut.nodes)
    np.testing.assert_array_equal(still.frame.rgb, frame.rgb)


def test_an_address_gives_the_same_picture(model_file, tmp_path):
    with serve_in_thread(model_file.parent) as url:
        remote = run(f"{url}/{model_file.name}", tmp_path / "a.png", "--size", "96x64", "--json")
    local = run(model_file, tmp_path / "b.png", "--size", "96x64", "--json")
    assert remote.exit_code == 0, remote.output
    assert json.loads(remote.stdout)["splats"] == json.loads(local.stdout)["splats"]
    np.testing.assert_array_equal(
        np.asarray(Image.open(tmp_path / "a.png")), np.asarray(Image.open(tmp_path / "b.png"))
    )


@pytest.mark.parametrize("share", [0.9, 0.5, 0.2])
def test_any_prefix_is_a_picture(model_file, tmp_path, share):
    data = model_file.read_bytes()
    cut_short = tmp_path / "short.lpc"
    cut_short.write_bytes(data[: int(len(data) * share)])
    result = run(cut_short, tmp_path / "a.png", "--json", "--size", "320x240")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["starved_clouds"] > 0
    assert report["clouds"] > 0


@pytest.mark.parametrize(
    ("view", "why"),
    [
        ("{", "not JSON"),
        ("[1, 2]", "not a JSON object"),
        ("{}", "eye"),
        ('{"eye": [0, 0, 1], "target": [0, 0, 1], "up": [0, 1, 0], "fov_y": 45}', "same point"),
        ('{"eye": [0, 0, NaN], "target": [0, 0, 1], "up": [0, 1, 0], "fov_y": 45}', "finite"),
        ('{"eye": [0, 0, 5], "target": [0, 0, 1], "up": [0, 1, 0], "fov_y": 400}', "fov_y"),
    ],
)
def test_a_wrong_view_is_one_line(model_file, tmp_path, capsys, view, why):
    path = tmp_path / "view.json"
    path.write_text(view)
    out = tmp_path / "a.png"
    assert command(["render", str(model_file), str(out), "--view", str(path)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert why in said.err
    assert not out.exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ("--size", "0x5"), ("--size", "1024"), ("--size", "99999x2"), ("--tolerance", "0"), ("--tolerance", "-1"),
        ("--tolerance", "nan"), ("--budget", "0"), ("--backend", "metal"), ("--view", "absent.json"),
        ("--path", "absent.json"), ("--fps", "5"), ("--animation", "gif"),
    ],
)  # fmt: skip
def test_wrong_arguments_exit_2(model_file, tmp_path, arguments):
    result = run(model_file, tmp_path / "a.png", *arguments)
    assert result.exit_code == 2
    assert not (tmp_path / "a.png").exists()


def test_no_model_and_no_room_for_the_picture(model_file, tmp_path, capsys):
    (tmp_path / "text.lpc").write_text("not a model")
    for model, out in (
        (tmp_path / "absent.lpc", tmp_path / "a.png"),
        (tmp_path / "text.lpc", tmp_path / "a.png"),
        (model_file, tmp_path / "no" / "folder" / "a.png"),
    ):
        assert command(["render", str(model), str(out), "--size", "32x32"]) == 1
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.count("\n") == 1
        assert not out.exists()


@pytest.mark.parametrize(
    ("suffix", "kind", "close"), [("png", "PNG", 0), ("jpg", "JPEG", 12), ("WEBP", "WEBP", 0), ("tif", "TIFF", 0)]
)
def test_the_suffix_says_the_format(model_file, tmp_path, suffix, kind, close):
    assert run(model_file, tmp_path / "right.png", "--size", "80x60").exit_code == 0
    out = tmp_path / f"out.{suffix}"
    assert run(model_file, out, "--size", "80x60").exit_code == 0
    right = np.asarray(Image.open(tmp_path / "right.png")).astype(int)
    with Image.open(out) as picture:
        assert picture.format == kind
        assert np.abs(np.asarray(picture.convert("RGB")).astype(int) - right).mean() <= close


def test_what_is_hidden_is_not_drawn(tmp_path):
    """Spheres in one another: the inner ones are not drawn, and the picture is the same."""
    shells = [surfaces.sphere(8000, seed=number, radius=1 - 0.2 * number) for number in range(4)]
    xyz = np.concatenate([shell.xyz for shell in shells])
    normal = np.concatenate([shell.normal for shell in shells])
    path = tmp_path / "onion.lpc"
    path.write_bytes(build_bytes(PointBatch(xyz, {"normal": normal}), cloud_size=128, page_nodes=32, spacing=0.03))
    options = StillOptions(width=200, height=200, style=Style(two_sided=True), tolerance=2.0)
    seen, whole = (asyncio.run(draw_still(str(path), replace(options, occlusion=on))) for on in (True, False))
    assert seen.report["culled"]["occluded"] > 0
    assert seen.report["left_out"] == {}
    assert seen.report["splats"] < 0.6 * whole.report["splats"]
    covered = (seen.frame.node >= 0) | (whole.frame.node >= 0)
    assert (seen.frame.rgb != whole.frame.rgb).any(axis=2)[covered].mean() < 0.002
