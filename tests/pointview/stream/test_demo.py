"""The whole tour as subprocesses, and the surface it builds where no scan is at hand."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from oracles import surfaces

from lpc.errors import LpcError
from pointview.stream import demo
from pointview.stream.cli import demo as command

REPOSITORY = Path(__file__).resolve().parents[3]


@pytest.fixture
def rooms(monkeypatch):
    """Sub-commands find the packages of this checkout, installed or not."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(str(REPOSITORY / room) for room in ("common", "server", "client")))


def test_build_serve_stream_and_five_figures(tmp_path, rooms):
    points = surfaces.torus(20_000)
    scan = tmp_path / "torus.npz"
    np.savez(scan, xyz=points.xyz, normal=points.attributes["normal"])
    out = tmp_path / "out"
    result = CliRunner().invoke(command, ["--out", str(out), "--scan", str(scan), "--seconds", "2"])
    assert result.exit_code == 0, result.output
    commands = [line for line in result.stdout.splitlines() if line.startswith("$ pointstream")]
    assert [line.split()[2] for line in commands] == ["build", "serve", "stream"]
    report = json.loads((out / "report" / "report.json").read_text())
    assert report["clock"] == "real"
    assert report["link"] == "adsl"
    assert report["model"].startswith("http://127.0.0.1:")
    assert report["samples"] >= 2048  # a cloud at least, however slow the machine is
    assert (out / "report" / "frame-0001.0s-starved.png").is_file()
    assert f"Pictures at 1 and 2 s, and curve.png: {out / 'report'}" in result.stdout
    figures = result.stdout.split("\n\n")[-1].splitlines()
    assert len(figures) == 5
    assert re.search(rf"first picture +{report['first_picture_s']:.2f} s", figures[0])
    assert f"error after {report['curve'][-1]['t']:.3g} s" in figures[2]
    assert f"in {report['requests']} request" in figures[4]


def test_a_command_that_fails_ends_the_tour(tmp_path, rooms, capfd):
    (tmp_path / "broken.ply").write_text("no scan")
    with pytest.raises(LpcError, match="`pointstream build` ended with status 1"):
        list(demo.tour(tmp_path / "out", scan=tmp_path / "broken.ply", seconds=1.0, link="adsl"))
    assert "broken.ply" in capfd.readouterr().err


def test_the_surface_without_a_scan(tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "ISOSURFACE_SAMPLES", 30_000)
    with np.load(demo._isosurface(tmp_path / "surface.npz")) as scan:
        xyz, normal, color = scan["xyz"], scan["normal"], scan["color"]
    assert xyz.shape == normal.shape == color.shape == (30_000, 3)
    x, y, z = xyz.T
    value = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
    assert np.abs(value).max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-6)
    nudged = xyz + 1e-3 * normal  # the normals point to where f grows
    x, y, z = nudged.T
    assert (np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x) > 0).all()
    assert np.linalg.norm(xyz, axis=1).max() < 3 * np.pi + 0.2
