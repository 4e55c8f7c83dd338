"""PLY files written by plyfile, or byte by byte, come back as they were."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from lpc.errors import ScanError
from lpc.points import PointBatch
from pointbuild.readers import finite, open_scan

ENCODINGS = {"ascii": {"text": True}, "little": {"byte_order": "<"}, "big": {"byte_order": ">"}}


def read(path, size=7, **options):
    return PointBatch.concatenate(open_scan(path, **options).batches(size))


def cube_faces():
    return [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]


CUBE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], "f8")


def big_endian(elements):
    names = {"u1": "uchar", "i2": "short", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
    head, body = "ply\nformat binary_big_endian 1.0\n", b""
    for element, rows in elements.items():
        head += f"element {element} {len(rows)}\n"
        for name in rows.dtype.names:
            value = rows[name][0]
            kind = names[value.dtype.str[1:]]
            head += f"property list ushort {kind} {name}\n" if value.ndim else f"property {kind} {name}\n"
        for row in rows:
            for name in rows.dtype.names:
                value = row[name]
                body += np.array(len(value), ">u2").tobytes() if value.ndim else b""
                body += np.array(value, value.dtype.newbyteorder(">")).tobytes()
    return head.encode() + b"end_header\n" + body


def vertices(count=50, seed=1):
    rng = np.random.default_rng(seed)
    fields = [(name, "f8") for name in "xyz"] + [(name, "f4") for name in ("nx", "ny", "nz")]
    fields += [(name, "u1") for name in ("red", "green", "blue")] + [("scalar_Intensity", "f4"), ("confidence", "i2")]
    rows = np.zeros(count, fields)
    for name in rows.dtype.names:
        values = rng.normal(size=count) * 100
        rows[name] = np.abs(values).astype(int) if rows.dtype[name].kind in "iu" else values
    return rows


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_vertices_come_back_in_every_encoding(tmp_path, encoding):
    rows = vertices()
    PlyData([PlyElement.describe(rows, "vertex")], **ENCODINGS[encoding]).write(tmp_path / "a.ply")
    scan = open_scan(tmp_path / "a.ply", attributes="all")
    batch = PointBatch.concatenate(scan.batches(7))
    assert scan.info.samples_hint == 50
    assert np.array_equal(batch.xyz, np.stack([rows[name] for name in "xyz"], axis=1))
    assert np.array_equal(batch.color, np.stack([rows[name] for name in ("red", "green", "blue")], axis=1))
    assert np.array_equal(batch.attributes["intensity"], rows["scalar_Intensity"])
    assert np.array_equal(batch.attributes["confidence"], rows["confidence"])
    given_normals = np.stack([rows[name] for name in ("nx", "ny", "nz")], axis=1)
    expected = given_normals / np.linalg.norm(given_normals, axis=1, keepdims=True)
    assert np.allclose(batch.normal, expected, atol=1e-6)
    assert {name: values.dtype for name, values in batch.attributes.items()} == dict(scan.info.attributes)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("size", [1, 3, 1000])
def test_a_cube_of_quads_has_diagonal_normals(tmp_path, encoding, size):
    rows = np.array([tuple(p) for p in CUBE], [(name, "f4") for name in "xyz"])
    faces = np.empty(6, [("vertex_indices", "O"), ("flags", "u1")])
    faces["vertex_indices"] = [np.array(face, "i4") for face in cube_faces()]
    elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, **ENCODINGS[encoding]).write(tmp_path / "a.ply")
    expected = (CUBE - 0.5) / np.linalg.norm(CUBE - 0.5, axis=1, keepdims=True)
    assert np.allclose(read(tmp_path / "a.ply", size).normal, expected, atol=1e-6)
    assert read(tmp_path / "a.ply", normals="keep").normal is None
    assert read(tmp_path / "a.ply", normals="drop").normal is None


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_lists_before_and_inside_the_vertices_are_stepped_over(tmp_path, encoding):
    rng = np.random.default_rng(2)
    before = np.empty(30, [("strip", "O"), ("weight", "f4")])
    before["strip"] = [rng.integers(0, 99, rng.integers(0, 9)).astype("i2") for _ in before]
    before["weight"] = 1
    rows = np.empty(40, [("x", "f4"), ("tags", "O"), ("y", "f4"), ("z", "f8")])
    rows["x"], rows["y"], rows["z"] = rng.normal(size=(3, 40))
    rows["tags"] = [rng.integers(0, 99, rng.integers(0, 5)).astype("u4") for _ in rows]
    faces = np.empty(2, [("vertex_index", "O")])
    faces["vertex_index"] = [np.array([0, 1, 2], "u4"), np.array([0, 2, 3, 4, 5], "u4")]
    named = {"before": before, "vertex": rows, "face": faces}
    if encoding == "big":  # plyfile writes single values beside lists in the machine's byte order
        (tmp_path / "a.ply").write_bytes(big_endian(named))
    else:
        elements = [PlyElement.describe(rows, name) for name, rows in named.items()]
        PlyData(elements, **ENCODINGS[encoding]).write(tmp_path / "a.ply")
    batch = read(tmp_path / "a.ply")
    assert np.array_equal(batch.xyz, np.stack([rows[name] for name in "xyz"], axis=1).astype("f8"))
    touched = np.linalg.norm(batch.normal, axis=1) > 0.5
    assert touched[:6].all()
    assert not touched[6:].any()


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.lists(st.integers(0, 19), min_size=0, max_size=7), min_size=1, max_size=30), st.integers(1, 9))
def test_polygons_of_any_size_match_a_loop_over_faces(tmp_path, polygons, size):
    rng = np.random.default_rng(3)
    xyz = rng.normal(size=(20, 3))
    rows = np.array([tuple(p) for p in xyz], [(name, "f8") for name in "xyz"])
    faces = np.empty(len(polygons), [("vertex_indices", "O")])
    for k, polygon in enumerate(polygons):
        faces["vertex_indices"][k] = np.array(polygon, "i4")
    elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, "face", len_types={}, val_types={})]
    PlyData(elements, byte_order="<").write(tmp_path / "a.ply")
    sums = np.zeros((20, 3))
    for polygon in polygons:
        if len(polygon) < 3:
            continue
        area = sum(np.cross(xyz[a], xyz[b]) for a, b in zip(polygon, [*polygon[1:], polygon[0]], strict=True))
        for corner in polygon:
            sums[corner] += area
    normals = read(tmp_path / "a.ply", size).normal
    length = np.linalg.norm(sums, axis=1)
    clear = length > 1e-3
    assert np.allclose(normals[clear], sums[clear] / length[clear, None], atol=1e-3)
    unused = np.setdiff1d(np.arange(20), [corner for polygon in polygons if len(polygon) > 2 for corner in polygon])
    assert not normals[unused].any()


def test_carriage_returns_and_comments_in_the_header(tmp_path):
    head = "ply\r\nformat ascii 1.0\r\ncomment by hand\r\nelement vertex 2\r\n"
    head += "property float x\r\nproperty float y\r\nproperty float z\r\nend_header\r\n"
    (tmp_path / "a.ply").write_bytes((head + "1 2 3\r\n\r\n4 5 nan\r\n").encode())
    batch, counts = finite(read(tmp_path / "a.ply"))
    assert batch.xyz.tolist() == [[1, 2, 3]]
    assert counts == {"nan": 1, "infinite": 0}


def test_float_colours_become_sixteen_bits(tmp_path):
    fields = [(name, "f4") for name in ("x", "y", "z", "red", "green", "blue")]
    rows = np.array([(0, 0, 0, 0, 1, 51 / 255)], fields)
    PlyData([PlyElement.describe(rows, "vertex")]).write(tmp_path / "a.ply")
    assert read(tmp_path / "a.ply").color.tolist() == [[0, 65535, 51 * 257]]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("part", ["vertex", "face"])
def test_a_file_cut_short_is_told(tmp_path, encoding, part):
    rows = np.array([tuple(p) for p in CUBE], [(name, "f8") for name in "xyz"])
    faces = np.empty(6, [("vertex_indices", "O")])
    faces["vertex_indices"] = [np.array(face, "i4") for face in cube_faces()]
    elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, **ENCODINGS[encoding]).write(tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    vertex_end = start + (8 * 24 if encoding != "ascii" else len(b"".join(data[start:].splitlines(keepends=True)[:8])))
    (tmp_path / "a.ply").write_bytes(data[: vertex_end - 30 if part == "vertex" else len(data) - 12])
    with pytest.raises(ScanError, match=rf"declares \d rows of {part}, holds \d"):
        read(tmp_path / "a.ply")


def test_a_lying_count_allocates_nothing(tmp_path):
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nproperty float x\nproperty float y\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + b"property float z\nend_header\n" + bytes(24))
    with pytest.raises(ScanError, match=r"declares 1,000,000,000,000 rows of vertex, holds 2"):
        read(tmp_path / "a.ply", 1 << 20)


def test_a_face_of_a_vertex_that_is_not_there(tmp_path):
    text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n"
    (tmp_path / "a.ply").write_text(text)
    with pytest.raises(ScanError, match=r"vertex 3 of 3"):
        read(tmp_path / "a.ply")


def test_the_ascii_mesh_keeps_its_own_normals(scan_path):
    path = scan_path("ankylosaurus_mesh.ply")
    oracle = PlyData.read(path)["vertex"]
    batch = read(path, 10_000)
    for axis, name in enumerate("xyz"):
        assert np.array_equal(batch.xyz[:, axis], oracle[name].astype("f8"))
        assert np.allclose(batch.normal[:, axis], oracle["n" + name], atol=1e-5)


def test_dragon_normals_follow_the_faces(scan_path):
    path = scan_path("stanford_dragon.ply")
    ply = PlyData.read(path)
    xyz = np.stack([ply["vertex"][name] for name in "xyz"], axis=1).astype("f8")
    triangles = np.stack(ply["face"]["vertex_indices"])
    area = np.cross(xyz[triangles[:, 1]] - xyz[triangles[:, 0]], xyz[triangles[:, 2]] - xyz[triangles[:, 0]])
    sums = np.zeros_like(xyz)
    for corner in range(3):
        np.add.at(sums, triangles[:, corner], area)
    batch = read(path, 100_000)
    assert np.array_equal(batch.xyz, xyz)
    length = np.linalg.norm(sums, axis=1)
    cosines = (batch.normal * sums).sum(1)[length > 0] / length[length > 0]
    assert np.percentile(cosines, 0.1) > 0.99999
