"""PCD files written by pypcd4, and compressed files of every shape that LZF takes."""

from __future__ import annotations

import lzf
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pypcd4 import Encoding, PointCloud

from lpc.errors import ScanError
from lpc.points import PointBatch
from pointbuild.readers import finite, open_scan

ENCODINGS = [Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED]


def read(path, size=60, **options):
    return PointBatch.concatenate(open_scan(path, **options).batches(size))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding(tmp_path, encoding):
    rng = np.random.default_rng(6)
    xyz = np.round(rng.normal(size=(200, 3)), 4).astype("f4")
    xyz[5] = np.nan
    color = rng.integers(0, 256, (200, 3))
    packed = (color @ (1 << 16, 1 << 8, 1)).astype("u4")
    normals = np.round(rng.normal(size=(200, 3)), 3).astype("f4")
    intensity, ring = rng.integers(0, 99, 200).astype("f4"), rng.integers(0, 64, 200).astype("u2")
    fields = ("x", "y", "z", "rgb", "normal_x", "normal_y", "normal_z", "intensity", "ring")
    types = (*(np.float32,) * 3, np.uint32, *(np.float32,) * 4, np.uint16)
    columns = [*xyz.T, packed, *normals.T, intensity, ring]
    PointCloud.from_points(columns, fields, types).save(tmp_path / "a.pcd", encoding)
    scan = open_scan(tmp_path / "a.pcd", attributes="all")
    batch = PointBatch.concatenate(scan.batches(60))
    assert scan.info.samples_hint == 200
    assert np.array_equal(batch.xyz, xyz.astype("f8"), equal_nan=True)
    assert np.array_equal(batch.color, color)
    assert np.array_equal(batch.attributes["ring"], ring)
    assert np.array_equal(batch.attributes["intensity"], intensity)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    assert np.allclose(batch.normal, normals / length, atol=1e-5)
    assert finite(batch)[1] == {"nan": 1, "infinite": 0}
    assert set(open_scan(tmp_path / "a.pcd").info.attributes) == {"normal", "color", "intensity"}


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 255), st.integers(1, 700)), min_size=12, max_size=60), st.integers(0, 2**32))
def test_lzf_matches_its_library(tmp_path, runs, seed):
    # runs of one byte compress to long references, noise between them to literals
    rng = np.random.default_rng(seed)
    data = b"".join(bytes([value]) * run + rng.bytes(run // 20) for value, run in runs)
    data = data[: len(data) - len(data) % 12]
    compressed = lzf.compress(data)
    if compressed is None:
        return
    count = len(data) // 12
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE U U U\nCOUNT 1 1 1\n"
    head += f"WIDTH {count}\nHEIGHT 1\nPOINTS {count}\nDATA binary_compressed\n"
    sizes = np.array([len(compressed), len(data)], "<u4").tobytes()
    (tmp_path / "a.pcd").write_bytes(head.encode() + sizes + compressed)
    expected = np.frombuffer(data, "<u4").reshape(3, count).T
    assert np.array_equal(read(tmp_path / "a.pcd").xyz, expected.astype("f8"))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_file_cut_short_is_told(tmp_path, encoding):
    xyz = np.random.default_rng(7).normal(size=(500, 3)).astype("f4")
    PointCloud.from_xyz_points(xyz).save(tmp_path / "a.pcd", encoding)
    data = (tmp_path / "a.pcd").read_bytes()
    (tmp_path / "a.pcd").write_bytes(data[: len(data) // 2])
    with pytest.raises(ScanError, match="declares 500 samples, holds"):
        read(tmp_path / "a.pcd")


def test_a_compressed_size_that_lies(tmp_path):
    xyz = np.zeros((500, 3), "f4")
    PointCloud.from_xyz_points(xyz).save(tmp_path / "a.pcd", Encoding.BINARY_COMPRESSED)
    data = (tmp_path / "a.pcd").read_bytes()
    start = data.index(b"binary_compressed\n") + len(b"binary_compressed\n")
    (tmp_path / "a.pcd").write_bytes(data[: start + 4] + b"\xff\xff\xff\xff" + data[start + 8 :])
    with pytest.raises(ScanError, match="4,294,967,295 bytes declared"):
        read(tmp_path / "a.pcd")


def test_the_real_organised_cloud(scan_path):
    path = scan_path("table_scene_mug_stereo_textured.pcd")
    oracle = PointCloud.from_path(path)
    batch = read(path, 100_000)
    assert np.array_equal(batch.xyz, oracle.numpy(("x", "y", "z")).astype("f8"), equal_nan=True)
    assert np.array_equal(batch.color[:, 0], (oracle.pc_data["rgb"].copy().view("u4") >> 16) & 255)
    kept, counts = finite(batch)
    assert (len(kept), counts["nan"]) == (209_280, 97_920)
