"""LAS and LAZ files written by laspy come back as laspy reads them."""

from __future__ import annotations

import laspy
import numpy as np
import pyproj
import pytest

from lpc.errors import ScanError
from lpc.points import PointBatch
from pointbuild.readers import open_scan


def read(path, size=60, **options):
    return PointBatch.concatenate(open_scan(path, **options).batches(size))


def write(path, point_format, count=250, crs=None, extra=()):
    rng = np.random.default_rng(point_format)
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.3")
    header.scales, header.offsets = [0.001, 0.002, 0.25], [500000.0, -4e6, 10.0]
    for name, dtype in extra:
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=dtype))
    if crs is not None:
        header.add_crs(crs)
    las = laspy.LasData(header)
    shape = laspy.ScaleAwarePointRecord.zeros(count, header=header)
    las.points = shape
    for name in ("X", "Y", "Z"):
        las[name] = rng.integers(-(2**31), 2**31 - 1, count)
    for name in las.point_format.dimension_names:
        if name in ("X", "Y", "Z"):
            continue
        bits = las.point_format.dimension_by_name(name).num_bits
        las[name] = rng.integers(0, min(2**bits, 100), count)
    las.write(path)
    return laspy.read(path)


@pytest.mark.parametrize("point_format", range(11))
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_every_point_format(tmp_path, point_format, suffix):
    if suffix == ".laz" and point_format in (4, 5, 9, 10):
        pytest.skip("lazrs compresses no waveforms")
    oracle = write(tmp_path / f"a{suffix}", point_format, extra=[("nx", "f4"), ("reflectance", "u2")])
    scan = open_scan(tmp_path / f"a{suffix}", attributes="all")
    batch = PointBatch.concatenate(scan.batches(60))
    assert np.array_equal(batch.xyz, oracle.xyz)
    assert ("color" in batch.attributes) == (point_format in (2, 3, 5, 7, 8, 10))
    if "color" in batch.attributes:
        assert np.array_equal(batch.color, np.stack([oracle.red, oracle.green, oracle.blue], axis=1))
        assert batch.color.dtype == np.uint16
    for name in set(oracle.point_format.dimension_names) - {"X", "Y", "Z", "red", "green", "blue"}:
        assert np.array_equal(batch.attributes[name], np.asarray(oracle[name])), name
    assert {name: values.dtype for name, values in batch.attributes.items()} == dict(scan.info.attributes)
    few = open_scan(tmp_path / f"a{suffix}")
    assert set(few.info.attributes) - {"color"} == {"intensity", "classification"}
    batch = PointBatch.concatenate(few.batches(1000))
    assert np.array_equal(batch.xyz, oracle.xyz)
    assert np.array_equal(batch.attributes["intensity"], oracle.intensity)
    assert np.array_equal(batch.attributes["classification"], oracle.classification)
    assert "reflectance" in few.info.left_out


@pytest.mark.parametrize("point_format", [1, 7])
def test_the_coordinate_system_and_bounds(tmp_path, point_format):
    oracle = write(tmp_path / "a.las", point_format, crs=pyproj.CRS.from_epsg(32718))
    info = open_scan(tmp_path / "a.las").info
    assert pyproj.CRS.from_wkt(info.crs).to_epsg() == 32718
    assert info.bounds_hint == (*oracle.header.mins, *oracle.header.maxs)
    assert info.samples_hint == 250


def test_normals_in_extra_dimensions(tmp_path):
    write(tmp_path / "a.laz", 6, extra=[("NormalX", "f4"), ("NormalY", "f4"), ("NormalZ", "f4")])
    batch = read(tmp_path / "a.laz")
    assert np.allclose(np.linalg.norm(batch.normal, axis=1), 1, atol=1e-5)
    assert read(tmp_path / "a.laz", normals="drop").normal is None


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.99])
def test_a_file_cut_short_is_told(tmp_path, suffix, kept):
    path = tmp_path / f"a{suffix}"
    write(path, 2, count=150_000)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(ScanError, match="150,000") as caught:
        read(path, 10_000)
    assert "\n" not in str(caught.value)


def test_a_header_that_declares_too_much(tmp_path):
    path = tmp_path / "a.laz"
    write(path, 6, count=100)
    data = bytearray(path.read_bytes())
    data[247:255] = (10**12).to_bytes(8, "little")
    path.write_bytes(data)
    with pytest.raises(ScanError, match="1,000,000,000,000"):
        read(path, 100_000)


def test_extended_records_longer_than_the_file_are_not_read(tmp_path):
    path = tmp_path / "a.las"
    write(path, 6, count=100)
    data = bytearray(path.read_bytes())
    data[235:243] = len(data).to_bytes(8, "little")
    data[243:247] = (1).to_bytes(4, "little")
    head = bytearray(60)
    head[20:28] = (1 << 60).to_bytes(8, "little")
    path.write_bytes(data + head)
    assert len(read(path)) == 100


def test_garbage_behind_the_magic(tmp_path):
    path = tmp_path / "a.las"
    path.write_bytes(b"LASF" + bytes(range(256)) * 4)
    with pytest.raises(ScanError):
        read(path)


@pytest.mark.parametrize("name", ["ohuay_drone.laz", "lone-star.copc.laz", "las14_rgbnir_extrabytes.laz"])
def test_real_scans(scan_path, name):
    path = scan_path(name)
    oracle = laspy.read(path)
    scan = open_scan(path)
    batch = PointBatch.concatenate(scan.batches(500_000))
    assert np.array_equal(batch.xyz, oracle.xyz)
    assert np.array_equal(batch.attributes["intensity"], oracle.intensity)
    assert scan.info.crs is not None
