"""Estimated normals on shapes whose normals are known, whole and in blocks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpc.errors import BuildError, ScanError
from lpc.points import PointBatch
from pointbuild.normals import OrientationField, block_normals, estimate
from pointbuild.normals.blocks import Blocks, CoarseSample
from pointbuild.normals.fit import find_neighbours, fit_normals
from pointbuild.readers import open_scan
from pointbuild.readers.scan import ScanInfo


class Arrays:
    """A scan of arrays."""

    def __init__(self, batch, crs=None):
        self.batch = batch
        attributes = {name: values.dtype for name, values in batch.attributes.items()}
        self.info = ScanInfo(path=Path("arrays"), attributes=attributes, crs=crs)

    def batches(self, size):
        for start in range(0, len(self.batch), size):
            yield self.batch.take(slice(start, start + size))


def sphere(count=20_000):
    normals = np.random.default_rng(1).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals * 2 + (1e6, 0, -7), normals


def torus(count=20_000):
    u, v = np.random.default_rng(2).random((2, count)) * 2 * np.pi
    normals = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=1)
    return normals + 3 * np.stack([np.cos(u), np.sin(u), 0 * u], axis=1), normals


def box(count=20_000):
    rng = np.random.default_rng(3)
    side = rng.integers(0, 6, count)
    xyz, normals = rng.random((count, 3)), np.zeros((count, 3))
    xyz[np.arange(count), side // 2] = side % 2
    normals[np.arange(count), side // 2] = side % 2 * 2 - 1
    return xyz * (3, 2, 1), normals


@pytest.mark.parametrize("shape", [sphere, torus, box])
def test_closed_shapes_in_blocks_point_outward(tmp_path, shape):
    xyz, normals = shape()
    index = np.arange(len(xyz), dtype="u4")
    scan = estimate(Arrays(PointBatch(xyz, {"index": index})), tmp_path, block=3000, coarse=4000)
    batch = PointBatch.concatenate(scan.batches(1234))
    order = batch.attributes["index"]
    assert np.array_equal(np.sort(order), index)
    assert np.array_equal(batch.xyz, xyz[order])
    cosines = (batch.normal * normals[order]).sum(1)
    assert (cosines > 0).mean() > 0.999
    assert np.median(cosines) > 0.999
    assert scan.info.samples_hint == len(xyz)
    assert scan.info.bounds_hint == (*xyz.min(0), *xyz.max(0))
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["samples"]


def test_the_normals_do_not_depend_on_batches_or_runs(tmp_path):
    xyz, _ = torus(5000)

    class Ragged(Arrays):
        def batches(self, size):
            yield from super().batches(777)

    results = []
    for k, scan in enumerate((Arrays(PointBatch(xyz)), Ragged(PointBatch(xyz)))):
        (tmp_path / str(k)).mkdir()
        made = estimate(scan, tmp_path / str(k), block=1500, coarse=1000)
        batch = PointBatch.concatenate(made.batches(100))
        results.append(np.concatenate([batch.xyz, batch.normal], axis=1))
    assert np.array_equal(*(np.unique(result, axis=0) for result in results))
    assert np.array_equal(*results)


def test_blocks_agree_with_the_whole(tmp_path):
    xyz, _ = torus(20_000)
    field = OrientationField.build(xyz[::10].copy())
    whole = block_normals(xyz, len(xyz), field)
    scan = estimate(Arrays(PointBatch(xyz, {"index": np.arange(len(xyz))})), tmp_path, block=2500, coarse=2000)
    batch = PointBatch.concatenate(scan.batches(10**6))
    cosines = (batch.normal * whole[batch.attributes["index"]]).sum(1)
    assert (cosines > 0.9999).mean() > 0.999


def test_land_points_up(tmp_path):
    rng = np.random.default_rng(4)
    xy = rng.random((5000, 2)) * 100
    xyz = np.column_stack([xy, 3 * np.sin(xy[:, 0] / 9) * np.cos(xy[:, 1] / 7)])
    scan = estimate(Arrays(PointBatch(xyz), crs="PROJCRS[...]"), tmp_path, block=1000, coarse=1000)
    batch = PointBatch.concatenate(scan.batches(10**6))
    assert (batch.normal[:, 2] > 0).all()


def test_records_that_are_not_finite_stay_in_the_count(tmp_path):
    xyz, _ = sphere(3000)
    xyz[::100] = np.nan
    scan = estimate(Arrays(PointBatch(xyz)), tmp_path)
    batch = PointBatch.concatenate(scan.batches(700))
    assert len(batch) == 3000
    assert np.isnan(batch.xyz[-30:]).all()
    assert not batch.normal[-30:].any()
    with pytest.raises(ScanError, match="finite"):
        estimate(Arrays(PointBatch(np.full((9, 3), np.nan))), tmp_path)


def test_two_scans_in_one_scratch_and_too_little_memory(tmp_path):
    one, two = (estimate(Arrays(PointBatch(shape(1000)[0])), tmp_path) for shape in (sphere, torus))
    assert np.median(PointBatch.concatenate(one.batches(1000)).xyz[:, 0]) > 1e5
    assert np.median(PointBatch.concatenate(two.batches(1000)).xyz[:, 0]) < 1e5
    with pytest.raises(BuildError, match="--memory"):
        estimate(Arrays(PointBatch(sphere(9)[0])), tmp_path, 64 << 20)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 17])
def test_few_samples(tmp_path, count):
    xyz = np.random.default_rng(5).random((count, 3))
    batch = PointBatch.concatenate(estimate(Arrays(PointBatch(xyz)), tmp_path).batches(10))
    length = np.linalg.norm(batch.normal, axis=1)
    assert np.allclose(length, 1 if count > 2 else 0, atol=1e-5)


def test_lines_and_coincident_samples_have_no_normal(tmp_path):
    line = np.arange(300)[:, None] * np.array([[1.0, 2.0, 3.0]])
    batch = PointBatch.concatenate(estimate(Arrays(PointBatch(line)), tmp_path).batches(1000))
    assert not batch.normal.any()
    batch = PointBatch.concatenate(estimate(Arrays(PointBatch(np.ones((300, 3)))), tmp_path).batches(1000))
    assert not batch.normal.any()


def test_the_closed_form_matches_a_library():
    xyz = np.random.default_rng(6).normal(size=(500, 3)) * (3, 1, 0.2)
    neighbours, reach = find_neighbours(xyz, 12)
    around = xyz[neighbours] - xyz[neighbours].mean(1, keepdims=True)
    expected = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    assert np.allclose(np.abs((fit_normals(xyz, neighbours) * expected).sum(1)), 1, atol=1e-6)
    assert np.allclose(reach, np.linalg.norm(xyz[neighbours[:, -1]] - xyz, axis=1))


def test_every_sample_is_in_one_block_and_near_ones_are_in_its_halo():
    xyz = np.random.default_rng(7).random((20_000, 3)) * (5, 2, 0.01)
    coarse = CoarseSample(2000)
    for start in range(0, len(xyz), 999):
        coarse.add(xyz[start : start + 999])
    assert 1000 <= len(coarse.xyz) <= 2000
    blocks = Blocks(coarse.xyz, find_neighbours(coarse.xyz)[1], 16, len(xyz), 2500)
    parts = list(blocks.parts(xyz))
    assert np.array_equal(np.sort(np.concatenate([core for _, core, _ in parts])), np.arange(len(xyz)))
    assert 8 <= blocks.count <= 20
    nearest = find_neighbours(xyz)[0]
    for _, core, halo in parts:
        assert np.isin(nearest[core], np.concatenate([core, halo])).mean() > 0.9999
        assert not np.isin(core, halo).any()


def test_the_dragon_agrees_with_its_faces(tmp_path, scan_path):
    path = scan_path("stanford_dragon.ply")
    faces = PointBatch.concatenate(open_scan(path).batches(1 << 20))
    scan = estimate(open_scan(path, normals="estimate"), tmp_path, block=1 << 17)
    batch = PointBatch.concatenate(scan.batches(1 << 20))
    order, given = np.lexsort(batch.xyz.T), np.lexsort(faces.xyz.T)
    assert np.array_equal(batch.xyz[order], faces.xyz[given])
    cosines = (batch.normal[order] * faces.normal[given]).sum(1)
    assert (cosines > 0).mean() > 0.985
    assert np.degrees(np.arccos(np.median(cosines))) < 3
