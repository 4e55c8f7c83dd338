"""The mixing interface: samples of one surface, deep from everywhere, the same file for any number of threads."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from make_mixing import write_ply
from mixing import FURTHEST, SIZE, Interface, field

from pointbuild.readers import open_scan

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


@pytest.fixture(scope="module")
def interface() -> Interface:
    return Interface.of()


def values(interface: Interface, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([field(at, interface.waves, interface.amplitude, interface.phase) for at in xyz])


def test_samples_lie_on_the_surface_with_its_normals(interface: Interface) -> None:
    found = [interface.brick(number, 3.0) for number in range(0, 3840, 13)]
    xyz = np.concatenate([part[0] for part in found]).astype(np.float64)
    normals = np.concatenate([part[1] for part in found])
    assert len(xyz) > 4000
    value = values(interface, xyz)
    assert np.abs(value).max() < FURTHEST + 1e-3
    eps = 1e-5
    steps = [np.eye(3)[axis] * eps for axis in range(3)]
    gradient = np.stack([(values(interface, xyz + s) - values(interface, xyz - s)) / (2 * eps) for s in steps], axis=1)
    steepness = np.linalg.norm(gradient, axis=1)
    level = np.floor(value / interface.sheet)
    away = np.abs(value - (level + 0.5) * interface.sheet) / steepness
    assert away.max() < 1e-4
    assert np.quantile(away, 0.99) < 2e-6
    side = np.where(level % 2 == 1, 1, -1)  # the surface is walked through from one gas to the other and back
    cosine = (normals * gradient).sum(axis=1) / steepness * side
    assert cosine.min() > np.cos(np.radians(2))


def test_samples_grow_with_the_lines(interface: Interface) -> None:
    few, many = (len(interface.brick(1900, lines)[0]) / lines for lines in (200.0, 2000.0))
    assert few == pytest.approx(many, rel=0.03)


def test_rays_cross_more_than_fifty_sheets_from_every_corner(interface: Interface) -> None:
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    depths = interface.depths(SIZE / 2 + 3 * corners, 120)
    assert min(depth.mean() for depth in depths) > 50


def test_depth_is_what_is_asked_for() -> None:
    viewpoint = SIZE / 2 + np.array([[3.0, 3.0, 3.0]])
    deep, shallow = (Interface.of(depth=depth).depths(viewpoint, 80)[0].mean() for depth in (55.0, 11.0))
    assert deep / shallow == pytest.approx(5, rel=0.15)


@pytest.mark.parametrize("color", [False, True])
def test_the_file_does_not_depend_on_threads_and_can_be_read(color: bool, interface: Interface, tmp_path: Path) -> None:
    first, second = tmp_path / "1.ply", tmp_path / "3.ply"
    samples = write_ply(first, interface, 40_000, color=color, threads=1)
    write_ply(second, interface, 40_000, color=color, threads=3)
    assert first.read_bytes() == second.read_bytes()
    assert samples == pytest.approx(40_000, rel=0.05)
    scan = open_scan(first)
    batch = next(iter(scan.batches(samples + 1)))
    assert len(batch) == samples
    assert set(batch.attributes) == ({"normal", "color"} if color else {"normal"})
    assert (batch.xyz.min(axis=0) < 0.01).all()
    assert (batch.xyz.max(axis=0) > SIZE - 0.01).all()


def test_another_seed_is_another_surface() -> None:
    one, other = (Interface.of(seed).brick(1000, 2.0)[0] for seed in (0, 1))
    assert one.shape != other.shape or not np.array_equal(one, other)
