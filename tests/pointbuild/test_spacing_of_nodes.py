"""Spacings: measured as the area per sample says, by equations 1 and 2 where the scan is uniform, local where not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from oracles import surfaces
from scipy.spatial import cKDTree
from support.built import build_points

from lpc.lattice import SLACK
from lpc.points import PointBatch
from lpc.spacing import spacings
from pointbuild.spacing import model_spacing

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def neighbour_spacing(points: PointBatch) -> float:
    """The study's definition, on all samples."""
    distance = cKDTree(points.xyz).query(points.xyz, k=9)[0][:, 8]
    return float(np.median(distance) * np.sqrt(np.pi / 8))


@pytest.mark.parametrize(
    ("points", "area"),
    [(surfaces.sphere(20_000, seed=1, radius=2.0), 16 * np.pi), (surfaces.torus(20_000, seed=2), None)],
)
def test_model_spacing_is_the_root_of_area_per_sample(points: PointBatch, area: float | None, tmp_path: Path) -> None:
    built = build_points(points, tmp_path / "m.lpc", cloud_size=512)
    assert built.header.spacing == pytest.approx(neighbour_spacing(points), rel=0.03)
    if area is not None:
        assert built.header.spacing == pytest.approx(np.sqrt(area / len(points)), rel=0.05)


@pytest.mark.parametrize("name", ["bun_zipper_res4.ply", "ankylosaurus_mesh.ply", "tinyCartesianFloatRgb.e57"])
def test_model_spacing_of_real_scans(name: str, scan_path: Callable[[str], Path], tmp_path: Path) -> None:
    import time

    from pointbuild import BuildOptions, build_model
    from pointbuild.readers import open_scan

    scan = open_scan(scan_path(name))
    report = build_model([scan], tmp_path / "m.lpc", BuildOptions(threads=1), clock=time.monotonic)
    points = PointBatch.concatenate(list(scan.batches(100_000)))
    assert report.header.spacing == pytest.approx(neighbour_spacing(points), rel=0.08)
    assert report.header.position_error < report.header.spacing / 2


def test_a_uniform_scan_has_the_spacings_of_the_equations(tmp_path: Path) -> None:
    points = surfaces.sphere(30_000, seed=3)
    built = build_points(points, tmp_path / "m.lpc", cloud_size=500)
    index = built.index
    expected = spacings(index.subtree, index.samples, index.parent, built.header.spacing)
    crowded = index.samples == 500
    assert index.spacing[crowded] == pytest.approx(expected[crowded], rel=0.15)
    assert index.spacing[0] == pytest.approx(np.sqrt(4 * np.pi / 500), rel=0.05)
    low, middle, high = built.header.spacing_ratio
    assert 0.7 < low < middle < high < 1.3
    assert middle == pytest.approx(1, abs=0.05)


def test_an_uneven_scan_has_local_spacings(tmp_path: Path) -> None:
    """Two patches of equal area, one 16 times denser: leaves say 4 times less there, and the root covers both."""
    rng = np.random.default_rng(4)
    dense = np.stack([rng.random(32_000), rng.random(32_000), np.zeros(32_000)], axis=1)
    sparse = np.stack([5 + rng.random(2000), rng.random(2000), np.zeros(2000)], axis=1)
    built = build_points(PointBatch(np.concatenate([dense, sparse])), tmp_path / "m.lpc", cloud_size=256)
    leaf = (built.index.children < 0).all(axis=1) & (built.index.samples > 50)
    left = built.index.center[:, 0] < 2
    near, far = np.sqrt(1 / 32_000), np.sqrt(1 / 2000)
    assert np.median(built.index.spacing[leaf & left]) == pytest.approx(near, rel=0.1)
    assert np.median(built.index.spacing[leaf & ~left]) == pytest.approx(far, rel=0.15)
    assert built.index.spacing[0] == pytest.approx(np.sqrt(2 / 256), rel=0.1)
    assert built.header.spacing == pytest.approx(near, rel=0.05)


def test_spacing_falls_from_parent_to_child(tmp_path: Path) -> None:
    index = build_points(surfaces.torus(20_000, seed=5), tmp_path / "m.lpc", cloud_size=256).index
    child = np.flatnonzero(index.parent >= 0)
    assert (index.spacing[child] < index.spacing[index.parent[child]]).mean() > 0.99


def test_duplicates_do_not_bring_the_spacing_to_zero(tmp_path: Path) -> None:
    points = surfaces.sphere(5000, seed=6, normals=False)
    pile = PointBatch(np.repeat(points.xyz[:1], 6000, axis=0))
    built = build_points(PointBatch.concatenate([points, pile]), tmp_path / "m.lpc", cloud_size=200)
    assert built.header.spacing == pytest.approx(np.sqrt(4 * np.pi / 5000), rel=0.15)
    assert (built.index.spacing > 0).all()
    assert built.index.spacing.min() >= np.float32(built.header.step)


def test_the_step_keeps_the_error_below_half_the_spacing(tmp_path: Path) -> None:
    points = surfaces.bumpy(3000, seed=7)
    built = build_points(points, tmp_path / "m.lpc")
    assert built.header.step == pytest.approx(SLACK * built.header.spacing / np.sqrt(3))
    assert built.header.position_error <= built.header.spacing / 2
    finer = build_points(points, tmp_path / "n.lpc", position_error=1e-5)
    assert 0.9e-5 < finer.header.position_error <= 1e-5


def test_the_median_is_over_samples() -> None:
    assert model_spacing(np.array([3.0, 1.0, 2.0]), np.array([1, 1, 10])) == 2.0
    assert model_spacing(np.array([3.0, 1.0, 2.0]), np.array([10, 1, 1])) == 3.0
    assert model_spacing(np.empty(0), np.empty(0, int)) == 0.0
