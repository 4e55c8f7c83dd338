"""Files that break builders, through the command line: a model that `verify --against` accepts, or one sentence."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import laspy
import numpy as np
import pytest
from click.testing import CliRunner
from oracles import surfaces

from lpc.errors import LpcError
from pointbuild.cli import build
from pointstream.cli import verify

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

RNG = np.random.default_rng(31)
SAMPLES = 700


def las(path: Path, xyz: NDArray[Any], *, fmt: int = 2, scale: float = 0.001, epsg: int | None = None) -> Path:
    header = laspy.LasHeader(point_format=fmt, version="1.4" if fmt >= 6 else "1.2")
    header.scales, header.offsets = np.full(3, scale), np.floor(np.min(xyz, axis=0))
    if epsg is not None:
        from pyproj import CRS

        header.add_crs(CRS.from_epsg(epsg))
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = np.asarray(xyz).T
    scan.intensity = np.arange(len(xyz)) % 1000
    if "red" in header.point_format.dimension_names:
        scan.red = scan.green = scan.blue = np.arange(len(xyz)) % 65536
    scan.write(path)
    return path


def ply(path: Path, xyz: NDArray[Any], *, declared: int | None = None, kind: str = "float") -> Path:
    count = len(xyz) if declared is None else declared
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n" + "".join(
        f"property {kind} {axis}\n" for axis in "xyz"
    )
    path.write_bytes(f"{head}end_header\n".encode() + np.asarray(xyz, "<f4" if kind == "float" else "<f8").tobytes())
    return path


def built(scans: list[Path], out: Path, *options: str) -> str:
    """Build and verify; what was said on stderr."""
    arguments = [*map(str, scans), "-o", str(out), "--cloud-size", "64", "--json", *options]
    result = CliRunner().invoke(build, arguments)
    assert result.exit_code == 0, result.output or result.exception
    against = [part for scan in scans for part in ("--against", str(scan))]
    checked = CliRunner().invoke(verify, [str(out), *against, "--json"])
    assert checked.exit_code == 0, checked.output
    return result.stderr


def refused(scans: list[Path], out: Path, *options: str) -> str:
    """What the one sentence is; the command prints it and exits with 1."""
    before = sorted(out.parent.iterdir())
    result = CliRunner().invoke(build, [*map(str, scans), "-o", str(out), *options])
    assert isinstance(result.exception, LpcError), result.exception
    assert sorted(out.parent.iterdir()) == before
    text = str(result.exception)
    assert "\n" not in text
    assert len(text) > 20
    return text


def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path: Path) -> None:
    xyz = RNG.random((SAMPLES, 3)).astype("<f4")
    xyz[::50, 0] = np.nan
    xyz[7, 2] = np.inf
    xyz[8] = -np.inf
    built([ply(tmp_path / "a.ply", xyz)], tmp_path / "m.lpc")
    none = ply(tmp_path / "none.ply", np.full((20, 3), np.nan))
    assert "all 20 records are not finite" in refused([none], tmp_path / "n.lpc")


@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.97])
@pytest.mark.parametrize("kind", ["las", "ply"])
def test_files_cut_short(kind: str, kept: float, tmp_path: Path) -> None:
    write = las if kind == "las" else ply
    path = write(tmp_path / f"a.{kind}", surfaces.bumpy(SAMPLES, seed=1).xyz)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    assert str(path) in refused([path], tmp_path / "m.lpc")


@pytest.mark.parametrize("declared", [SAMPLES - 1, SAMPLES + 1, 10**9, 2**32 - 1, 0])
def test_las_that_lies_about_its_length(declared: int, tmp_path: Path) -> None:
    path = las(tmp_path / "a.las", surfaces.bumpy(SAMPLES, seed=1).xyz)
    data = bytearray(path.read_bytes())
    data[107:111] = struct.pack("<I", declared)
    path.write_bytes(data)
    if 0 < declared < SAMPLES:
        built([path], tmp_path / "m.lpc")  # what follows may be anything
    else:
        refused([path], tmp_path / "m.lpc")


@pytest.mark.parametrize(
    ("at", "value"),
    [(94, struct.pack("<H", 60000)), (96, struct.pack("<I", 2**31)), (96, b"\0\0\0\0"), (100, struct.pack("<I", 2**30)),
     (104, b"\x3f"), (105, struct.pack("<H", 1)), (105, b"\xff\xff"), (131, struct.pack("<d", np.nan)),
     (131, struct.pack("<d", 1e308)), (155, struct.pack("<d", np.inf)), (24, b"\x09\x09")],
)  # fmt: skip
def test_las_headers_that_cannot_be_true(at: int, value: bytes, tmp_path: Path) -> None:
    path = las(tmp_path / "a.las", surfaces.bumpy(SAMPLES, seed=1).xyz)
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(data)
    refused([path], tmp_path / "m.lpc")


BINARY = "ply\nformat binary_little_endian 1.0\n"
AXES = "property float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize(
    "head",
    [
        "ply\n",
        BINARY,
        f"ply\nformat middle_endian 1.0\nelement vertex 2\n{AXES}",
        f"{BINARY}element vertex -5\n{AXES}",
        f"{BINARY}element vertex 99999999999999999999\n{AXES}",
        f"{BINARY}element vertex 3\nproperty float x\nproperty float y\nend_header\n",
        f"{BINARY}element face 3\nproperty list uchar int vertex_indices\nend_header\n",
        f"ply\nformat ascii 1.0\nelement vertex 2\n{AXES}1 2\n",
    ],
)
def test_ply_headers_that_cannot_be_true(head: str, tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(head.encode() + b"\x01\x02\x03\x04" * 7)
    refused([path], tmp_path / "m.lpc")


def test_ply_that_lies_about_its_length(tmp_path: Path) -> None:
    xyz = surfaces.bumpy(SAMPLES, seed=2).xyz
    refused([ply(tmp_path / "long.ply", xyz, declared=SAMPLES + 1)], tmp_path / "m.lpc")
    refused([ply(tmp_path / "huge.ply", xyz, declared=10**15)], tmp_path / "m.lpc")
    refused([ply(tmp_path / "none.ply", xyz, declared=0)], tmp_path / "m.lpc")


@pytest.mark.parametrize("suffix", [".las", ".ply", ".laz", ".e57", ".npz", ".pcd", ".xyz", ".obj", ".csv"])
def test_empty_files_and_rubbish(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    for content in (b"", b"\0" * 500, RNG.bytes(3000), b"hello\n"):
        path.write_bytes(content)
        refused([path], tmp_path / "m.lpc")


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("pile", []),
        ("one place", []),
        ("line", []),
        ("plane", []),
        ("clusters", []),
        ("densities", []),
        ("survey", ["--position-error", "0.0005"]),
        ("one", []),
        ("two", []),
        ("M", []),
        ("outlier", ["--position-error", "1e17"]),
    ],
)
def test_hostile_geometry_passes_verify(name: str, options: list[str], tmp_path: Path) -> None:
    ball = surfaces.sphere(SAMPLES, seed=3).xyz
    xyz = {
        "pile": np.concatenate([np.zeros((SAMPLES, 3)), ball]),
        "one place": np.full((SAMPLES, 3), 7.25),
        "line": ball[:, :1] * [1.0, 2.0, 0.5],
        "plane": ball * [1.0, 1.0, 0.0],
        "clusters": np.concatenate([ball, ball + np.array([1e9, 0.0, 0.0])]),
        "densities": np.concatenate([ball * 1e-3, ball * 1e3]),
        "survey": np.round(ball * 20, 3) + np.array([1e7, 6e6, 250.0]),
        "one": ball[:1],
        "two": ball[:2],
        "M": ball[:64],
        "outlier": np.concatenate([ball, [[1e30, 0.0, 0.0]]]),
    }[name]
    path = ply(tmp_path / "a.ply", xyz, kind="double")
    if name == "outlier":
        assert "remove the outliers" in refused([path], tmp_path / "m.lpc")
    built([path], tmp_path / "m.lpc", *options)


def test_a_thousand_tiles(tmp_path: Path) -> None:
    """Of two scales and two point formats: joined in the order of their names, and what differs is said."""
    tiles = tmp_path / "tiles"
    tiles.mkdir()
    xyz = np.round(RNG.random((1000, 8, 3)) * 10, 2)
    for number in range(1000):
        corner = [10.0 * (number % 40), 10.0 * (number // 40), 0.0]
        fmt, scale = (0, 0.01) if number % 10 == 9 else (2, 0.001)
        las(tiles / f"tile_{number:04}.las", xyz[number] + corner, fmt=fmt, scale=scale)
    said = built([tiles], tmp_path / "m.lpc")
    assert "color is left out: missing in tile_0009.las and 99 more of 1000 scans" in said
    assert "2 scales" in said
    assert "0.01/0.01/0.01 in tile_0009.las" in said
    assert "0.001/0.001/0.001 in tile_0000.las" in said
    built(sorted(tiles.iterdir()), tmp_path / "n.lpc")
    assert (tmp_path / "m.lpc").read_bytes() == (tmp_path / "n.lpc").read_bytes()


def test_tiles_of_different_coordinate_systems(tmp_path: Path) -> None:
    tiles = tmp_path / "tiles"
    tiles.mkdir()
    xyz = surfaces.bumpy(100, seed=1).xyz
    for name, epsg in (("a", 25832), ("b", 25832), ("c", 25833)):
        las(tiles / f"{name}.las", xyz, epsg=epsg)
    said = refused([tiles], tmp_path / "m.lpc")
    assert "a.las" in said
    assert "c.las have different coordinate systems (they say different ones)" in said
    las(tiles / "c.las", xyz)
    assert "says which one it has" in refused([tiles], tmp_path / "m.lpc")


def test_attributes_of_one_name_and_two_types(tmp_path: Path) -> None:
    xyz = surfaces.bumpy(200, seed=1).xyz
    np.savez(tmp_path / "a.npz", xyz=xyz, intensity=np.arange(200, dtype=np.uint16))
    np.savez(tmp_path / "b.npz", xyz=xyz, intensity=np.arange(200, dtype=np.float32))
    said = built([tmp_path / "a.npz", tmp_path / "b.npz"], tmp_path / "m.lpc")
    assert "intensity is left out: its type differs between the scans" in said


def test_a_directory_without_scans(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "notes.md").write_text("no scan")
    assert "holds no scan" in refused([tmp_path / "empty"], tmp_path / "m.lpc")
