"""Scans without a surface: few samples, lines, planes and piles. Their samples stay apart, and no number is made up."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.built import build_points

from lpc.points import PointBatch

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

FAR = np.array([500_000.0, 4_000_000.0, 100.0])


def closest(xyz: NDArray[np.float64]) -> float:
    return float(cKDTree(xyz).query(xyz, k=2)[0][:, 1].min())


@pytest.mark.parametrize("n", [2, 3, 5, 8, 9, 20, 31])
@pytest.mark.parametrize("origin", [FAR * 0, FAR])
def test_the_samples_of_a_small_scan_stay_apart(n: int, origin: NDArray[np.float64], tmp_path: Path) -> None:
    xyz = np.random.default_rng(n).random((n, 3)) * (10.0, 7.0, 1.0) + origin
    header = build_points(PointBatch(xyz), tmp_path / "m.lpc").header
    assert 0 < header.position_error < closest(xyz) / 2
    assert header.spacing == pytest.approx(closest(xyz))


def test_a_small_grid_has_the_spacing_of_its_grid(tmp_path: Path) -> None:
    xyz = np.array([[x, y, 0.0] for x in range(3) for y in range(3)])
    assert build_points(PointBatch(xyz), tmp_path / "m.lpc").header.spacing == 1.0


def test_two_samples_almost_in_one_place_do_not_set_the_spacing(tmp_path: Path) -> None:
    xyz = np.array([[0, 0, 0], [1e-200, 0, 0], [1e-13, 0, 0], [5, 1, 1]])
    assert build_points(PointBatch(xyz), tmp_path / "m.lpc").header.spacing == pytest.approx(np.sqrt(27))


@pytest.mark.parametrize("direction", [(0.1, 0, 0), (0.1, 0.2, 0.05), (0, 0, -3.0)])
@pytest.mark.parametrize("n", [32, 1000, 5000])
def test_the_samples_of_a_line_stay_apart(n: int, direction: tuple[float, float, float], tmp_path: Path) -> None:
    xyz = np.arange(n)[:, None] * np.array(direction) + FAR
    header = build_points(PointBatch(xyz), tmp_path / "m.lpc", cloud_size=256).header
    gap = float(np.linalg.norm(direction))
    assert header.spacing == pytest.approx(gap, rel=0.3 if n == 32 else 1e-6)
    assert 0 < header.position_error < (0.65 if n == 32 else 0.5) * gap


def test_a_plane_is_measured_by_its_area(tmp_path: Path) -> None:
    xyz = np.c_[np.random.default_rng(1).random((5000, 2)) * 10, np.zeros(5000)]
    header = build_points(PointBatch(xyz), tmp_path / "m.lpc", cloud_size=512).header
    assert header.spacing == pytest.approx(np.sqrt(100 / 5000), rel=0.05)


@pytest.mark.parametrize("n", [1, 2, 300])
@pytest.mark.parametrize("place", [FAR, FAR * 0, -FAR])
def test_samples_that_coincide_stay_where_they_are(n: int, place: NDArray[np.float64], tmp_path: Path) -> None:
    built = build_points(PointBatch(np.repeat(place[None], n, axis=0)), tmp_path / "m.lpc", cloud_size=64)
    assert built.header.spacing == 0
    assert built.header.position_error <= 1e-9 * max(np.abs(place).max(), 1)
    assert (built.everything().xyz == place).all()
