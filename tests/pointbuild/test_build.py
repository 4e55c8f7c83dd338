"""Whole builds: real scans, the report, the file's head, and what is left behind when it goes wrong."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from click.testing import CliRunner
from oracles import surfaces
from scipy.spatial import cKDTree
from support.built import build_points, read_model

import pointbuild.build
from lpc.errors import BuildError, LpcError
from lpc.header import HEADER_PROBE, Header
from lpc.octahedral import max_error_degrees
from lpc.points import PointBatch
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan
from pointbuild.cli import build
from pointbuild.readers import finite, open_scan
from pointbuild.sizes import parse_size

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

REPOSITORY = Path(__file__).resolve().parents[2]
MEGABYTES = 1 << 20


@pytest.mark.parametrize(
    ("name", "normals"),
    [
        ("bun_zipper_res4.ply", True),
        ("ankylosaurus_mesh.ply", True),
        ("las14_rgbnir_extrabytes.laz", False),
        ("bunnyInt32.e57", False),
        ("car_cloud400.csv", True),
    ],
)
def test_real_scans_come_back_sample_by_sample(
    name: str, normals: bool, scan_path: Callable[[str], Path], tmp_path: Path
) -> None:
    out = tmp_path / "m.lpc"
    build_model([scan_path(name)], out, BuildOptions(threads=2, cloud_size=512), clock=time.monotonic)
    built = read_model(out)
    given = PointBatch.concatenate([finite(batch)[0] for batch in open_scan(scan_path(name)).batches(20_000)])
    found = built.everything()
    assert len(found) == len(given) == built.header.samples
    assert set(found.attributes) | set(built.header.left_out) >= set(given.attributes)
    # Neither side may have a sample that is not near one of the other; coincident ones make pairing ambiguous.
    for one, other in ((found, given), (given, found)):
        assert cKDTree(other.xyz).query(one.xyz)[0].max() <= built.header.position_error
    _, pair = cKDTree(given.xyz).query(found.xyz)
    lonely = np.bincount(pair, minlength=len(given))[pair] == 1
    for key, values in found.attributes.items():
        if key != "normal":
            same = given.attributes[key][pair[lonely]] == values[lonely]
            assert same.mean() > 0.99, key  # a decoded sample may come nearer to another one
    assert (found.normal is not None) == normals


def test_position_and_normal_cost_less_than_22_bits(scan_path: Callable[[str], Path], tmp_path: Path) -> None:
    out = tmp_path / "m.lpc"
    bits = build_model(
        [scan_path("stanford_dragon.ply")], out, BuildOptions(), clock=time.monotonic
    ).header.bits_per_sample
    assert bits["position"] + bits["normal"] < 22
    assert bits["total"] == pytest.approx(sum(bits[name] for name in bits if name != "total"), abs=0.001)
    assert 8 * out.stat().st_size / 437_645 == pytest.approx(bits["total"], rel=0.01)


def test_normals_move_less_than_the_codec_says(tmp_path: Path) -> None:
    points = surfaces.torus(2000, seed=1)
    points = PointBatch(points.xyz, {**points.attributes, "place": np.arange(2000, dtype=np.uint16)})
    found = build_points(points, tmp_path / "m.lpc", cloud_size=128).everything()
    given = points.attributes["normal"][found.attributes["place"]].astype(float)
    chord = np.linalg.norm(found.attributes["normal"] - given, axis=1)
    assert np.degrees(2 * np.arcsin(chord / 2)).max() <= max_error_degrees(8) + 1e-3


def test_the_first_request_holds_header_page_and_clouds(tmp_path: Path) -> None:
    built = build_points(surfaces.bumpy(60_000, seed=2, color=True), tmp_path / "m.lpc")
    assert built.index.available(HEADER_PROBE).sum() >= 4
    assert built.header.page0 < 4096


def test_costs_tell_streams_apart(tmp_path: Path) -> None:
    points = surfaces.bumpy(5000, seed=3)
    noise = np.random.default_rng(0).integers(0, 256, (5000, 3)).astype(np.uint8)
    count = np.random.default_rng(0).integers(0, 2**16, 5000).astype(np.uint16)
    plain = build_points(points, tmp_path / "a.lpc").header.bits_per_sample
    rich = build_points(
        PointBatch(points.xyz, {**points.attributes, "color": noise, "count": count}), tmp_path / "b.lpc"
    ).header.bits_per_sample
    assert plain["color"] == plain["other"] == 0
    assert rich["color"] == pytest.approx(26, abs=1.5)  # noise: 8, 9 and 9 bits in YCoCg-R
    assert rich["other"] == pytest.approx(16, abs=1)
    assert rich["position"] == pytest.approx(plain["position"], rel=0.03)
    assert rich["normal"] == pytest.approx(plain["normal"], rel=0.03)


class Failing(ArrayScan):
    """Fails in the middle of the input."""

    def batches(self, size: int) -> Iterator[PointBatch]:
        yield from (batch for _, batch in zip(range(3), super().batches(size), strict=False))
        raise LpcError("the scan ends here")


@pytest.mark.parametrize("old", [b"an older model", None])
def test_a_failure_leaves_the_old_model_and_nothing_else(old: bytes | None, tmp_path: Path) -> None:
    out = tmp_path / "m.lpc"
    if old is not None:
        out.write_bytes(old)
    with pytest.raises(LpcError, match="the scan ends here"):
        build_model([Failing(surfaces.bumpy(2000))], out, BuildOptions(block_samples=100), clock=time.monotonic)
    assert [path.name for path in tmp_path.iterdir()] == ([] if old is None else ["m.lpc"])
    assert old is None or out.read_bytes() == old


@pytest.mark.parametrize("stage", ["read", "count", "scatter", "partition", "encode", "write"])
def test_an_interruption_at_any_stage_leaves_nothing(stage: str, tmp_path: Path) -> None:
    class Interrupting:
        def stage(self, name: str, total: int | None) -> None:
            self.name = name

        def advance(self, samples: int) -> None:
            if self.name == stage:
                raise KeyboardInterrupt

    out = tmp_path / "m.lpc"
    out.write_bytes(b"old")
    options = BuildOptions(bucket_samples=600, block_samples=500, cloud_size=64)
    if stage == "write":  # is told after the fact: the new model stands
        with pytest.raises(KeyboardInterrupt):
            build_model([ArrayScan(surfaces.bumpy(2000))], out, options, Interrupting(), clock=time.monotonic)
        assert read_model(out).header.samples == 2000
    else:
        with pytest.raises(KeyboardInterrupt):
            build_model([ArrayScan(surfaces.bumpy(2000))], out, options, Interrupting(), clock=time.monotonic)
        assert out.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["m.lpc"]


def test_a_full_disk_is_said_before_work_begins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pointbuild.build.disk, "free_bytes", lambda folder: 1000)
    with pytest.raises(BuildError, match="which has 0 MB free: make room"):
        build_points(surfaces.bumpy(2000), tmp_path / "m.lpc")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("out", "message"), [("", "is a directory"), ("nowhere/m.lpc", "there is no directory")])
def test_targets_that_cannot_be(out: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(BuildError, match=message):
        build_points(surfaces.bumpy(100), tmp_path / out)


def test_scratch_may_be_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "scratch").mkdir()
    (tmp_path / "out").mkdir()
    build_points(surfaces.bumpy(500), tmp_path / "out" / "m.lpc", scratch=tmp_path / "scratch")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["m.lpc"]
    assert list((tmp_path / "scratch").iterdir()) == []
    with pytest.raises(BuildError, match="for temporary files"):
        build_points(surfaces.bumpy(500), tmp_path / "out" / "m.lpc", scratch=tmp_path / "none")


def test_too_little_memory_is_said_with_what_it_takes(tmp_path: Path) -> None:
    with pytest.raises(BuildError, match=r"allow at least \d+ MiB"):
        build_points(surfaces.bumpy(500), tmp_path / "m.lpc", memory_bytes=50 * MEGABYTES)


@pytest.mark.parametrize(
    "wrong", [{"cloud_size": 0}, {"cloud_size": 70_000}, {"position_error": -1.0}, {"position_error": float("nan")},
              {"seed": 2**64}, {"page_nodes": 0}, {"memory_bytes": 0}, {"threads": -1}],
)  # fmt: skip
def test_options_that_cannot_be(wrong: dict[str, Any]) -> None:
    with pytest.raises(BuildError):
        BuildOptions(**wrong)


@pytest.mark.parametrize(("text", "size"), [("2G", 2 << 30), ("600M", 600 << 20), ("1.5GiB", 3 << 29), ("4096", 4096)])
def test_sizes(text: str, size: int) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "2X", "-1G", "0", "G"])
def test_sizes_that_are_none(text: str) -> None:
    with pytest.raises(BuildError, match="not a size"):
        parse_size(text)


def test_json_is_one_object_with_the_contracts_keys(scan_path: Callable[[str], Path], tmp_path: Path) -> None:
    out = tmp_path / "m.lpc"
    result = CliRunner().invoke(build, [str(scan_path("bun_zipper_res4.ply")), "-o", str(out), "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert {
        "format", "complete", "samples", "clouds", "levels", "cloud_size", "bytes", "bits_per_sample", "spacing",
        "position_error", "bounds", "attributes", "crs", "left_out", "digest", "seconds", "samples_per_second",
        "peak_rss_bytes", "rejected",
    } <= told.keys()  # fmt: skip
    assert told["samples"] == 453
    assert told["complete"] is True
    assert told["bytes"] == out.stat().st_size
    assert told["digest"] == read_model(out).header.digest
    assert set(told["bits_per_sample"]) == {"position", "normal", "color", "other", "index", "total"}
    assert result.stderr == ""


def test_plain_lines_where_there_is_no_terminal(scan_path: Callable[[str], Path], tmp_path: Path) -> None:
    arguments = [str(scan_path("bun_zipper_res4.ply")), "-o", str(tmp_path / "m.lpc"), "--attributes", "normal"]
    result = CliRunner().invoke(build, arguments)
    assert result.exit_code == 0
    assert [line.split(":")[0] for line in result.stderr.splitlines()] == [
        "read", "scatter", "partition", "encode", "write",
    ]  # fmt: skip
    assert "453 samples" in result.stdout


@pytest.mark.parametrize(
    "arguments", [["--memory", "lots"], ["--position-error", "-1"], ["--cloud-size", "0"], ["--normals", "maybe"]]
)
def test_wrong_arguments_exit_with_2(arguments: list[str], tmp_path: Path) -> None:
    result = CliRunner().invoke(build, ["scan.ply", "-o", str(tmp_path / "m.lpc"), *arguments])
    assert result.exit_code == 2


WAITING_BUILD = """
import contextlib, sys, time
from pointbuild import cli, progress

class Waiting(progress.Silent):
    def stage(self, name, total):
        if name == "partition":
            print("here", file=sys.stderr, flush=True)
            time.sleep(60)

cli._progress = lambda quiet: contextlib.nullcontext(Waiting())
cli.build()
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_nothing_behind(number: signal.Signals, tmp_path: Path) -> None:
    """A build is stopped in the middle: its temporary files stand, and it waits at the next stage."""
    np.savez(tmp_path / "scan.npz", xyz=surfaces.bumpy(4000, seed=4).xyz)
    out = tmp_path / "m.lpc"
    out.write_bytes(b"old")
    paths = os.pathsep.join(str(REPOSITORY / part) for part in ("common", "server"))
    child = subprocess.Popen(
        [sys.executable, "-c", WAITING_BUILD, str(tmp_path / "scan.npz"), "-o", str(out)],
        env={**os.environ, "PYTHONPATH": paths}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert child.stderr is not None
    assert child.stderr.readline() == b"here\n"
    assert len(list(tmp_path.iterdir())) == 3
    child.send_signal(number)
    child.communicate(timeout=60)
    assert child.returncode not in (0, -number)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.lpc", "scan.npz"]
    assert out.read_bytes() == b"old"


def test_the_report_says_how_long_it_took(tmp_path: Path) -> None:
    ticks = iter([10.0, 14.0])
    report = build_model(
        [ArrayScan(surfaces.bumpy(800))], tmp_path / "m.lpc", BuildOptions(), clock=lambda: next(ticks)
    )
    assert report.seconds == 4.0
    assert report.samples_per_second == 200.0
    assert report.peak_rss_bytes > 50 * MEGABYTES
    assert isinstance(report.header, Header)
