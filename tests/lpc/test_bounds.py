from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import random_records

from lpc.bounds import (
    backfacing,
    bounding_spheres,
    decode_centers,
    decode_cones,
    join_cones,
    merge_boxes,
    merge_cones,
    normal_cone,
    normal_cones,
    quantise_cones,
    quantise_spheres,
    segment_boxes,
    segment_radii,
)
from lpc.page import child_counts

if TYPE_CHECKING:
    from numpy.typing import NDArray

seeds = st.integers(0, 2**32 - 1)
shapes = st.lists(st.sampled_from([0, 1, 2, 3, 3]), max_size=12)


def random_tree(shape: list[int], rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Parents and starts of a tree of small clouds."""
    records = random_records(shape, rng)
    parent = np.concatenate([[-1], np.repeat(np.arange(len(records)), child_counts(records))])
    return parent, np.concatenate([[0], np.cumsum(rng.integers(1, 7, len(records)))])


def subtrees(parent: NDArray[np.int64], starts: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Samples of each node and its descendants, one node after another."""
    members: list[list[int]] = [[] for _ in parent]
    for node in range(len(parent)):
        above = node
        while above >= 0:
            members[above] += range(starts[node], starts[node + 1])
            above = int(parent[above])
    return [np.array(rows) for rows in members]


def unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def apart(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles between unit vectors."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))


@given(shapes, seeds, st.sampled_from([0.0, 5e6]))
def test_a_sphere_holds_its_subtree_about_the_middle_of_its_box(shape: list[int], seed: int, far: float) -> None:
    rng = np.random.default_rng(seed)
    parent, starts = random_tree(shape, rng)
    xyz = far + rng.normal(size=(starts[-1], 3)) * rng.uniform(0.01, 100, 3)
    center, radius = bounding_spheres(xyz, starts, parent)
    low, high = merge_boxes(*segment_boxes(xyz, starts), parent)
    for node, rows in enumerate(subtrees(parent, starts)):
        assert (low[node] == xyz[rows].min(axis=0)).all()
        assert (high[node] == xyz[rows].max(axis=0)).all()
        assert center[node] == pytest.approx((low[node] + high[node]) / 2)
        needed = np.linalg.norm(xyz[rows] - center[node], axis=1).max()
        assert needed <= radius[node] <= np.linalg.norm(high[node] - low[node]) / 2 * (1 + 1e-9) + 1e-9


def test_a_leaf_has_the_smallest_radius_about_its_centre() -> None:
    xyz = np.array([[0.0, 0, 0], [2, 0, 0], [1, 0.5, 0], [7, 7, 7]])
    center, radius = bounding_spheres(xyz, [0, 3, 4], np.array([-1, -1]))  # a forest
    assert center.tolist() == [[1, 0.25, 0], [7, 7, 7]]
    assert radius == pytest.approx([math.hypot(1, 0.25), 0])
    assert segment_radii(xyz, [0, 3, 4], np.zeros((2, 3))) == pytest.approx([2, 7 * math.sqrt(3)])


@given(seeds, st.sampled_from([1e-3, 1.0, 1e5]), st.sampled_from([0.0, -3e6]))
def test_a_quantised_sphere_holds_decoded_samples(seed: int, side: float, far: float) -> None:
    rng = np.random.default_rng(seed)
    origin, error = np.full(3, far), side * 1e-4
    xyz = origin + side * rng.uniform(0, 1, (60, 3)) * rng.uniform(0, 1, 3)
    starts = np.arange(0, 61, 3)
    center, radius = bounding_spheres(xyz, starts, np.full(20, -1))
    codes, stored = quantise_spheres(center, radius, origin, side, error)
    assert codes.dtype == np.uint32
    assert stored.dtype == np.float32
    decoded = decode_centers(codes, origin, side)
    assert np.abs(decoded - center).max() <= side * 2**-32 + 1e-9 * abs(far)
    moved = xyz + error * unit(xyz - np.repeat(decoded, 3, axis=0) + 1e-30)  # the worst that decoding can do
    reach = np.linalg.norm(moved - np.repeat(decoded, 3, axis=0), axis=1).reshape(-1, 3).max(axis=1)
    assert (reach <= stored.astype(float)).all()
    assert (stored <= radius * 1.001 + 2 * error + 1e-8 * abs(far)).all()


def test_centres_at_the_far_corner_stay_in_32_bits() -> None:
    codes, radius = quantise_spheres(np.array([[8.0, 8, 8]]), np.zeros(1), [0, 0, 0], 8.0, 0.0)
    assert codes.tolist() == [[2**32 - 1] * 3]
    assert radius[0] >= 8 * 2**-32


@given(shapes, seeds, st.sampled_from([1e-7, 1e-3, 0.3, 2.0]))
def test_a_cone_holds_the_normals_of_its_subtree(shape: list[int], seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    parent, starts = random_tree(shape, rng)
    lean = np.repeat(rng.normal(size=(len(parent), 3)) * spread, np.diff(starts), axis=0)
    normals = unit(np.array([0.3, 0.2, 0.9]) + lean + spread * rng.normal(size=(starts[-1], 3)))
    axis, angle = merge_cones(*normal_cones(normals, starts), parent)
    codes, units = quantise_cones(axis, angle, normal_error=0.01)
    stored_axis, stored_angle = decode_cones(codes, units)
    for node, rows in enumerate(subtrees(parent, starts)):
        if angle[node] < np.pi:
            assert np.linalg.norm(axis[node]) == pytest.approx(1)
            assert apart(normals[rows], axis[node]).max() <= angle[node]
        if stored_angle[node] < np.pi:
            assert apart(normals[rows], stored_axis[node].astype(float)).max() + 0.01 <= stored_angle[node] + 1e-6


def test_a_narrow_cone_is_narrow() -> None:
    normals = unit(np.array([[0.0, 0, 1], [0.1, 0, 1], [0, 0.1, 1], [0.1, 0.1, 1]]))
    axis, angle = normal_cone(normals)
    assert axis == pytest.approx(unit(np.array([0.05, 0.05, 1.0])), abs=1e-3)
    assert angle == pytest.approx(math.atan(0.05 * math.sqrt(2)), abs=2e-3)
    axis, angle = normal_cone(np.array([[0.0, 0, -2]], np.float32))
    assert axis.tolist() == [0, 0, -1]
    assert angle < 1e-6


@given(seeds)
def test_joined_cones_are_the_smallest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = unit(rng.normal(size=(50, 3))), unit(rng.normal(size=(50, 3)))
    wide_a, wide_b = rng.uniform(0, 1.5, 50), rng.uniform(0, 1.5, 50)
    axis, angle = join_cones(a, wide_a, b, wide_b)
    ok = angle < np.pi
    assert (apart(axis, a)[ok] + wide_a[ok] <= angle[ok] + 1e-9).all()
    assert (apart(axis, b)[ok] + wide_b[ok] <= angle[ok] + 1e-9).all()
    least = np.maximum(np.maximum(wide_a, wide_b), (apart(a, b) + wide_a + wide_b) / 2)
    assert (angle[ok] <= least[ok] + 1e-6).all()
    assert (least[~ok] > np.pi - 1e-6).all()


def test_no_cone_where_a_normal_is_missing_or_they_cancel() -> None:
    up = [0.0, 0, 1]
    normals = np.array([up, [0, 0, 0], up, [0, 0, -1], up, up])
    axis, angle = normal_cones(normals, [0, 2, 4, 6])
    assert angle[:2].tolist() == [np.pi, np.pi]
    assert angle[2] < 1e-6
    _, merged = merge_cones(axis, angle, np.array([-1, 0, 0]))
    assert merged[0] == np.pi
    _, merged = merge_cones(axis[[2, 2, 0]], angle[[2, 2, 0]], np.array([-1, 0, 0]))
    assert merged[0] == np.pi  # a child without a cone leaves its ancestors without one
    codes, units = quantise_cones(axis, angle)
    assert units[:2].tolist() == [65535, 65535]
    assert decode_cones(codes, units)[1][:2] == pytest.approx([np.pi, np.pi])


def scene(rng: np.random.Generator) -> tuple[NDArray[np.float64], ...]:
    n = 40
    center = rng.normal(size=(n, 3)) * 3
    radius = rng.uniform(0, 2, n)
    axis, angle = unit(rng.normal(size=(n, 3))), rng.uniform(0, 1.7, n)
    return center, radius, axis, angle, rng.normal(size=3) * 4


@given(seeds)
def test_what_is_culled_faces_away_and_what_faces_away_is_culled(seed: int) -> None:
    rng = np.random.default_rng(seed)
    center, radius, axis, angle, eye = scene(rng)
    culled = backfacing(center, radius, axis, angle, eye)
    for node in range(len(center)):
        # Samples: random ones and the rim, all normals in the cone.
        across = unit(np.cross(axis[node], rng.normal(size=(400, 3))))
        lean = angle[node] * np.sqrt(rng.uniform(0, 1, (400, 1)))
        lean[:200] = angle[node]
        towards = eye - center[node]
        across[0] = unit(towards - (towards @ axis[node]) * axis[node])
        normals = np.cos(lean) * axis[node] + np.sin(lean) * across
        depth = radius[node] * rng.uniform(0, 1, (400, 1)) ** (1 / 3)
        samples = center[node] + depth * unit(rng.normal(size=(400, 3)))
        samples[0] = center[node] - radius[node] * normals[0]  # the worst of the proof
        facing = (normals * (eye - samples)).sum(axis=1)
        if culled[node]:
            assert facing.max() < 0
        else:
            reach = apart(axis[node], unit(towards)) <= angle[node]
            assert reach or facing[0] > -1e-5 * np.linalg.norm(towards)


def test_a_far_eye_behind_a_flat_patch_sees_its_back() -> None:
    center, axis = np.zeros((3, 3)), np.tile([0.0, 0, 1], (3, 1))
    assert backfacing(center, [1, 1, 1], axis, [0.1, 1.5, np.pi], [0, 0, -50]).tolist() == [True, True, False]
    assert not backfacing(center, [1, 1, 1], axis, [0.1, 1.5, np.pi], [0, 0, 50]).any()
    assert not backfacing(center, [1, 1, 1], axis, [0.1, 0.1, 0.1], [0, 0, -0.5]).any()  # the eye is inside


def test_a_child_before_its_parent_is_refused() -> None:
    with pytest.raises(ValueError, match="before its parent"):
        merge_boxes(np.zeros((2, 3)), np.ones((2, 3)), np.array([1, -1]))
