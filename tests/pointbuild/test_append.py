"""Scans that are added to a model: byte for byte the model of all scans on its lattice, or a clear sentence."""

from __future__ import annotations

import json
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import surfaces
from support.built import read_model
from support.dying import DyingBuild, run_dying

from lpc.errors import BuildError
from lpc.header import parse_header
from lpc.points import PointBatch
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan
from pointbuild.cli import build
from pointbuild.cluster import Cluster
from pointbuild.folder import work_folder

if TYPE_CHECKING:
    from pointbuild import BuildReport

SURFACE = surfaces.bumpy(3000, seed=1, color=True)
ON_BOX = ((SURFACE.xyz == SURFACE.xyz.min(axis=0)) | (SURFACE.xyz == SURFACE.xyz.max(axis=0))).any(axis=1)
PATCH = (np.abs(SURFACE.xyz[:, 0] - 1) < 0.2) & (np.arange(3000) % 8 == 0) & ~ON_BOX
OPTIONS: dict[str, Any] = {"cloud_size": 40, "threads": 1, "position_error": 0.01}


def built(scans: list[Any], out: Path, append: Path | None = None, **options: Any) -> BuildReport:
    chosen = BuildOptions(**{**OPTIONS, **options})
    scans = [ArrayScan(scan) if isinstance(scan, PointBatch) else scan for scan in scans]
    return build_model(scans, out, chosen, clock=time.monotonic, append=append)


def check(parts: list[PointBatch], folder: Path, **options: Any) -> BuildReport:
    """Add part after part, and compare with the model of all."""
    model, whole = folder / "m.lpc", folder / "whole.lpc"
    report = built(parts[:1], model, **options)
    for part in parts[1:]:
        report = built([part], model, model)
    built(parts, whole, **options)
    assert model.read_bytes() == whole.read_bytes()
    assert read_model(model).header.samples == sum(int(np.isfinite(part.xyz).all(axis=1).sum()) for part in parts)
    return report


def test_what_does_not_change_is_kept(tmp_path: Path) -> None:
    report = check([SURFACE.take(~PATCH), SURFACE.take(PATCH)], tmp_path)
    assert report.header.nodes / 3 < report.clouds_kept < report.header.nodes


def test_nothing_is_kept_where_samples_are_added_everywhere(tmp_path: Path) -> None:
    chosen = (np.arange(3000) % 3 == 0) & ~ON_BOX
    assert check([SURFACE.take(~chosen), SURFACE.take(chosen)], tmp_path).clouds_kept < 10


def test_a_lattice_that_was_chosen_by_the_build_is_kept(tmp_path: Path) -> None:
    """The full build to compare with is told the lattice: by itself it would choose a finer one."""
    old, new, out = SURFACE.take(~PATCH), SURFACE.take(PATCH), tmp_path / "m.lpc"
    step = built([old], out, position_error=None).header.step
    built([new], out, out)
    built([old, new], tmp_path / "whole.lpc", position_error=None, step=step)
    assert out.read_bytes() == (tmp_path / "whole.lpc").read_bytes()


@pytest.mark.parametrize(
    "options",
    [
        {"effort": "fast", "page_nodes": 16, "seed": 7},
        {"effort": "best", "normal_bits": 11, "color_bits": 3},
        {"normals": "drop", "attributes": ("color",)},
        {"cloud_size": 2048},
        {"cloud_size": 1},
    ],
)
def test_how_the_model_is_built_is_kept(options: dict[str, Any], tmp_path: Path) -> None:
    check([SURFACE.take(~PATCH), SURFACE.take(PATCH)], tmp_path, **options)


def test_a_growing_box(tmp_path: Path) -> None:
    """Old samples keep their lattice points, and the origin moves by whole steps."""
    parts = [PointBatch(SURFACE.xyz + shift, SURFACE.attributes) for shift in ([0, 0, 0], [7.3, 0, 0], [-3.1, -50, 9])]
    check(parts, tmp_path)
    before = {tuple(row) for row in read_model(tmp_path / "m.lpc").everything().xyz.round(6)}
    built([parts[0]], tmp_path / "first.lpc")
    assert {tuple(row) for row in read_model(tmp_path / "first.lpc").everything().xyz.round(6)} <= before


def test_far_from_zero_where_positions_are_half_way_between_two_points(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    grid = rng.integers(0, 4000, (3000, 3)) / 1000 + [5e5, 4e6, 100]
    check([PointBatch(grid[:1000] + 1), PointBatch(grid[1000:2000]), PointBatch(grid[2000:] - 3)], tmp_path, step=0.002)


def test_coincident_samples(tmp_path: Path) -> None:
    one = SURFACE.take(slice(0, 1))
    pile = PointBatch.concatenate([one] * 500)
    check([SURFACE, pile, one], tmp_path)
    check([pile, SURFACE], tmp_path)
    check([pile, one], tmp_path, position_error=None, step=0.5)


def test_a_pile_larger_than_a_bucket(tmp_path: Path) -> None:
    pile = PointBatch.concatenate([SURFACE.take(slice(0, 1))] * 70_000)
    model, whole = tmp_path / "m.lpc", tmp_path / "whole.lpc"
    built([PointBatch.concatenate([SURFACE, pile])], model, bucket_samples=300)
    built([pile], model, model, bucket_samples=300)
    built([SURFACE, pile, pile], whole)
    assert model.read_bytes() == whole.read_bytes()


@pytest.mark.parametrize(
    "buckets", [{"bucket_samples": 200, "block_samples": 170, "threads": 2}, {"memory_bytes": 4 << 30}]
)
def test_memory_and_threads_leave_no_trace(buckets: dict[str, Any], tmp_path: Path) -> None:
    model, whole = tmp_path / "m.lpc", tmp_path / "whole.lpc"
    built([SURFACE.take(~PATCH)], model)
    built([SURFACE.take(PATCH)], model, model, **buckets)
    built([SURFACE], whole)
    assert model.read_bytes() == whole.read_bytes()


def with_values(points: PointBatch, **values: Any) -> PointBatch:
    return PointBatch(points.xyz, {**points.attributes, **{k: np.asarray(v) for k, v in values.items()}})


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (np.full(1000, 7, np.uint8), np.full(1000, 7, np.uint8)),  # constant, and still so
        (np.full(1000, 7, np.uint8), np.arange(1000, dtype=np.uint8)),  # no more
        (np.arange(1000, dtype=np.int32) * 50 + 7, np.arange(1000, dtype=np.int32) * 30 - 7000),  # other codes
        (np.linspace(-3, 5, 1000, dtype=np.float32), np.full(1000, np.nan, np.float32)),
        (np.arange(1000, dtype=np.uint64) << np.uint64(54), np.arange(1000, dtype=np.uint64)),
        (np.full(1000, 0.25), np.random.default_rng(0).random(1000)),
    ],
)
def test_attributes_whose_codes_change(before: np.ndarray, after: np.ndarray, tmp_path: Path) -> None:
    parts = [
        with_values(SURFACE.take(slice(0, 1000)), value=before),
        with_values(SURFACE.take(slice(1000, 2000)), value=after),
    ]
    check(parts, tmp_path, attributes=("all",))


@pytest.mark.parametrize("scale", [1, 256, 257])
@pytest.mark.parametrize("bits", [None, 5])
def test_colours_of_sixteen_bits(scale: int, bits: int | None, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    deep = [rng.integers(0, 256 if scale > 1 else 65536, (1000, 3)).astype(np.uint16) * np.uint16(scale) for _ in "ab"]
    parts = [
        PointBatch(SURFACE.xyz[at : at + 1000], {"color": color}) for at, color in zip((0, 1000), deep, strict=True)
    ]
    check(parts, tmp_path, color_bits=bits)
    brighter = PointBatch(SURFACE.xyz[2000:], {"color": np.full((1000, 3), 65535, np.uint16)})
    if bits and scale == 256:
        # 255 * 256 is no full brightness: all samples together would have been shortened from 16 bits.
        with pytest.raises(BuildError, match=r"colours of .* have 5 bits of 8"):
            check([parts[0], brighter], tmp_path, color_bits=bits)
    else:
        check([parts[0], brighter], tmp_path, color_bits=bits)


@settings(max_examples=40)
@given(
    xyz=st.lists(
        st.tuples(*[st.sampled_from([0.0, 0.001, 0.3, 0.5, 0.7, 1.0, -2.0, 40.0])] * 3), min_size=2, max_size=60
    ),
    cuts=st.lists(st.integers(1, 59), max_size=3),
    cloud_size=st.integers(1, 9),
    scalar=st.booleans(),
    seed=st.integers(0, 2**64 - 1),
)
def test_any_split_of_any_samples(
    xyz: list[tuple[float, float, float]],
    cuts: list[int],
    cloud_size: int,
    scalar: bool,
    seed: int,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    places = np.array(xyz)
    numbers = np.arange(len(xyz))
    color = np.stack([numbers * 11 % 256, numbers % 3, numbers * 5 % 256], axis=1).astype(np.uint8)
    values = {"v": (numbers * 7 % 5).astype(np.int16)} if scalar else {"color": color}
    points = PointBatch(places, values)
    bounds = sorted({0, len(xyz), *(cut for cut in cuts if cut < len(xyz))})
    parts = [points.take(slice(first, stop)) for first, stop in pairwise(bounds)]
    check(parts, tmp_path_factory.mktemp("m"), cloud_size=cloud_size, seed=seed, attributes=("all",))


def test_what_was_dropped_and_left_out_is_still_said(tmp_path: Path) -> None:
    bad = PointBatch.concatenate(
        [SURFACE, PointBatch(SURFACE.xyz[:2] * np.nan, {k: v[:2] for k, v in SURFACE.attributes.items()})]
    )
    check([bad, bad], tmp_path)
    assert read_model(tmp_path / "m.lpc").header.rejected == {"nan": 4}


@pytest.mark.parametrize(
    ("scan", "why"),
    [
        (
            ArrayScan(PointBatch(SURFACE.xyz, {"color": SURFACE.attributes["color"]}), name="b"),
            "b has no attribute 'normal'",
        ),
        (
            ArrayScan(with_values(SURFACE, intensity=np.zeros(3000, np.uint16)), name="b"),
            "attribute 'intensity' that .* lacks",
        ),
        (
            ArrayScan(with_values(SURFACE, color=SURFACE.attributes["color"].astype(np.uint16)), name="b"),
            "'color' is uint16 in b and uint8 in",
        ),
        (ArrayScan(SURFACE, crs="WKT", name="b"), "different coordinate systems"),
        (ArrayScan(SURFACE.take(slice(0, 0)), name="b"), ""),
    ],
)
def test_scans_that_do_not_fit(scan: ArrayScan, why: str, tmp_path: Path) -> None:
    model = tmp_path / "m.lpc"
    built([SURFACE], model)
    before = model.read_bytes()
    if not why:  # nothing to add
        built([scan], model, model)
    else:
        with pytest.raises(BuildError, match=why):
            built([scan], model, model)
    assert model.read_bytes() == before
    assert list(tmp_path.iterdir()) == [model]


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda data: data[:-1], "is not whole"),
        (lambda data: data[:3000], "is not whole"),
        (lambda data: data[:100], "cannot be added to: the file ends inside its header"),
        (lambda data: b"ply\n" + data, "cannot be added to: this is no .lpc file"),
        (
            lambda data: data[: parse_header(data).page0 + 60] + b"\xff" + data[parse_header(data).page0 + 61 :],
            "page 0",
        ),
        (lambda data: data[:-9] + bytes([data[-9] ^ 1]) + data[-8:], "is damaged"),
        (lambda data: replace(parse_header(data), extra={}).to_bytes(), "was built before models could be added to"),
        (lambda _: None, "No such file"),
    ],
)
def test_models_that_cannot_be_added_to(damage: Any, why: str, tmp_path: Path) -> None:
    model = tmp_path / "m.lpc"
    built([SURFACE], model)
    data = damage(model.read_bytes())
    if data is None:
        model.unlink()
    else:
        model.write_bytes(data)
    with pytest.raises(BuildError, match=why):
        built([SURFACE], tmp_path / "other.lpc", model)
    assert {path.name for path in tmp_path.iterdir()} <= {"m.lpc"}


def test_the_copy_of_a_part_cannot_be_added_to(tmp_path: Path) -> None:
    model = tmp_path / "m.lpc"
    built([SURFACE], model)
    (tmp_path / "m.lpc.present").write_bytes(b"which parts are here")
    with pytest.raises(BuildError, match="is not whole"):
        built([SURFACE], tmp_path / "other.lpc", model)


def test_another_build_of_the_model_runs(tmp_path: Path) -> None:
    model = tmp_path / "m.lpc"
    built([SURFACE], model)
    with work_folder(tmp_path, model, None, print), pytest.raises(BuildError, match="another build of"):
        built([SURFACE], model, model)


def test_a_reader_that_has_the_old_model_open_keeps_it(tmp_path: Path) -> None:
    model = tmp_path / "m.lpc"
    tag = built([SURFACE.take(~PATCH)], model).header.tag
    before = model.read_bytes()
    with model.open("rb") as file:
        assert built([SURFACE.take(PATCH)], model, model).header.tag != tag
        assert file.read() == before


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    paths = tmp_path / "a.npz", tmp_path / "b.npz"
    for path, which in zip(paths, (~PATCH, PATCH), strict=True):
        np.savez(path, xyz=SURFACE.xyz[which], color=SURFACE.attributes["color"][which])
    return paths


def command(*arguments: object) -> Any:
    return CliRunner().invoke(build, list(map(str, arguments)))


def test_the_command(files: tuple[Path, Path], tmp_path: Path) -> None:
    first, second = files
    model, whole = tmp_path / "m.lpc", tmp_path / "whole.lpc"
    assert command(first, "-o", model, "--cloud-size", 40).exit_code == 0
    said = command(second, "--append", model, "-o", tmp_path / "n.lpc", "--json")
    report = json.loads(said.stdout)
    assert report["clouds_kept"] > 0
    assert report["clouds_kept"] + report["clouds_written"] == report["clouds"]
    assert command(first, second, "-o", whole, "--cloud-size", 40, "--position-error", model).exit_code == 0
    assert (tmp_path / "n.lpc").read_bytes() == whole.read_bytes()
    said = command("--append", model, second)
    assert said.exit_code == 0, said.output
    assert "clouds kept" in said.stdout
    assert model.read_bytes() == whole.read_bytes()


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ((), "say where the model goes"),
        (("--append", "m.lpc", "--cloud-size", "64"), "--cloud-size is settled by the model"),
        (("--append", "m.lpc", "--colour-bits", "5"), "--colour-bits is settled by the model"),
        (("--append", "m.lpc", "--position-error", "auto"), "--position-error is settled by the model"),
    ],
)
def test_options_that_make_no_sense(options: tuple[str, ...], why: str, files: tuple[Path, Path]) -> None:
    said = command(files[0], *options)
    assert said.exit_code == 2
    assert why in said.output


def test_killed_at_any_moment_the_old_model_is_whole_until_the_new_one_is(
    files: tuple[Path, Path], tmp_path: Path
) -> None:
    first, second = files
    model, whole = tmp_path / "m.lpc", tmp_path / "whole.lpc"
    built([first], model)
    old = model.read_bytes()
    built([first, second], whole)
    new = whole.read_bytes()

    def run(models: list[Path], moments: list[int]) -> list[tuple[int, int]]:
        small = {"bucket_samples": 700, "block_samples": 900, "threads": 1}
        return run_dying(
            [
                DyingBuild(scan=str(second), out=str(each), options=small, moment=moment, append=True)
                for each, moment in zip(models, moments, strict=True)
            ]
        )

    ((status, last),) = run([model], [0])
    assert (status, model.read_bytes()) == (0, new)
    # The last call looks how much memory was used, when all is done and nothing is left that could tell.
    moments = [*range(2, last - 6, last // 6), *range(last - 6, last)]
    models = [tmp_path / str(moment) / "m.lpc" for moment in moments]
    for each in models:
        each.parent.mkdir()
        each.write_bytes(old)
    killed = run(models, moments)
    assert {status for status, _ in killed} == {signal.SIGKILL}
    found = [each.read_bytes() for each in models]
    assert {old, new} == set(found)
    again = run(models, [0] * len(models))
    assert {status for status, _ in again} == {0}
    for each in models:
        assert each.read_bytes() == new, each
        assert list(each.parent.iterdir()) == [each]


def test_workers_of_a_cluster_encode_everything_to_the_same_bytes(tmp_path: Path) -> None:
    model, whole = tmp_path / "m.lpc", tmp_path / "whole.lpc"
    built([SURFACE.take(~PATCH)], model)
    with ThreadPoolExecutor(2) as pool:
        report = build_model(
            [ArrayScan(SURFACE.take(PATCH))], model, BuildOptions(bucket_samples=700), clock=time.monotonic,
            append=model, cluster=Cluster(pool, 4),
        )  # fmt: skip
    built([SURFACE], whole)
    assert report.clouds_kept == 0
    assert model.read_bytes() == whole.read_bytes()
