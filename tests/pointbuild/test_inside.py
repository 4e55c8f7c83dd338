"""A closed surface whose normals point inwards is told, and nothing else is."""

from __future__ import annotations

import time

import numpy as np
import pytest
from support import shells

from lpc.points import PointBatch
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan
from pointbuild.inside import HINT, is_inside_out


def turned(points, by=-1.0):
    return PointBatch(points.xyz, {**points.attributes, "normal": (by * points.normal).astype(np.float32)})


def told(points, folder):
    said = []
    options = BuildOptions(threads=1, cloud_size=512)
    build_model([ArrayScan(points)], folder / "m.lpc", options, clock=time.monotonic, tell=said.append)
    return said


@pytest.mark.parametrize("shell", shells.SHELLS, ids=lambda shell: shell.name)
def test_closed_surfaces(shell, tmp_path):
    points = shells.sample(shell, "random", 6000, normals=True)
    points = PointBatch(points.xyz + np.array([5e5, 4e6, 100.0]), points.attributes)
    assert told(points, tmp_path) == []
    assert told(turned(points), tmp_path) == [f"{tmp_path / 'm.lpc'}: {HINT}"]


@pytest.mark.parametrize("by", [1.0, -1.0])
def test_open_surfaces_and_noise_are_left_alone(by):
    rng = np.random.default_rng(1)
    xyz = rng.uniform(-1, 1, (2000, 3)) * (1, 1, 0.1)
    up = np.tile(np.float32([0, 0, 1]), (2000, 1))
    noise = rng.normal(size=(2000, 3)).astype(np.float32)
    noise /= np.linalg.norm(noise, axis=1, keepdims=True)
    half = shells.sample(shells.SPHERE, "random", 8000, normals=True)
    half = half.take(half.xyz[:, 0] > 0)
    for points in (PointBatch(xyz, {"normal": up}), PointBatch(xyz, {"normal": noise}), half):
        assert not is_inside_out(turned(points, by))
    assert not is_inside_out(PointBatch(xyz, {}))
    assert not is_inside_out(PointBatch(xyz, {"normal": np.zeros_like(up)}))


@pytest.mark.parametrize(
    ("name", "inward"),
    [("ankylosaurus_mesh.ply", True), ("armadillo.obj", False), ("bun_zipper_res4.ply", False),
     ("stanford_dragon.ply", False), ("lion_takanawa.ply", False), ("car_cloud400.csv", False)],
)  # fmt: skip
def test_of_the_sample_scans_one_is_inside_out(name, inward, scan_path, tmp_path):
    said = []
    build_model([scan_path(name)], tmp_path / "m.lpc", BuildOptions(threads=1), clock=time.monotonic, tell=said.append)
    assert any(HINT in text for text in said) is inward
