"""Input that breaks builders: each ends in a right model or in one clear sentence, with nothing left behind."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from oracles import surfaces
from support.built import Built, build_points, numbered

from lpc.errors import BuildError
from lpc.points import PointBatch

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

RNG = np.random.default_rng(21)


def whole(xyz: NDArray[np.float64], out: Path, **options: object) -> Built:
    """Build, and check that every sample is there once and where it was."""
    built = build_points(numbered(xyz), out, **{"cloud_size": 64, "bucket_samples": 600, **options})
    found = built.everything()
    places = found.attributes["place"]
    assert np.array_equal(np.sort(places), np.arange(len(xyz)))
    moved = np.sqrt(((found.xyz - xyz[places]) ** 2).sum(axis=1))
    assert moved.max() <= built.header.position_error
    return built


@pytest.mark.parametrize("count", [1, 2, 63, 64, 65])
@pytest.mark.parametrize("place", [[0.0, 0.0, 0.0], [5e5, 4.9e6, 1e-3]])
def test_few_samples(count: int, place: list[float], tmp_path: Path) -> None:
    whole(RNG.random((count, 3)) + place, tmp_path / "m.lpc")


@pytest.mark.parametrize("count", [2, 64, 65, 5000])
def test_all_samples_at_one_place(count: int, tmp_path: Path) -> None:
    built = whole(np.full((count, 3), 1234.5), tmp_path / "m.lpc")
    assert built.header.nodes == 1
    assert built.header.spacing == 0
    assert (built.everything().xyz == 1234.5).all()


def test_a_chain_holds_what_is_too_much_for_one_cloud(tmp_path: Path) -> None:
    """140,000 samples at the origin, as scanners write for rays that hit nothing, and a surface."""
    xyz = np.concatenate([np.zeros((140_000, 3)), surfaces.sphere(3000, seed=1).xyz + 10.0])
    for bucket in (600, 1 << 20):
        built = whole(xyz, tmp_path / f"{bucket}.lpc", bucket_samples=bucket)
        assert (built.index.samples == 65535).any()
        assert built.header.spacing == pytest.approx(np.sqrt(4 * np.pi / 3000), rel=0.15)
    assert (tmp_path / "600.lpc").read_bytes() == (tmp_path / f"{1 << 20}.lpc").read_bytes()


@pytest.mark.parametrize("scale", [[1.0, 2.0, 3.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1e-9]])
def test_samples_on_a_line(scale: list[float], tmp_path: Path) -> None:
    whole(RNG.random((3000, 1)) * scale, tmp_path / "m.lpc")


@pytest.mark.parametrize("flat", [0, 1, 2])
def test_samples_in_a_plane(flat: int, tmp_path: Path) -> None:
    xyz = RNG.random((3000, 3))
    xyz[:, flat] = 7.0
    built = whole(xyz, tmp_path / "m.lpc")
    assert built.header.spacing == pytest.approx(np.sqrt(1 / 3000), rel=0.1)


def test_two_clusters_far_apart(tmp_path: Path) -> None:
    """A thousand million units between them, thousandths inside: 42 bits a coordinate."""
    cluster = surfaces.sphere(2000, seed=2).xyz * 0.05
    xyz = np.concatenate([cluster, cluster[::-1] + np.array([1e9, 1e9, -1e9])])
    built = whole(xyz, tmp_path / "m.lpc")
    spacing = 0.05 * np.sqrt(4 * np.pi / 2000)
    assert built.header.spacing == pytest.approx(spacing, rel=0.1)
    assert built.header.position_error < spacing / 2
    same = build_points(numbered(xyz), tmp_path / "n.lpc", cloud_size=64)
    assert same.data == built.data


def test_survey_coordinates_keep_their_millimetres(tmp_path: Path) -> None:
    xyz = np.round(surfaces.bumpy(3000, seed=3).xyz * 20, 3) + np.array([1e7, 6e6, 250.0])
    built = whole(xyz, tmp_path / "m.lpc", position_error=0.0005)
    assert built.header.position_error < 0.00051


def test_an_outlier_that_no_lattice_spans(tmp_path: Path) -> None:
    xyz = np.concatenate([surfaces.sphere(2000, seed=4).xyz, [[1e30, 0.0, 0.0]]])
    with pytest.raises(BuildError, match="more than 48 bits a coordinate"):
        build_points(numbered(xyz), tmp_path / "m.lpc", cloud_size=64)
    assert list(tmp_path.iterdir()) == []
    whole(xyz, tmp_path / "m.lpc", position_error=1e17)


@pytest.mark.parametrize("size", [1e-300, 1e-30, 1e40, 1e308])
def test_an_extent_that_no_record_can_say(size: float, tmp_path: Path) -> None:
    with pytest.raises(BuildError, match="the samples spread over"):
        build_points(numbered(surfaces.sphere(500, seed=5).xyz * size), tmp_path / "m.lpc")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size", [1e-23, 1e-12, 1e12, 1e35])
def test_tiny_and_huge_models(size: float, tmp_path: Path) -> None:
    built = whole(surfaces.sphere(500, seed=5).xyz * size, tmp_path / "m.lpc")
    assert built.header.spacing == pytest.approx(size * np.sqrt(4 * np.pi / 500), rel=0.1)


def test_density_ratio_of_a_million(tmp_path: Path) -> None:
    dense = surfaces.sphere(4000, seed=6).xyz * 1e-3
    sparse = surfaces.sphere(4000, seed=7).xyz * 1e3
    built = whole(np.concatenate([dense, sparse]), tmp_path / "m.lpc")
    assert built.header.levels < 60


@pytest.mark.parametrize("order", ["as it is", "sorted", "reversed", "shuffled"])
def test_any_order_of_the_input_makes_a_whole_model(order: str, tmp_path: Path) -> None:
    xyz = surfaces.torus(3000, seed=8).xyz
    if order == "sorted":
        xyz = xyz[np.argsort(xyz[:, 0])]
    elif order == "reversed":
        xyz = xyz[np.argsort(-xyz[:, 2])]
    elif order == "shuffled":
        xyz = RNG.permutation(xyz)
    whole(xyz, tmp_path / "m.lpc")


def test_a_wanted_error_that_is_too_small(tmp_path: Path) -> None:
    points = PointBatch(RNG.random((100, 3)))
    with pytest.raises(BuildError, match="48 bits"):
        build_points(points, tmp_path / "m.lpc", position_error=1e-20)


def test_clouds_of_one_sample_and_of_the_most(tmp_path: Path) -> None:
    xyz = surfaces.bumpy(600, seed=9).xyz
    assert whole(xyz, tmp_path / "m.lpc", cloud_size=1, position_error=1e-9).header.nodes == 600
    assert whole(xyz, tmp_path / "m.lpc", cloud_size=65535).header.nodes == 1
