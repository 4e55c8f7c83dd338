"""A build that is killed leaves no half model, and the next one goes on from there to the same bytes."""

from __future__ import annotations

import hashlib
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles import surfaces
from support.dying import DyingBuild, run_dying

import pointbuild.build
import pointbuild.divide
import pointbuild.publish
from lpc.errors import BuildError
from pointbuild import BuildOptions, build_model
from pointbuild import folder as folder_module
from pointbuild.journal import Journal, as_array, from_array

MOMENTS = 20


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven buckets, a pile that has one of its own, and an outlier that makes more than one sweep necessary."""
    points = surfaces.bumpy(4000, seed=1, color=True)
    xyz = np.concatenate([points.xyz * 1e-3, np.full((1000, 3), 2e-4), [[500.0, 0.0, 0.0]]])
    color = np.concatenate([points.attributes["color"], np.arange(3003, dtype=np.uint8).reshape(1001, 3) % 251])
    path = tmp_path_factory.mktemp("scan") / "scan.npz"
    order = np.random.default_rng(0).permutation(len(xyz))
    np.savez(path, xyz=xyz[order], color=color[order])
    return path


SMALL = {"cloud_size": 64, "bucket_samples": 700, "block_samples": 900}


def options(threads: int = 1) -> BuildOptions:
    return BuildOptions(**SMALL, threads=threads)


def run(scan: Path, folder: Path, moment: int, threads: int) -> DyingBuild:
    return DyingBuild(scan=str(scan), out=str(folder / "m.lpc"), options={**SMALL, "threads": threads}, moment=moment)


@pytest.fixture(scope="module")
def undisturbed(scan: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Build once, with all kernels loaded for the children; the digest of the model."""
    out = tmp_path_factory.mktemp("whole") / "m.lpc"
    build_model([scan], out, options(), clock=time.monotonic)
    return digest(out)


def test_killed_at_twenty_moments(scan: Path, undisturbed: str, tmp_path: Path) -> None:
    ((status, calls),) = run_dying([run(scan, tmp_path, 0, 1)])
    assert status == 0
    assert digest(tmp_path / "m.lpc") == undisturbed
    assert calls > 100
    moments = sorted(np.random.default_rng(5).choice(np.arange(1, calls + 1), MOMENTS, replace=False).tolist())
    folders = [tmp_path / str(moment) for moment in moments]
    for folder in folders:
        folder.mkdir()
        (folder / "m.lpc").write_bytes(b"an older model")
    threads = [1 + number % 2 for number in range(MOMENTS)]
    ends = run_dying([run(scan, *entry) for entry in zip(folders, moments, threads, strict=True)])
    assert ends == [(signal.SIGKILL, 0)] * MOMENTS
    resumed = 0
    for folder, moment, count in zip(folders, moments, threads, strict=True):
        out = folder / "m.lpc"
        assert out.read_bytes() == b"an older model" or digest(out) == undisturbed
        told: list[str] = []
        build_model([scan], out, options(count), clock=time.monotonic, tell=told.append)
        assert digest(out) == undisturbed, f"killed at call {moment} of {calls}"
        assert [path.name for path in folder.iterdir()] == ["m.lpc"]
        resumed += any("going on" in text for text in told)
    assert resumed >= MOMENTS - 4  # before the manifest is written, and after it is removed, there is nothing to go on


class Stages:
    """Keeps how many samples each stage was asked for after what had been recalled."""

    def __init__(self) -> None:
        self.steps: dict[str, list[int]] = {}

    def stage(self, name: str, total: int | None) -> None:
        self.name = name
        self.steps[name] = []

    def advance(self, samples: int) -> None:
        self.steps[self.name].append(samples)


class KilledError(BaseException):
    """Ends a build as abruptly as can be inside a process; its folder is copied away before it is removed."""


class Killing(Stages):
    """Keeps the folder of a build as it is when a stage has advanced so often."""

    def __init__(self, folder: Path, stage: str, steps: int) -> None:
        super().__init__()
        self.folder, self.last, self.wanted = folder, stage, steps

    def advance(self, samples: int) -> None:
        super().advance(samples)
        if self.name == self.last and len(self.steps[self.name]) == self.wanted:
            shutil.copytree(self.folder / ".m.lpc.build", self.folder / "kept")
            raise KilledError


def stopped(scan: Path, folder: Path, stage: str, steps: int) -> None:
    """Leave in `folder` what a build that is killed then leaves."""
    with pytest.raises(KilledError):
        build_model([scan], folder / "m.lpc", options(), Killing(folder, stage, steps), clock=time.monotonic)
    (folder / "kept").rename(folder / ".m.lpc.build")


@pytest.mark.parametrize(
    ("stage", "steps", "untouched"),
    [("scatter", 3, ["read", "count"]), ("partition", 4, ["read", "count", "scatter"]),
     ("encode", 1, ["read", "count", "scatter", "partition"])],
)  # fmt: skip
def test_what_was_done_is_not_done_again(
    stage: str, steps: int, untouched: list[str], scan: Path, undisturbed: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    stopped(scan, tmp_path, stage, steps)
    done: list[str] = []

    def noting(module: Any, name: str) -> None:
        function = getattr(module, name)

        def noted(*arguments: Any, **named: Any) -> Any:
            done.append(name)
            return function(*arguments, **named)

        monkeypatch.setattr(module, name, noted)

    noting(pointbuild.build, "survey")
    for name in ("scatter", "_partition_bucket"):
        noting(pointbuild.divide, name)
    noting(pointbuild.publish, "encode_run")
    build_model([scan], tmp_path / "m.lpc", options(), clock=time.monotonic)
    assert digest(tmp_path / "m.lpc") == undisturbed
    names = {"read": "survey", "scatter": "scatter", "partition": "_partition_bucket"}
    assert not {names.get(name) for name in untouched} & set(done)
    if stage == "partition":
        whole = Stages()
        build_model([scan], tmp_path / "n.lpc", options(), whole, clock=time.monotonic)
        assert done.count("_partition_bucket") == 2 * len(whole.steps["partition"]) - steps


@pytest.mark.parametrize("what", ["seed", "color_bits", "scan", "version", "restart", "torn"])
def test_files_of_another_build_are_not_gone_on_with(
    what: str, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = tmp_path / "scan.npz"
    shutil.copy(scan, mine)
    stopped(mine, tmp_path, "partition", 2)
    chosen = options()
    if what == "seed":
        chosen = replace(chosen, seed=1)
    elif what == "color_bits":
        chosen = replace(chosen, color_bits=5)
    elif what == "scan":
        np.savez(mine, xyz=surfaces.bumpy(900, seed=9).xyz)
    elif what == "version":
        monkeypatch.setattr(folder_module, "LAYOUT", 0)
    elif what == "restart":
        monkeypatch.setattr(folder_module, "_system_start", lambda: "another")
    else:
        (tmp_path / ".m.lpc.build" / "manifest.json").write_text('{"inputs"')
    told: list[str] = []
    build_model([mine], tmp_path / "m.lpc", chosen, clock=time.monotonic, tell=told.append)
    assert ["starting over" in text for text in told] == ([] if what == "torn" else [True])
    build_model([mine], tmp_path / "n.lpc", chosen, clock=time.monotonic)
    assert digest(tmp_path / "m.lpc") == digest(tmp_path / "n.lpc")


def test_a_second_build_of_the_same_model_is_refused(scan: Path, tmp_path: Path) -> None:
    out = tmp_path / "m.lpc"

    class Meddling(Stages):
        def stage(self, name: str, total: int | None) -> None:
            super().stage(name, total)
            if name == "partition":
                with pytest.raises(BuildError, match=r"another build of .*m\.lpc is running"):
                    build_model([scan], out, options(), clock=time.monotonic)
                build_model([scan], tmp_path / "other.lpc", options(), clock=time.monotonic)

    build_model([scan], out, options(), Meddling(), clock=time.monotonic)
    assert digest(out) == digest(tmp_path / "other.lpc")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.lpc", "other.lpc"]


def test_a_name_that_is_too_long_for_the_folder(scan: Path, tmp_path: Path) -> None:
    with pytest.raises(BuildError, match="name too long"):
        build_model([scan], tmp_path / f"{'m' * 250}.lpc", options(), clock=time.monotonic)
    assert list(tmp_path.iterdir()) == []


def test_models_of_one_name_share_a_scratch_directory(scan: Path, tmp_path: Path) -> None:
    for name in ("a", "b", "scratch"):
        (tmp_path / name).mkdir()
    chosen = replace(options(), scratch=tmp_path / "scratch")

    class Meddling(Stages):
        def stage(self, name: str, total: int | None) -> None:
            super().stage(name, total)
            if name == "encode":
                build_model([scan], tmp_path / "b" / "m.lpc", chosen, clock=time.monotonic)

    build_model([scan], tmp_path / "a" / "m.lpc", chosen, Meddling(), clock=time.monotonic)
    assert digest(tmp_path / "a" / "m.lpc") == digest(tmp_path / "b" / "m.lpc")
    assert list((tmp_path / "scratch").iterdir()) == []


def test_a_torn_entry_of_a_journal_was_never_there(tmp_path: Path) -> None:
    path = tmp_path / "some.journal"
    journal = Journal(path)
    assert list(journal) == []
    journal.add(np.arange(5), as_array({"a": [1.5, None]}))
    first = path.stat().st_size
    journal.add(np.zeros((2, 0)), np.array(3.0))
    data = path.read_bytes()
    for end in range(first, len(data)):
        path.write_bytes(data[:end])
        again = Journal(path)
        assert again.entries == 1
        assert path.stat().st_size == first
    path.write_bytes(data[:-1] + b"\xff")
    assert Journal(path).entries == 1
    path.write_bytes(data)
    (numbers, told), (empty, three) = list(Journal(path))
    assert numbers.tolist() == [0, 1, 2, 3, 4]
    assert from_array(told) == {"a": [1.5, None]}
    assert (empty.shape, float(three)) == ((2, 0), 3.0)
