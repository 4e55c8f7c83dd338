"""``--colour-bits`` and ``--normal-bits``: smaller, within the errors that the model states."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from click.testing import CliRunner
from oracles import surfaces
from support.built import Built, build_points, numbered

from lpc.errors import BuildError
from lpc.info import info_dict
from pointbuild import BuildOptions
from pointbuild.arrays import ArrayScan
from pointbuild.cli import build
from pointstream.reading import Reader
from pointstream.stores import MemoryStore
from pointstream.verify import VerifyReport, verify

if TYPE_CHECKING:
    from pathlib import Path

    from lpc.points import PointBatch

SAMPLES = 3000


@pytest.fixture(scope="module")
def points() -> PointBatch:
    surface = surfaces.bumpy(SAMPLES, seed=3)
    normal = surface.attributes["normal"].copy()
    normal[:40] = 0
    return numbered(surface.xyz, normal=normal, color=np.random.default_rng(3).integers(0, 256, (SAMPLES, 3), np.uint8))


def checked(path: Path, points: PointBatch) -> VerifyReport:
    data = path.read_bytes()

    async def run() -> VerifyReport:
        reader = await Reader.open(MemoryStore(data))
        return await verify(reader, [ArrayScan(points)])

    return asyncio.run(run())


def in_order(built: Built, name: str) -> Any:
    found = built.everything()
    return found.attributes[name][np.argsort(found.attributes["place"])]


@pytest.mark.parametrize("bits", [1, 5, 7])
def test_colours_with_fewer_bits(bits: int, points: PointBatch, tmp_path: Path) -> None:
    whole = build_points(points, tmp_path / "w.lpc", cloud_size=200)
    built = build_points(points, tmp_path / "m.lpc", cloud_size=200, color_bits=bits, block_samples=700)
    attribute = next(entry for entry in built.header.attributes if entry.name == "color")
    assert (attribute.bits, attribute.depth, attribute.dtype) == (bits, 8, "|u1")
    apart = np.abs(in_order(built, "color").astype(int) - points.attributes["color"])
    assert 0 < apart.max() <= attribute.max_error == info_dict(built.header)["attribute_errors"]["color"]
    assert built.header.attribute_bits["color"] < whole.header.attribute_bits["color"] - 0.7 * 3 * (8 - bits)
    report = checked(tmp_path / "m.lpc", points)
    assert report.ok, report.problems
    assert report.match is not None
    assert report.match.max_color_error == apart.max()


@pytest.mark.parametrize(
    ("scale", "bits", "depth"), [(1, 8, 16), (1, 10, 16), (256, 5, 8), (257, 5, 8), (257, 8, 0), (257, 16, 0)]
)
def test_colours_of_16_bits(scale: int, bits: int, depth: int, points: PointBatch, tmp_path: Path) -> None:
    most = 65535 // scale
    values = np.random.default_rng(4).integers(0, most + 1, (SAMPLES, 3)).astype(np.uint16) * np.uint16(scale)
    wide = numbered(points.xyz, color=values)
    built = build_points(wide, tmp_path / "m.lpc", color_bits=bits)
    attribute = next(entry for entry in built.header.attributes if entry.name == "color")
    assert (attribute.depth, attribute.bits) == (depth, bits if depth else 8)
    found = in_order(built, "color")
    assert found.dtype == np.uint16
    assert np.abs(found.astype(int) - values).max() <= attribute.max_error
    assert checked(tmp_path / "m.lpc", wide).ok


def test_bits_that_a_colour_does_not_need_are_not_stored(points: PointBatch, tmp_path: Path) -> None:
    dark = numbered(points.xyz, color=points.attributes["color"] >> 5)
    plain = build_points(dark, tmp_path / "a.lpc")
    built = build_points(dark, tmp_path / "b.lpc", color_bits=6)
    assert built.header.attributes == plain.header.attributes
    assert built.header.attribute_bits == plain.header.attribute_bits
    assert np.array_equal(built.index.crc, plain.index.crc)


@pytest.mark.parametrize("bits", [2, 6, 8, 9, 12, 16])
def test_normals_of_any_width(bits: int, points: PointBatch, tmp_path: Path) -> None:
    built = build_points(points, tmp_path / "m.lpc", cloud_size=200, normal_bits=bits, block_samples=700)
    attribute = next(entry for entry in built.header.attributes if entry.name == "normal")
    assert attribute.bits == bits
    report = checked(tmp_path / "m.lpc", points)  # cones and spheres, too
    assert report.ok, report.problems
    assert report.match is not None
    assert report.match.max_normal_error_degrees is not None
    stated = info_dict(built.header)["attribute_errors"]["normal"]
    assert 0.4 * stated < report.match.max_normal_error_degrees <= stated + 1e-3
    assert (in_order(built, "normal")[:40] == 0).all()


def test_the_command_takes_both_spellings_and_says_what_came_of_it(points: PointBatch, tmp_path: Path) -> None:
    scan, out = tmp_path / "scan.npz", tmp_path / "m.lpc"
    np.savez(scan, xyz=points.xyz, normal=points.attributes["normal"], color=points.attributes["color"])
    told = []
    for option in ("--colour-bits", "--color-bits"):
        arguments = [str(scan), "-o", str(out), option, "5", "--normal-bits", "6", "--threads", "1", "--json"]
        result = CliRunner().invoke(build, arguments)
        assert result.exit_code == 0, result.output
        told.append(json.loads(result.stdout))
    assert told[0]["digest"] == told[1]["digest"]
    assert told[0]["attribute_errors"]["color"] == 4
    assert told[0]["attribute_bits"].keys() == {"normal", "color"}


@pytest.mark.parametrize(
    "arguments", [["--colour-bits", "0"], ["--colour-bits", "17"], ["--normal-bits", "1"], ["--normal-bits", "17"],
                  ["--normal-bits", "eight"]],
)  # fmt: skip
def test_bits_that_cannot_be(arguments: list[str], tmp_path: Path) -> None:
    assert CliRunner().invoke(build, ["a.ply", "-o", str(tmp_path / "m.lpc"), *arguments]).exit_code == 2
    with pytest.raises(BuildError, match="choose"):
        BuildOptions(**{"normal_bits" if "normal" in arguments[0] else "color_bits": 17})
