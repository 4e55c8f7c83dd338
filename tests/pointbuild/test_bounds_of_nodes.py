"""Spheres and cones of a built model hold everything that a reader decodes below a node, and little more."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from oracles import surfaces
from support.built import Built, build_points

from lpc.points import PointBatch

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


def check_spheres(built: Built) -> NDArray[np.float64]:
    """Radii over the largest distances."""
    ratio = []
    for node in range(len(built.clouds)):
        xyz = np.concatenate([built.clouds[below].xyz for below in built.descendants(node)])
        reach = np.sqrt(((xyz - built.index.center[node]) ** 2).sum(axis=1)).max()
        assert reach <= built.index.radius[node]
        ratio.append(built.index.radius[node] / reach if reach else 1.0)
    return np.array(ratio)


def unit(vectors: NDArray[np.float32]) -> NDArray[np.float64]:
    wide = vectors.astype(np.float64)
    return wide / np.maximum(np.linalg.norm(wide, axis=-1, keepdims=True), 1e-30)


def check_cones(built: Built) -> int:
    """Number of nodes with a cone."""
    cones = 0
    for node in range(len(built.clouds)):
        normals = np.concatenate([built.clouds[below].attributes["normal"] for below in built.descendants(node)])
        if built.index.cone_angle[node] < np.pi:
            chord = np.linalg.norm(unit(normals) - unit(built.index.cone_axis[node]), axis=-1)
            assert 2 * np.arcsin(np.minimum(chord / 2, 1)).max() <= built.index.cone_angle[node] + 2e-7
            assert normals.any(axis=1).all()
            cones += 1
    return cones


@pytest.mark.parametrize("shape", [surfaces.sphere, surfaces.torus, surfaces.bumpy])
def test_spheres_and_cones_hold_their_subtree(shape: object, tmp_path: Path) -> None:
    built = build_points(shape(3000, seed=1), tmp_path / "m.lpc", cloud_size=64, bucket_samples=500)
    ratio = check_spheres(built)
    assert ratio.max() < 1.0001
    assert check_cones(built) > len(built.clouds) // 2


def test_centres_follow_the_morton_order_of_their_level(tmp_path: Path) -> None:
    """docs/format.md: nodes stand by level, then by the Morton index of their sphere's centre."""
    points = surfaces.sphere(4000, seed=5)
    built = build_points(points, tmp_path / "m.lpc", cloud_size=64)
    low, high = points.xyz.min(axis=0), points.xyz.max(axis=0)
    for level in range(built.header.levels):
        codes = []
        for center in built.index.center[built.index.level == level]:
            start, side, code = low.copy(), high - low, 0
            for _ in range(level):
                axis = int(np.argmax(side))
                side[axis] /= 2
                upper = bool(center[axis] >= start[axis] + side[axis])
                start[axis] += side[axis] if upper else 0
                code = 2 * code + upper
            codes.append(code)
        assert codes == sorted(codes)


def test_one_sample_without_a_normal_takes_the_cones_above_it(tmp_path: Path) -> None:
    points = surfaces.bumpy(2000, seed=2)
    points.attributes["normal"][1234] = 0
    built = build_points(points, tmp_path / "m.lpc", cloud_size=64)
    check_cones(built)
    bare = next(n for n, cloud in enumerate(built.clouds) if not cloud.attributes["normal"].any(axis=1).all())
    while bare >= 0:
        assert built.index.cone_angle[bare] == pytest.approx(np.pi)
        bare = int(built.index.parent[bare])
    assert (built.index.cone_angle < np.pi).any()


def test_without_normals_there_is_no_cone(tmp_path: Path) -> None:
    built = build_points(surfaces.bumpy(500, normals=False), tmp_path / "m.lpc", cloud_size=64)
    assert (built.index.cone_angle == np.float32(np.pi)).all()


COORDINATE = st.one_of(st.floats(-1e9, 1e9, allow_subnormal=False), st.sampled_from([0.0, 1.0, 1e-6, 3e5, 1e7 + 0.001]))


@settings(max_examples=40, deadline=None)
@given(
    xyz=hnp.arrays(np.float64, st.tuples(st.integers(1, 60), st.just(3)), elements=COORDINATE),
    normal=hnp.arrays(np.float32, (60, 3), elements=st.floats(-1, 1, width=32)),
    cloud_size=st.integers(1, 16),
)
def test_any_few_samples(
    xyz: NDArray[np.float64], normal: NDArray[np.float32], cloud_size: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    points = PointBatch(xyz, {"normal": normal[: len(xyz)], "place": np.arange(len(xyz), dtype=np.uint8)})
    built = build_points(points, tmp_path_factory.mktemp("m") / "m.lpc", cloud_size=cloud_size, position_error=1.0)
    check_spheres(built)
    if "normal" in built.clouds[0].attributes:
        check_cones(built)
    found = built.everything()
    places = found.attributes["place"].astype(int)
    assert np.array_equal(np.sort(places), np.arange(len(xyz)))
    moved = np.sqrt(((found.xyz - xyz[places]) ** 2).sum(axis=1))
    assert moved.max() <= built.header.position_error
