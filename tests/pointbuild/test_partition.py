"""Which samples each node gets: against plain recursion, and against what LPC 3 and 5 say in so many words."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from oracles import surfaces
from oracles.partition import partition
from support.built import Built, build_points, numbered

from lpc.lattice import quantise
from lpc.points import PointBatch
from pointbuild.priority import priorities
from pointbuild.rows import fill_rows, priorities_of, row_dtype

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from lpc.header import Header


def placed(
    xyz: NDArray[np.float64], header: Header, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.uint64]]:
    """Lattice points of the samples that a model was built from, corner and sides of its box, and priorities."""
    places = quantise(xyz, np.array(header.origin), header.step).astype(np.float64)
    dtype = row_dtype(header.attributes, short=places.max() < 2**31)
    values = {"place": np.arange(len(xyz), dtype=np.uint32)}
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    priority = priorities_of(fill_rows(dtype, places, values, header.attributes), seed)
    return places, (low - np.array(header.origin)) / header.step, (high - low) / header.step, priority


def check(xyz: NDArray[np.float64], built: Built, cloud_size: int, seed: int = 0) -> None:
    """Compare with the oracle, node by node in the order of the file."""
    expected = partition(*placed(xyz, built.header, seed), cloud_size)
    assert built.members() == [node.own for node in expected]
    assert built.index.level.tolist() == [node.depth for node in expected]
    assert built.index.subtree.tolist() == [len(node.subtree) for node in expected]
    paths = {node.path: number for number, node in enumerate(expected)}
    children = [[paths.get((*node.path, half), -1) for half in (0, 1)] for node in expected]
    assert built.index.children.tolist() == children


SCANS = {
    "surface": surfaces.bumpy(700, seed=1).xyz,
    "sphere far away": surfaces.sphere(500, seed=2).xyz + np.array([5e6, -3e6, 100.0]),
    "clump and outlier": np.concatenate([surfaces.sphere(400, seed=3).xyz * 1e-6, [[1e3, 2e3, 3e3]]]),
    "line": np.linspace(0, 1, 300)[:, None] * [1.0, 2.0, -3.0],
    "plane": np.stack([*np.meshgrid(np.arange(20.0), np.arange(20.0)), np.zeros((20, 20))], axis=-1).reshape(-1, 3),
    "grid": np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3),
    "needle": np.random.default_rng(4).random((400, 3)) * [1e6, 1.0, 1e-3],
    "half duplicates": np.concatenate([np.full((200, 3), 0.25), np.random.default_rng(5).random((200, 3))]),
    "each thrice": np.repeat(np.random.default_rng(6).random((150, 3)), 3, axis=0),
    "two places": np.repeat([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 150, axis=0),
}


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("bucket", [256, 100_000])
def test_nodes_are_those_of_plain_recursion(name: str, bucket: int, tmp_path: Path) -> None:
    xyz = SCANS[name]
    check(xyz, build_points(numbered(xyz), tmp_path / "m.lpc", cloud_size=16, bucket_samples=bucket), 16)


@settings(max_examples=40, deadline=None)
@given(
    xyz=hnp.arrays(
        np.float64,
        st.tuples(st.integers(1, 120), st.just(3)),
        elements=st.sampled_from([0.0, 1.0, 2.0, 3.0, 4.0, 8.0, 0.1, 0.7, -5.0, 1e5, 1e-9]),
    ),
    cloud_size=st.integers(1, 20),
    seed=st.integers(0, 2**64 - 1),
)
def test_nodes_of_any_few_samples_are_those_of_plain_recursion(
    xyz: NDArray[np.float64], cloud_size: int, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    out = tmp_path_factory.mktemp("m") / "m.lpc"
    built = build_points(numbered(xyz), out, cloud_size=cloud_size, seed=seed, position_error=1e-6)
    check(xyz, built, cloud_size, seed)


@pytest.mark.parametrize("count", [1, 2, 63, 64, 65, 128, 129, 1000])
def test_every_sample_is_in_one_cloud_and_inner_clouds_are_full(count: int, tmp_path: Path) -> None:
    built = build_points(numbered(np.random.default_rng(0).random((count, 3))), tmp_path / "m.lpc", cloud_size=64)
    places = np.concatenate([cloud.attributes["place"] for cloud in built.clouds])
    assert np.array_equal(np.sort(places), np.arange(count))
    inner = built.index.children.max(axis=1) >= 0
    assert (built.index.samples[inner] == 64).all()
    assert (built.index.samples[~inner] <= 64).all()
    assert built.header.samples == count


def test_a_node_takes_smaller_priorities_than_all_below_it(tmp_path: Path) -> None:
    count = 5000
    xyz = surfaces.torus(count).xyz
    built = build_points(numbered(xyz), tmp_path / "m.lpc", cloud_size=50, seed=9, bucket_samples=600)
    priority = placed(xyz, built.header, 9)[-1]
    largest = [priority[sorted(own)].max() for own in built.members()]
    smallest = [priority[sorted(own)].min() for own in built.members()]
    for node in range(1, len(largest)):
        assert largest[built.index.parent[node]] < smallest[node]


def test_children_halve_their_parents_cell(tmp_path: Path) -> None:
    """All samples below a node's lower child are below those of the upper child along one axis."""
    built = build_points(surfaces.bumpy(4000), tmp_path / "m.lpc", cloud_size=32)
    both = 0
    for node, (lower, upper) in enumerate(built.index.children.tolist()):
        if lower >= 0 and upper >= 0:
            first = np.concatenate([built.clouds[below].xyz for below in built.descendants(lower)])
            second = np.concatenate([built.clouds[below].xyz for below in built.descendants(upper)])
            gap = (second.min(axis=0) - first.max(axis=0)).max()
            assert gap >= -built.header.step, node
            both += 1
    assert both > 50


def words(count: int) -> NDArray[np.uint64]:
    return np.stack([np.arange(count, dtype=np.uint64) % np.uint64(317), np.arange(count, dtype=np.uint64)], axis=1)


def test_close_seeds_give_unrelated_subsamples() -> None:
    chosen = [set(np.argsort(priorities(words(100_000), seed))[:1000].tolist()) for seed in (0, 1, 2, 3, -1)]
    for first, second in pairwise(chosen):
        assert len(first & second) < 40  # 10 expected


def test_priorities_do_not_depend_on_where_a_sample_stands() -> None:
    whole = priorities(words(1000), 5)
    assert np.array_equal(whole[300:700], priorities(words(1000)[300:700], 5))
    assert len(np.unique(whole)) == 1000


def test_samples_next_to_each_other_have_unrelated_priorities() -> None:
    whole = priorities(words(100_000), 5) >> np.uint64(53)
    counts = np.bincount(whole.astype(int), minlength=1024)
    assert ((counts - counts.mean()) ** 2 / counts.mean()).sum() < 1024 + 6 * np.sqrt(2 * 1024)  # chi squared


@pytest.mark.parametrize("bucket", [256, 100_000])
def test_copies_of_a_sample_come_after_everything_else(bucket: int, tmp_path: Path) -> None:
    """On a coarse lattice many samples without attributes are equal; a place is shown again when all places are."""
    xyz = surfaces.bumpy(6000, seed=8).xyz
    built = build_points(PointBatch(xyz), tmp_path / "m.lpc", cloud_size=32, bucket_samples=bucket, position_error=0.04)
    different = len(np.unique(quantise(xyz, np.array(built.header.origin), built.header.step), axis=0))
    assert different < 0.7 * len(xyz)
    for level in range(4):
        shown = np.concatenate([built.clouds[node].xyz for node in np.flatnonzero(built.index.level <= level)])
        assert len(np.unique(shown, axis=0)) == len(shown), level
