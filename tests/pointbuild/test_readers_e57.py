"""E57 files written by pye57: poses, invalid samples, colours, several scans."""

from __future__ import annotations

import numpy as np
import pye57
import pytest

from lpc.errors import ScanError
from lpc.points import PointBatch
from pointbuild.readers import finite, open_scan


def read(path, size=60, **options):
    return PointBatch.concatenate(open_scan(path, **options).batches(size))


def columns(rng, count, *, color=True):
    data = {name: rng.normal(size=count) for name in ("cartesianX", "cartesianY", "cartesianZ")}
    data["intensity"] = rng.random(count).astype("f4")
    if color:
        data |= {name: rng.integers(0, 256, count).astype("u1") for name in ("colorRed", "colorGreen", "colorBlue")}
    return data


def xyz_of(data):
    return np.stack([data[name] for name in ("cartesianX", "cartesianY", "cartesianZ")], axis=1)


def test_all_scans_with_their_poses(tmp_path):
    rng = np.random.default_rng(8)
    first, second = columns(rng, 150), columns(rng, 70, color=False)
    quarter = np.array([np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)])  # 90 degrees about z
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        file.write_scan_raw(first)
        file.write_scan_raw(second, rotation=quarter, translation=np.array([10.0, 20.0, 30.0]))
    scan = open_scan(tmp_path / "a.e57")
    batches = list(scan.batches(60))
    batch = PointBatch.concatenate(batches)
    assert max(map(len, batches)) == 60
    assert scan.info.samples_hint == 220
    turned = xyz_of(second) @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + (10, 20, 30)
    assert np.allclose(batch.xyz[:150], xyz_of(first), atol=1e-12)
    assert np.allclose(batch.xyz[150:], turned, atol=1e-12)
    assert batch.color.dtype == np.uint8
    assert np.array_equal(batch.color[:150, 1], first["colorGreen"])
    assert not batch.color[150:].any()
    assert np.array_equal(batch.attributes["intensity"], np.concatenate([first["intensity"], second["intensity"]]))


def test_invalid_samples_are_dropped_and_counted(tmp_path):
    rng = np.random.default_rng(9)
    data = columns(rng, 100)
    data["cartesianInvalidState"] = (np.arange(100) % 4 == 1).astype("i1")
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        file.write_scan_raw(data)
    batch, counts = finite(read(tmp_path / "a.e57"))
    assert counts == {"nan": 25, "infinite": 0}
    assert np.allclose(batch.xyz, xyz_of(data)[np.arange(100) % 4 != 1])


def test_a_file_cut_short_is_told(tmp_path):
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        file.write_scan_raw(columns(np.random.default_rng(10), 5000))
    data = (tmp_path / "a.e57").read_bytes()
    (tmp_path / "a.e57").write_bytes(data[: len(data) // 2])
    with pytest.raises(ScanError):
        read(tmp_path / "a.e57")


@pytest.mark.parametrize(("name", "count"), [("bunnyInt32.e57", 30_571), ("tinyCartesianFloatRgb.e57", 2090)])
def test_real_scans(scan_path, name, count):
    path = scan_path(name)
    with pye57.E57(str(path)) as file:
        oracle = file.read_scan(0, colors=name.startswith("tiny"), ignore_missing_fields=True)
    batch = read(path, 1000)
    assert len(batch) == count
    assert np.array_equal(batch.xyz, xyz_of(oracle))
    if name.startswith("tiny"):
        assert np.array_equal(batch.color[:, 2], oracle["colorBlue"])
