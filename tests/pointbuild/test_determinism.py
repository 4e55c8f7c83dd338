"""The bytes of a model depend on the samples and the options, and on nothing else."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from oracles import surfaces

from lpc.points import PointBatch
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


class Unsteady(ArrayScan):
    """Gives batches of another size than asked for."""

    def __init__(self, points: PointBatch, sizes: list[int]) -> None:
        super().__init__(points)
        self._sizes = sizes

    def batches(self, size: int) -> Iterator[PointBatch]:
        begin, turn = 0, 0
        while begin < len(self.points):
            end = begin + min(self._sizes[turn % len(self._sizes)], size)
            yield self.points.take(slice(begin, end))
            begin, turn = end, turn + 1


def made(scans: list[Any], out: Path, **options: Any) -> bytes:
    chosen = BuildOptions(**{"cloud_size": 128, "threads": 1, **options})
    build_model(scans, out, chosen, clock=time.monotonic)
    return out.read_bytes()


@pytest.fixture(scope="module")
def points() -> PointBatch:
    """Unevenly dense, with a clump, duplicates and a lone outlier: all that might tell buckets apart."""
    dense = surfaces.bumpy(9000, seed=1, color=True)
    sparse = surfaces.sphere(1500, seed=2, radius=3.0, color=True)
    clump = surfaces.torus(1500, seed=3, color=True)
    clump = PointBatch(clump.xyz * 1e-4 + np.array([1.0, 2.0, 3.0]), clump.attributes)
    twice = dense.take(slice(0, 700))
    pile = PointBatch.concatenate([dense.take(slice(5, 6))] * 400)
    outlier = PointBatch(sparse.xyz[:1] + np.array([900.0, 0.0, 0.0]), {k: v[:1] for k, v in sparse.attributes.items()})
    joined = PointBatch.concatenate([dense, sparse, clump, twice, pile, outlier])
    return joined.take(np.random.default_rng(0).permutation(len(joined)))


@pytest.fixture(scope="module")
def reference(points: PointBatch, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return made([ArrayScan(points)], tmp_path_factory.mktemp("m") / "m.lpc")


@pytest.mark.parametrize("bucket", [256, 300, 777, 2000, 6000, 13_000])
@pytest.mark.parametrize("threads", [1, 2])
def test_threads_and_buckets_leave_no_trace(
    bucket: int, threads: int, points: PointBatch, reference: bytes, tmp_path: Path
) -> None:
    assert made([ArrayScan(points)], tmp_path / "m.lpc", bucket_samples=bucket, threads=threads) == reference


@pytest.mark.parametrize("block", [100, 999, 5000])
def test_blocks_leave_no_trace(block: int, points: PointBatch, reference: bytes, tmp_path: Path) -> None:
    out = tmp_path / "m.lpc"
    assert made([ArrayScan(points)], out, block_samples=block, bucket_samples=1000, threads=3) == reference


def test_batches_leave_no_trace(points: PointBatch, reference: bytes, tmp_path: Path) -> None:
    assert made([Unsteady(points, [1, 700, 13, 4096])], tmp_path / "m.lpc", bucket_samples=1000) == reference


def test_how_samples_are_cut_into_scans_leaves_no_trace(points: PointBatch, reference: bytes, tmp_path: Path) -> None:
    scans = [ArrayScan(points.take(slice(begin, begin + 5000))) for begin in range(0, len(points), 5000)]
    assert made(scans, tmp_path / "m.lpc", bucket_samples=1000) == reference


@pytest.mark.parametrize("options", [{}, {"normals": "drop", "attributes": ()}])
def test_the_order_of_the_input_leaves_no_trace(options: dict[str, Any], points: PointBatch, tmp_path: Path) -> None:
    """Without attributes many samples are equal."""
    out, bare = tmp_path / "m.lpc", PointBatch(points.xyz) if options else points
    reference = made([ArrayScan(bare)], out)
    for order in (np.arange(len(bare))[::-1], np.random.default_rng(1).permutation(len(bare))):
        half = len(bare) // 3
        scans = [ArrayScan(bare.take(order[:half])), ArrayScan(bare.take(order[half:]))]
        assert made(scans, out, bucket_samples=900, block_samples=1111, threads=2) == reference


def test_the_order_of_a_larger_input_leaves_no_trace_in_the_estimated_spacing(tmp_path: Path) -> None:
    points = surfaces.bumpy(90_000, seed=3, color=True)
    out = tmp_path / "m.lpc"
    reference = made([ArrayScan(points)], out, cloud_size=2048)
    mixed = points.take(np.random.default_rng(1).permutation(len(points)))
    assert made([Unsteady(mixed, [20_000, 1, 7777])], out, cloud_size=2048, threads=2) == reference


def test_memory_leaves_no_trace(points: PointBatch, reference: bytes, tmp_path: Path) -> None:
    assert made([ArrayScan(points)], tmp_path / "m.lpc", memory_bytes=8 << 30, threads=2) == reference


def test_the_seed_does(points: PointBatch, reference: bytes, tmp_path: Path) -> None:
    assert made([ArrayScan(points)], tmp_path / "m.lpc", seed=1) != reference
