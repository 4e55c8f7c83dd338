"""Text of numbers in the many ways people write it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lpc.errors import ScanError
from lpc.points import PointBatch
from pointbuild.readers import finite, open_scan


def read(path, size=7, **options):
    return PointBatch.concatenate(open_scan(path, **options).batches(size))


def write(tmp_path, text, name="a.xyz"):
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return tmp_path / name


numbers = st.floats(allow_nan=False, allow_infinity=False, width=64, min_value=-1e9, max_value=1e9)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    rows=st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=30),
    separator=st.sampled_from([" ", "  ", "\t", ",", " , ", ";", "; "]),
    end=st.sampled_from(["\n", "\r\n", "\r", " \n\n"]),
    header=st.sampled_from(["", "x,y,z\n", "# x y z\n", "X;Y;Z\n", "//X Y Z\n30\n"]),
    size=st.integers(1, 40),
)
def test_positions_survive_every_way_of_parting_them(tmp_path, rows, separator, end, header, size):
    text = end.join(separator.join(repr(value) for value in row) for row in rows)
    path = write(tmp_path, header.replace("30", str(len(rows))).replace("\n", end) + text)
    assert np.array_equal(read(path, size).xyz, np.array(rows))


def unit_rows(rng, count):
    normals = rng.normal(size=(count, 3))
    return np.round(normals / np.linalg.norm(normals, axis=1, keepdims=True), 6)


@pytest.mark.parametrize("layout", ["i", "rgb", "n", "irgb", "rgbn", "nrgb", "irgbn", "in"])
@pytest.mark.parametrize("named", [False, True])
def test_columns_without_and_with_names(tmp_path, layout, named):
    rng = np.random.default_rng(4)
    parts = {"i": np.round(rng.normal(size=(200, 1)) * 99, 2), "n": unit_rows(rng, 200)}
    parts["rgb"] = rng.integers(0, 256, (200, 3))
    names = {"i": "Intensity", "n": "NormalX Ny Nz", "rgb": "R G B"}
    order = list(layout.replace("rgb", "c"))
    order = ["rgb" if key == "c" else key for key in order]
    xyz = np.round(rng.normal(size=(200, 3)) * 1000, 3)
    table = np.concatenate([xyz, *(parts[key] for key in order)], axis=1)
    lines = [" ".join(f"{value:.10g}" for value in row) for row in table]
    if named:
        lines.insert(0, "x y z " + " ".join(names[key].replace("Normal", "normal_") for key in order))
    batch = read(write(tmp_path, "\n".join(lines)), 64)
    assert np.array_equal(batch.xyz, xyz)
    assert set(batch.attributes) == {{"i": "intensity", "n": "normal", "rgb": "color"}[key] for key in order}
    if "rgb" in order:
        assert batch.color.dtype == np.uint8
        assert np.array_equal(batch.color, parts["rgb"])
    if "n" in order:
        assert np.allclose(batch.normal, parts["n"], atol=1e-5)
    if "i" in order:
        assert np.array_equal(batch.attributes["intensity"], parts["i"][:, 0].astype("f4"))


def test_names_in_any_order(tmp_path):
    path = write(tmp_path, "class,z,y,x,Red,Green,Blue\n2,3,2,1,10,20,30\n6,6,5,4,40,50,300\n", "a.csv")
    batch = read(path)
    assert batch.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert batch.color.tolist() == [[10, 20, 30], [40, 50, 300]]
    assert batch.color.dtype == np.uint16
    assert batch.attributes["classification"].tolist() == [2, 6]


def test_decimal_commas_between_semicolons(tmp_path):
    assert read(write(tmp_path, "1,5;2,25;-3,0\n4;5,5;6\n", "a.csv")).xyz.tolist() == [[1.5, 2.25, -3], [4, 5.5, 6]]


def test_pts_with_counts_of_several_scans(tmp_path):
    path = write(tmp_path, "2\n1 2 3 -500 10 20 30\n4 5 6 7 40 50 60\n1\n7 8 9 1 1 1 1\n", "a.pts")
    assert read(path, 2).xyz.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    assert read(path).attributes["intensity"].tolist() == [-500, 7, 1]
    path = write(tmp_path, "3\n1 2 3 -500 10 20 30\n4 5 6 7 40 50 60\n", "a.pts")
    with pytest.raises(ScanError, match="declares 3 samples, holds 2"):
        read(path)


def test_comments_and_nan_among_the_rows(tmp_path):
    path = write(tmp_path, "1 2 3\n# half way\nnan 1 1\n1 -inf 2\n4 5 6\n")
    batch, counts = finite(read(path, 2))
    assert batch.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert counts == {"nan": 1, "infinite": 1}


def test_colours_as_fractions(tmp_path):
    path = write(tmp_path, "x y z r g b\n0 0 0 0.2 1 0\n1 1 1 0.4 0.6 1\n")
    assert read(path).color.tolist() == [[51 * 257, 65535, 0], [102 * 257, 153 * 257, 65535]]


def test_unknown_columns_on_request(tmp_path):
    path = write(tmp_path, "x,y,z,gps_time\n1,2,3,123456789.125\n", "a.txt")
    assert "gps_time" in open_scan(path).info.left_out
    assert read(path, attributes="all").attributes["gps_time"].tolist() == [123456789.125]


@pytest.mark.parametrize("bad", ["1 2", "1 2 x", "1 2 3 4", "1,,3"])
def test_a_bad_line_is_named(tmp_path, bad):
    path = write(tmp_path, "x y z\n" + "1 2 3\n" * 100 + bad + "\n" + "1 2 3\n" * 100)
    with pytest.raises(ScanError, match=r"a.xyz, line 102: ") as caught:
        read(path, 30)
    assert "\n" not in str(caught.value)


def test_large_files_come_in_batches_of_the_asked_size(tmp_path):
    rng = np.random.default_rng(5)
    xyz = rng.integers(-(10**6), 10**6, (60_000, 3)) / 1000
    path = write(tmp_path, "\n".join(f"{x:.3f} {y:.3f} {z:.3f}" for x, y, z in xyz))
    batches = list(open_scan(path).batches(25_000))
    assert [len(batch) for batch in batches] == [25_000, 25_000, 10_000]
    assert np.array_equal(PointBatch.concatenate(batches).xyz, xyz)


def test_the_real_csv(scan_path):
    path = scan_path("car_cloud400.csv")
    oracle = np.loadtxt(path, delimiter=",", skiprows=1)
    batch = read(path, 10_000)
    assert np.array_equal(batch.xyz, oracle[:, :3])
    assert np.allclose(batch.normal, oracle[:, 3:], atol=1e-5)
