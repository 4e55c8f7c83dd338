"""NPZ and OBJ files; what is found by content; what is refused, in one line; what `finite` drops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpc.errors import ScanError
from lpc.points import PointBatch
from pointbuild.readers import finite, open_scan


def read(path, size=7, **options):
    return PointBatch.concatenate(open_scan(path, **options).batches(size))


def arrays(count=50):
    rng = np.random.default_rng(11)
    normal = rng.normal(size=(count, 3)).astype("f4")
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return {
        "xyz": rng.normal(size=(count, 3)) * 1e6,
        "normal": normal,
        "color": rng.integers(0, 65536, (count, 3)).astype("u2"),
        "intensity": rng.integers(0, 999, count).astype("u2"),
        "gps_time": rng.normal(size=count),
    }


@pytest.mark.parametrize("as_path", [str, Path])
@pytest.mark.parametrize("address", ["http://host/a%20b/scan.ply?x=1", "https://host/scan.laz", "s3://bucket/scan.e57"])
def test_an_address_is_no_file_and_is_said_as_it_was_given(address, as_path):
    with pytest.raises(ScanError, match="scans are read from files; fetch it first") as told:
        open_scan(as_path(address))
    assert str(told.value).startswith(f"{address}: ")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("fortran", [False, True])
def test_npz_arrays_come_back(tmp_path, save, fortran):
    given = arrays()
    save(tmp_path / "a.npz", **{name: np.asfortranarray(a) if fortran else a for name, a in given.items()})
    batch = read(tmp_path / "a.npz", attributes="all")
    assert np.array_equal(batch.xyz, given["xyz"])
    assert np.allclose(batch.normal, given["normal"], atol=1e-6)
    for name in ("color", "intensity", "gps_time"):
        assert np.array_equal(batch.attributes[name], given[name])
        assert batch.attributes[name].dtype == given[name].dtype
    assert set(read(tmp_path / "a.npz").attributes) == {"normal", "color", "intensity"}


def test_npz_arrays_must_agree(tmp_path):
    np.savez(tmp_path / "a.npz", xyz=np.zeros((5, 3)), intensity=np.zeros(4))
    with pytest.raises(ScanError, match="intensity has 4 values for 5 samples"):
        open_scan(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", places=np.zeros((5, 3)))
    with pytest.raises(ScanError, match="no array xyz"):
        open_scan(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", xyz=np.array([None] * 3))
    with pytest.raises(ScanError):
        open_scan(tmp_path / "a.npz")


def test_a_damaged_npz(tmp_path):
    np.savez(tmp_path / "a.npz", **arrays())
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[900] ^= 255
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(ScanError, match="CRC"):
        read(tmp_path / "a.npz", 1000)
    (tmp_path / "a.npz").write_bytes(data[:2000])
    with pytest.raises(ScanError):
        read(tmp_path / "a.npz")


CUBE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
QUADS = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
DIAGONAL = (np.array(CUBE) - 0.5) / np.sqrt(0.75)


@pytest.mark.parametrize("corner", ["{0}", "{0}/1", "{0}//1", "{0}/1/1", "-{1}"])
def test_obj_faces_of_every_form(tmp_path, corner):
    lines = ["# a cube", "vt 0 0"] + [f"v {x} {y} {z}" for x, y, z in CUBE]
    lines += ["f " + " ".join(corner.format(v + 1, 8 - v) for v in quad) for quad in QUADS]
    if corner.count("/") == 2:
        lines.insert(2, "vn 0 0 2")
    (tmp_path / "a.obj").write_text("\n".join(lines))
    batch = read(tmp_path / "a.obj", 3)
    assert np.array_equal(batch.xyz, np.array(CUBE, "f8"))
    expected = np.tile([0.0, 0.0, 1.0], (8, 1)) if corner.count("/") == 2 else DIAGONAL
    assert np.allclose(batch.normal, expected, atol=1e-6)
    assert read(tmp_path / "a.obj", normals="drop").normal is None


def test_obj_normals_in_order_and_colours(tmp_path):
    lines = [f"v {x} {y} {z} {x} {y} 0.2" for x, y, z in CUBE] + [f"vn {x} {y} {z}" for x, y, z in DIAGONAL]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    batch = read(tmp_path / "a.obj")
    assert np.allclose(batch.normal, DIAGONAL, atol=1e-6)
    assert batch.color[6].tolist() == [65535, 65535, 51 * 257]


def test_obj_that_names_no_vertex(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 4\n")
    with pytest.raises(ScanError, match="vertex 3 of 3"):
        read(tmp_path / "a.obj")


def test_the_real_obj(scan_path):
    path = scan_path("armadillo.obj")
    lines = path.read_text().splitlines()
    xyz = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], "f8")
    batch = read(path, 10_000)
    assert np.array_equal(batch.xyz, xyz)
    # a closed surface around its centre: most normals point away from it
    outward = (batch.normal * (batch.xyz - batch.xyz.mean(0))).sum(1)
    assert (outward > 0).mean() > 0.7


def test_content_wins_over_the_suffix(tmp_path, scan_path):
    (tmp_path / "a.xyz").write_bytes(scan_path("tinyCartesianFloatRgb.e57").read_bytes())
    (tmp_path / "b.bin").write_bytes(scan_path("bun_zipper_res4.ply").read_bytes())
    (tmp_path / "c").write_text("1 2 3\n4 5 6\n")
    (tmp_path / "d.las").write_bytes(scan_path("las14_rgbnir_extrabytes.laz").read_bytes())
    assert [len(read(tmp_path / name, 10_000)) for name in ("a.xyz", "b.bin", "c", "d.las")] == [2090, 453, 2, 37_805]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.ply", b"", "is empty"),
        ("a.las", b"not at all", "is no LAS file"),
        ("a.jpg", b"\xff\xd8\0\0", r"convert it to one of \.ply, \.las"),
        ("a.xyz", b"hello\nworld\n", "no line of three or more numbers"),
        ("a.pcd", b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\n", "without a DATA line"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n", "end_header"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "no columns x, y, z"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement face 0\nproperty float x\nend_header\n",
            "without an element vertex",
        ),
        ("a.ply", b"ply\nformat morse 1.0\nend_header\n", "cannot be read as PLY"),
        ("a.obj", b"vt 0 0\n", "no line of a vertex"),
        ("a.npz", b"PK\x03\x04rest", "cannot be read as NPZ"),
        ("a.e57", b"ASTM-E57" + bytes(100), "cannot be read as E57"),
    ],
)
def test_refused_in_one_line_that_names_the_file(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ScanError, match=said) as caught:
        read(tmp_path / name)
    assert str(caught.value).startswith(str(tmp_path / name))
    assert "\n" not in str(caught.value)


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(ScanError, match="No such file"):
        open_scan(tmp_path / "none.ply")
    with pytest.raises(ScanError, match="directory"):
        open_scan(tmp_path)


def test_every_iteration_starts_anew(tmp_path):
    np.savez(tmp_path / "a.npz", **arrays())
    scan = open_scan(tmp_path / "a.npz")
    first = [batch.xyz for batch in scan.batches(8)]
    second = [batch.xyz for batch in scan.batches(8)]
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_finite_drops_positions_and_mends_normals():
    xyz = np.array([[1, 2, 3], [np.nan, 0, np.inf], [0, np.inf, 0], [4, 5, 6]], "f8")
    normal = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 1], [np.nan, 0, 1]], "f4")
    intensity = np.array([np.nan, 1, 2, 3], "f4")
    batch, counts = finite(PointBatch(xyz, {"normal": normal, "intensity": intensity}))
    assert counts == {"nan": 1, "infinite": 1}
    assert batch.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert batch.normal.tolist() == [[0, 0, 1], [0, 0, 0]]
    assert np.isnan(batch.attributes["intensity"][0])
    assert np.isnan(normal[3, 0])
