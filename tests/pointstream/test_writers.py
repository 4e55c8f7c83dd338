"""What the writers write is read back by the libraries of each format."""

from __future__ import annotations

import laspy
import numpy as np
import pyproj
import pytest
from plyfile import PlyData

from lpc.errors import StoreError
from lpc.points import PointBatch
from pointstream.writers import SUFFIXES, Target, write_points

SHAPES = {"normal": (3,), "color": (3,)}


def samples(count=1000, color="u1", scalars=(("intensity", "u2"), ("classification", "u1"))):
    rng = np.random.default_rng(1)
    normal = rng.normal(size=(count, 3)).astype("f4")
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    values = {"normal": normal, "color": rng.integers(0, np.iinfo(color).max, (count, 3)).astype(color)}
    values |= {name: rng.integers(0, 16, count).astype(dtype) for name, dtype in scalars}
    return PointBatch(rng.random((count, 3)) * (900, 400, 30) + (858000, 8505000, 3500), values)


def write(path, batch, size=300, **changes):
    batches = (batch.take(slice(start, start + size)) for start in range(0, len(batch), size))
    told = {
        "count": len(batch),
        "attributes": {name: values.dtype for name, values in batch.attributes.items()},
        "bounds": (*batch.xyz.min(0, initial=1e9), *batch.xyz.max(0, initial=-1e9)),
    }
    return write_points(path, batches, Target(**{**told, **changes}))


@pytest.mark.parametrize("color", ["u1", "u2"])
def test_ply(tmp_path, color):
    batch = samples(color=color, scalars=[("intensity", "u2"), ("gps_time", "f8"), ("serial", "i8")])
    assert write(tmp_path / "a.ply", batch) == []
    ply = PlyData.read(tmp_path / "a.ply")
    rows = ply["vertex"].data
    assert not ply.text
    assert ply.byte_order == "<"
    for axis in range(3):
        assert rows.dtype["xyz"[axis]] == np.float64
        assert np.array_equal(rows["xyz"[axis]], batch.xyz[:, axis])
        assert np.array_equal(rows[("nx", "ny", "nz")[axis]], batch.normal[:, axis])
        assert np.array_equal(rows[("red", "green", "blue")[axis]], batch.color[:, axis])
    assert rows.dtype["red"] == np.dtype(color)
    for name in ("intensity", "gps_time", "serial"):
        assert np.array_equal(rows[name], batch.attributes[name])


def test_npz(tmp_path):
    batch = samples(color="u2", scalars=[("intensity", "u2"), ("gps_time", "f8"), ("serial", "i8")])
    assert write(tmp_path / "a.npz", batch) == []
    with np.load(tmp_path / "a.npz") as arrays:
        assert set(arrays) == {"xyz", *batch.attributes}
        assert np.array_equal(arrays["xyz"], batch.xyz)
        for name, values in batch.attributes.items():
            assert arrays[name].dtype == values.dtype
            assert np.array_equal(arrays[name], values)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("color", ["u1", "u2"])
def test_las_and_laz(tmp_path, suffix, color):
    scalars = [("intensity", "u2"), ("classification", "u1"), ("return_number", "u1"), ("gps_time", "f8"),
               ("scan_angle_rank", "i1"), ("reflectance", "f4")]  # fmt: skip
    batch = samples(color=color, scalars=scalars)
    crs = pyproj.CRS.from_epsg(32718)
    assert write(tmp_path / f"a.{suffix}", batch, crs=crs.to_wkt()) == []
    las = laspy.read(tmp_path / f"a.{suffix}")
    assert las.header.are_points_compressed == (suffix == "laz")
    assert np.abs(las.xyz - batch.xyz).max() < 1e-6
    assert np.allclose(las.header.mins, batch.xyz.min(0), atol=0.001)
    assert np.array_equal(las.red, batch.color[:, 0] * np.uint16(257 if color == "u1" else 1))
    assert np.array_equal(np.stack([las.nx, las.ny, las.nz], axis=1), batch.normal)
    for name, _ in scalars:
        assert np.array_equal(np.asarray(las[name]), batch.attributes[name]), name
    assert las.header.parse_crs().to_epsg() == 32718


def test_las_keeps_a_lattice_exactly(tmp_path):
    lattice = np.random.default_rng(3).integers(0, 2**31 + 10**6, (500, 3))
    origin, step = np.array([858000.1, 8505000.7, -3.3]), 1 / 3e5
    batch = PointBatch(origin + step * lattice)
    write(tmp_path / "a.las", batch, origin=origin, step=step, position_error=step)
    las = laspy.read(tmp_path / "a.las")
    assert las.header.scales.tolist() == [step] * 3
    assert np.abs(las.xyz - batch.xyz).max() < 1e-8


def test_las_is_as_fine_as_it_can_be_without_a_stated_error(tmp_path):
    xyz = np.random.default_rng(2).normal(size=(100, 3)) * 1e-6
    write(tmp_path / "a.las", PointBatch(xyz))
    assert np.abs(laspy.read(tmp_path / "a.las").xyz - xyz).max() < 1e-14
    flat = np.zeros((5, 3))
    write(tmp_path / "b.las", PointBatch(flat))
    assert np.array_equal(laspy.read(tmp_path / "b.las").xyz, flat)


def test_las_keeps_values_that_its_own_fields_are_too_narrow_for(tmp_path):
    intensity = np.linspace(0, 1, 50, dtype="f4")
    write(tmp_path / "a.laz", PointBatch(np.zeros((50, 3)), {"intensity": intensity}))
    assert np.array_equal(laspy.read(tmp_path / "a.laz")["intensity_"], intensity)


def test_xyz(tmp_path):
    batch = samples(scalars=[("intensity", "u2"), ("gps_time", "f8")])
    assert write(tmp_path / "a.xyz", batch, position_error=0.01) == ["gps_time"]
    table = np.loadtxt(tmp_path / "a.xyz")
    assert np.linalg.norm(table[:, :3] - batch.xyz, axis=1).max() < 1e-5
    assert np.array_equal(table[:, 3], batch.attributes["intensity"])
    assert np.array_equal(table[:, 4:7], batch.color)
    assert np.allclose(table[:, 7:], batch.normal, atol=1e-6)
    write(tmp_path / "b.xyz", PointBatch(batch.xyz))
    assert np.array_equal(np.loadtxt(tmp_path / "b.xyz"), batch.xyz)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_samples_at_all(tmp_path, suffix):
    write(tmp_path / f"a{suffix}", samples(0), bounds=(0,) * 6)
    assert (tmp_path / f"a{suffix}").exists()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_same_samples_give_the_same_bytes(tmp_path, suffix):
    for folder in ("1", "2"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / f"a{suffix}", samples())
    assert (tmp_path / "1" / f"a{suffix}").read_bytes() == (tmp_path / "2" / f"a{suffix}").read_bytes()


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("count", [999, 1001])
def test_a_failure_leaves_what_stood_there(tmp_path, suffix, count):
    path = tmp_path / f"a{suffix}"
    path.write_text("before")
    with pytest.raises(StoreError, match="samples came"):
        write(path, samples(), count=count)
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupt_leaves_nothing(tmp_path):
    def batches():
        yield samples(10)
        raise KeyboardInterrupt

    attributes = {name: values.dtype for name, values in samples(1).attributes.items()}
    with pytest.raises(KeyboardInterrupt):
        write_points(
            tmp_path / "a.laz",
            batches(),
            Target(count=20, attributes=attributes, bounds=(858000, 8505000, 3500, 858900, 8505400, 3530)),
        )
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_said_in_one_line(tmp_path):
    with pytest.raises(StoreError, match=r"use one of \.ply"):
        write(tmp_path / "a.docx", samples())
    with pytest.raises(StoreError, match="a position outside"):
        write(tmp_path / "a.las", samples(), bounds=(0, 0, 0, 1, 1, 1))
    with pytest.raises(StoreError, match="No such file"):
        write(tmp_path / "none" / "a.ply", samples())
    with pytest.raises(StoreError, match="a batch came with"):
        write(tmp_path / "a.ply", samples(), attributes={})
    assert not list(tmp_path.iterdir())
