"""What the first pass finds out: rejected records, and how each attribute is kept."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.built import build_points

from lpc.attributes import Attribute
from lpc.constants import Constant
from lpc.errors import BuildError, ScanError
from lpc.points import PointBatch
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

RNG = np.random.default_rng(11)
XYZ = RNG.random((500, 3))


def kept(name: str, values: NDArray[Any], out: Path) -> Attribute | Constant | str:
    """How an attribute ended up; its values must come back whole."""
    # The place tells which decoded sample is which.
    points = PointBatch(XYZ, {name: values, "place": np.arange(len(XYZ), dtype=np.int64)})
    built = build_points(points, out, cloud_size=64, block_samples=90)
    found = built.everything()
    if name in built.header.left_out:
        return built.header.left_out[name]
    order = np.argsort(found.attributes["place"])
    if name != "normal":
        assert np.array_equal(found.attributes[name][order], values, equal_nan=values.dtype.kind == "f")
        assert found.attributes[name].dtype == values.dtype
    if name in built.header.constants:
        return built.header.constants[name]
    return next(entry for entry in built.header.attributes if entry.name == name)


@pytest.mark.parametrize(
    ("values", "bits", "offset", "scale"),
    [
        (RNG.integers(0, 256, (500, 3)).astype(np.uint8), 8, 0, 1),
        (RNG.integers(0, 256, (500, 3)).astype(np.uint16) * 256, 8, 0, 256),
        (RNG.integers(0, 256, (500, 3)).astype(np.uint16) * 257, 8, 0, 257),
        (RNG.integers(0, 256, (500, 3)).astype(np.uint16), 8, 0, 1),
        (RNG.integers(0, 65536, (500, 3)).astype(np.uint16), 16, 0, 1),
    ],
)
def test_colours(values: NDArray[Any], bits: int, offset: int, scale: int, tmp_path: Path) -> None:
    found = kept("color", values, tmp_path / "m.lpc")
    assert isinstance(found, Attribute)
    assert (found.kind, found.bits, found.offset, found.scale) == ("color", bits, offset, scale)


@pytest.mark.parametrize(
    ("values", "bits", "offset", "scale"),
    [
        (RNG.integers(100, 116, 500).astype(np.uint16), 4, 100, 1),
        (RNG.integers(-3, 4, 500).astype(np.int8), 3, -3, 1),
        (RNG.integers(0, 200, 500).astype(np.uint16) * 257, 8, 0, 257),
        (1000 * RNG.integers(0, 5, 500) + 7, 3, 7, 1000),
        (RNG.integers(-(2**63), 2**63 - 1, 500), 64, None, None),
        (RNG.integers(0, 2**64 - 1, 500, dtype=np.uint64), 64, None, None),
        (RNG.normal(size=500).astype(np.float32), 32, 0, 1),
        (np.where(np.arange(500) % 3, RNG.normal(size=500), np.nan), 64, 0, 1),
    ],
)
def test_scalars(values: NDArray[Any], bits: int, offset: int | None, scale: int | None, tmp_path: Path) -> None:
    found = kept("intensity", values, tmp_path / "m.lpc")
    assert isinstance(found, Attribute)
    assert (found.kind, found.bits) == ("scalar", bits)
    if offset is not None:
        assert (found.offset, found.scale) == (offset, scale)


@pytest.mark.parametrize(
    ("name", "values", "value"),
    [
        ("classification", np.zeros(500, np.uint8), 0),
        ("intensity", np.full(500, 1234, np.uint16), 1234),
        ("time", np.full(500, -2.5), -2.5),
        ("color", np.tile(np.array([9, 8, 7], np.uint8), (500, 1)), (9, 8, 7)),
    ],
)
def test_constants_cost_nothing(name: str, values: NDArray[Any], value: object, tmp_path: Path) -> None:
    found = kept(name, values, tmp_path / "m.lpc")
    assert isinstance(found, Constant)
    assert found.value == value


def test_normals_that_are_all_zero_are_left_out(tmp_path: Path) -> None:
    assert kept("normal", np.zeros((500, 3), np.float32), tmp_path / "m.lpc") == "every normal is zero"


def test_an_attribute_may_change_in_the_last_block_only(tmp_path: Path) -> None:
    values = np.zeros(500, np.uint8)
    values[-1] = 1
    assert isinstance(kept("classification", values, tmp_path / "m.lpc"), Attribute)
    color = np.zeros((500, 3), np.uint16)
    color[:, 0] = 256
    color[-1, 2] = 255
    found = kept("color", color, tmp_path / "m.lpc")
    assert isinstance(found, Attribute)
    assert (found.bits, found.scale) == (9, 1)


def test_records_without_a_position_are_dropped_and_counted(tmp_path: Path) -> None:
    xyz = XYZ.copy()
    xyz[3, 1], xyz[100, 0], xyz[499], xyz[250, 2] = np.nan, np.inf, np.nan, -np.inf
    points = PointBatch(xyz, {"place": np.arange(500, dtype=np.uint16)})
    built = build_points(points, tmp_path / "m.lpc", cloud_size=64, block_samples=60)
    places = np.sort(built.everything().attributes["place"])
    assert np.array_equal(places, np.setdiff1d(np.arange(500), [3, 100, 250, 499]))
    assert built.header.rejected == {"nan": 2, "infinite": 2}
    assert built.header.samples == 496


def test_normals_that_are_not_finite_become_none(tmp_path: Path) -> None:
    normal = np.tile(np.array([0, 0, 1], np.float32), (500, 1))
    normal[7] = np.nan
    built = build_points(
        PointBatch(XYZ, {"normal": normal, "place": np.arange(500, dtype=np.uint16)}), tmp_path / "m.lpc"
    )
    found = built.everything()
    bare = found.attributes["place"][~found.attributes["normal"].any(axis=1)]
    assert bare.tolist() == [7]
    assert built.header.rejected == {}


@pytest.mark.parametrize("xyz", [np.empty((0, 3)), np.full((5, 3), np.nan)])
def test_nothing_to_build(xyz: NDArray[np.float64], tmp_path: Path) -> None:
    with pytest.raises(ScanError, match="no usable sample"):
        build_points(PointBatch(xyz), tmp_path / "m.lpc")
    assert list(tmp_path.iterdir()) == []


def scan(name: str, crs: str | None = None, **attributes: NDArray[Any]) -> ArrayScan:
    return ArrayScan(PointBatch(RNG.random((50, 3)), attributes), crs=crs, name=name)


def header_of(scans: list[ArrayScan], out: Path, **options: Any) -> Any:
    return build_model(scans, out, BuildOptions(threads=1, **options), clock=time.monotonic).header


def test_scans_keep_what_all_have(tmp_path: Path) -> None:
    first = scan("a", intensity=np.arange(50, dtype=np.uint16), classification=np.arange(50, dtype=np.uint8))
    second = scan("b", intensity=np.arange(50, dtype=np.uint8), classification=np.arange(50, dtype=np.uint8))
    third = scan("c", intensity=np.arange(50, dtype=np.uint8), classification=np.arange(50, dtype=np.uint8),
                 color=RNG.integers(0, 255, (50, 3)).astype(np.uint8))  # fmt: skip
    header = header_of([first, second, third], tmp_path / "m.lpc")
    assert [entry.name for entry in header.attributes] == ["classification"]
    assert header.left_out["color"] == "missing in a and 1 more of 3 scans"
    assert "type differs" in header.left_out["intensity"]
    assert header.samples == 150


def test_scans_of_different_coordinate_systems_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BuildError, match="a and b have different coordinate systems"):
        header_of([scan("a", "X"), scan("b", "Y")], tmp_path / "m.lpc")
    with pytest.raises(BuildError, match="different coordinate systems"):
        header_of([scan("a", "X"), scan("b")], tmp_path / "m.lpc")
    assert header_of([scan("a", "X"), scan("b", "X")], tmp_path / "m.lpc").crs == "X"


def test_named_attributes_are_kept_and_the_rest_is_told(tmp_path: Path) -> None:
    values = np.arange(50, dtype=np.uint8)
    source = scan("a", intensity=values, gps_time=values, user_data=values)
    header = header_of([source], tmp_path / "m.lpc", attributes=("gps_time",))
    assert [entry.name for entry in header.attributes] == ["gps_time"]
    assert header.left_out == dict.fromkeys(("intensity", "user_data"), "not asked for (--attributes)")
    with pytest.raises(BuildError, match="no attribute 'gpstime'"):
        header_of([source], tmp_path / "m.lpc", attributes=("gpstime",))


def test_dropped_normals_are_told(tmp_path: Path) -> None:
    source = scan("a", normal=RNG.normal(size=(50, 3)).astype(np.float32))
    header = header_of([source], tmp_path / "m.lpc", normals="drop")
    assert header.attributes == ()
    assert header.left_out == {"normal": "dropped (--normals drop)"}
