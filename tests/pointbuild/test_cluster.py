"""A build on a cluster gives the bytes of a build on one machine, whoever dies meanwhile."""

from __future__ import annotations

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import fsspec
import numpy as np
import pytest
from click.testing import CliRunner
from fsspec.implementations.memory import MemoryFileSystem
from oracles import surfaces
from support.workers import Dask, environment

from lpc.errors import BuildError
from lpc.points import PointBatch
from pointbuild import BuildOptions, build_model, cluster
from pointbuild.arrays import ArrayScan
from pointbuild.cli import build
from pointbuild.cluster import Cluster, dask_cluster, perform, versions
from pointbuild.progress import Silent
from pointbuild.share import Share

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

OPTIONS = BuildOptions(cloud_size=128, threads=1, bucket_samples=700, block_samples=2000)


class Killing(Silent):
    """Calls a function when a stage has got somewhere."""

    def __init__(self, stage: str, kill: Callable[[], None]) -> None:
        self._stage, self._kill, self._now = stage, kill, ""

    def stage(self, name: str, total: int | None) -> None:
        self._now = name

    def advance(self, samples: int) -> None:
        if self._now == self._stage:
            self._now = ""
            self._kill()


class Refusal(Exception):  # noqa: N818, as stores name theirs
    """Stores have exceptions of their own."""


class StrangeStore(MemoryFileSystem):  # type: ignore[misc]
    """What stores do that folders do not, each of them seen in one."""

    protocol = "strange"
    store: dict[str, Any] = {}  # noqa: RUF012, as in the class above
    pseudo_dirs = [""]  # noqa: RUF012

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.removeprefix("strange://")))

    def cat_file(self, path: str, version: str | None = None, start: Any = None, end: Any = None) -> bytes:
        """Arguments in another order, as in s3fs."""
        if version is not None:
            raise Refusal("a version is a text")
        return bytes(super().cat_file(path, start=start, end=end))

    def mkdir(self, path: str, create_parents: bool = True, **_: Any) -> None:
        """A bucket is made of any name."""
        bucket = self._strip_protocol(path).split("/")[1]
        if bucket != "kept" and not create_parents:
            raise Refusal("no such bucket")

    def mv(self, *_: Any, **__: Any) -> None:
        """Nothing is renamed."""
        raise Refusal("nothing can be moved")

    def _open(self, path: str, mode: str = "rb", **more: Any) -> Any:
        if "forbidden" in path:
            raise Refusal("access\ndenied")
        return super()._open(path, mode, **more)


@pytest.fixture(autouse=True)
def _strange() -> None:
    fsspec.register_implementation("strange", StrangeStore, clobber=True)


@pytest.fixture(scope="module")
def points() -> PointBatch:
    dense = surfaces.bumpy(9000, seed=1, color=True)
    pile = dense.take(slice(0, 900))  # all at one place, but unlike each other
    return PointBatch.concatenate([dense, PointBatch(np.tile(dense.xyz[5], (900, 1)), pile.attributes)])


@pytest.fixture(scope="module")
def reference(points: PointBatch, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return made(points, tmp_path_factory.mktemp("m") / "m.lpc", None)


def made(points: PointBatch, out: Path, workers: Cluster | None, progress: Any = None) -> bytes:
    build_model([ArrayScan(points)], out, OPTIONS, progress, clock=time.monotonic, cluster=workers)
    return out.read_bytes()


@pytest.mark.parametrize("url", [None, "memory://share", "strange://kept/share", "file"])
def test_any_executor_and_share_give_the_same_bytes(
    url: str | None, points: PointBatch, reference: bytes, tmp_path: Path
) -> None:
    # fsspec's memory has what S3 has: whole objects by name, ranges of them, no folders, no renaming.
    folder = tmp_path / "shared"
    folder.mkdir()
    with ThreadPoolExecutor(2) as executor:
        workers = Cluster(executor, 4, f"file://{folder}" if url == "file" else url)
        assert made(points, tmp_path / "m.lpc", workers) == reference
    assert not fsspec.filesystem("memory").find("/share")
    assert not StrangeStore.store
    assert not list(folder.iterdir())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.lpc", "shared"]


def test_a_failed_build_leaves_nothing_in_the_share(points: PointBatch, tmp_path: Path) -> None:
    folder = tmp_path / "shared"
    folder.mkdir()

    def fail() -> None:
        assert list(folder.rglob("sorted-*"))
        raise KeyboardInterrupt

    with ThreadPoolExecutor(1) as executor, pytest.raises(KeyboardInterrupt):
        made(points, tmp_path / "m.lpc", Cluster(executor, 2, str(folder)), Killing("encode", fail))
    assert not list(folder.iterdir())
    assert [path.name for path in tmp_path.iterdir()] == ["shared"]


def test_shares_of_two_builds_do_not_mix(points: PointBatch, reference: bytes, tmp_path: Path) -> None:
    other = PointBatch.concatenate([points, points.take(slice(0, 3000))])
    plain = made(other, tmp_path / "plain.lpc", None)
    with ThreadPoolExecutor(2) as executor, ThreadPoolExecutor(2) as builds:
        workers = Cluster(executor, 4, "memory://both")
        first = builds.submit(made, points, tmp_path / "1.lpc", workers)
        second = builds.submit(made, other, tmp_path / "2.lpc", workers)
        assert first.result() == reference
        assert second.result() == plain


def test_workers_of_other_versions_refuse(tmp_path: Path) -> None:
    with pytest.raises(BuildError, match=r"zstd 0\.0\.1.*install the same versions"):
        perform(Share(str(tmp_path)), "task", (*versions()[:-1], "zstd 0.0.1"), 0)


def test_workers_that_do_not_reach_the_share_say_so(tmp_path: Path) -> None:
    with pytest.raises(BuildError, match="name a folder or a store that all machines share"):
        perform(Share(str(tmp_path / "elsewhere")), "task", versions(), 0)


def test_a_share_of_an_unknown_kind_is_one_sentence(points: PointBatch, tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as executor, pytest.raises(BuildError, match="nosuchstore"):
        made(points, tmp_path / "m.lpc", Cluster(executor, 2, "nosuchstore://bucket"))


@pytest.mark.parametrize(
    ("url", "why"), [("strange://misspelt/share", "no such bucket"), ("strange://kept/forbidden", "access denied")]
)
def test_what_a_store_refuses_is_one_sentence(url: str, why: str, points: PointBatch, tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as executor, pytest.raises(BuildError, match=why) as refusal:
        made(points, tmp_path / "m.lpc", Cluster(executor, 2, url))
    assert "\n" not in str(refusal.value)
    assert not StrangeStore.store
    assert list(tmp_path.iterdir()) == []


def test_the_command_says_when_no_scheduler_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "WAIT", 0.5)
    scan = tmp_path / "a.xyz"
    np.savetxt(scan, np.random.default_rng(0).random((50, 3)))
    arguments = [str(scan), "-o", str(tmp_path / "m.lpc")]
    found = CliRunner().invoke(build, [*arguments, "--dask", "tcp://127.0.0.1:9"])
    assert isinstance(found.exception, BuildError)
    assert str(found.exception).startswith("no Dask scheduler answers at tcp://127.0.0.1:9")
    assert CliRunner().invoke(build, [*arguments, "--share", "x"]).exit_code == 2


KILLED = """
import os, signal, sys, time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from pointbuild import BuildOptions, build_model
from pointbuild.cluster import Cluster
from pointbuild.progress import Silent
from pointbuild.share import SharedRegions

take = SharedRegions.take
def dying(self, regions, bucket):
    take(self, regions, bucket)
    if sys.argv[3] == "share" and bucket == 4:
        os.kill(os.getpid(), signal.SIGKILL)
SharedRegions.take = dying

class Killing(Silent):
    now = ""
    def stage(self, name, total):
        self.now = name
    def advance(self, samples):
        if self.now == sys.argv[3]:
            os.kill(os.getpid(), signal.SIGKILL)

options = BuildOptions(cloud_size=128, threads=1, bucket_samples=700, block_samples=2000)
workers = Cluster(ThreadPoolExecutor(2), 4)
build_model([Path(sys.argv[1])], Path(sys.argv[2]), options, Killing(), clock=time.monotonic, cluster=workers)
"""


@pytest.mark.parametrize("stage", ["share", "partition", "encode", "write"])
def test_a_builder_killed_in_the_middle_goes_on(stage: str, points: PointBatch, tmp_path: Path) -> None:
    scan, out = tmp_path / "scan.npz", tmp_path / "m.lpc"
    np.savez(scan, xyz=points.xyz, **points.attributes)
    build_model([scan], tmp_path / "plain.lpc", OPTIONS, clock=time.monotonic)
    command = [sys.executable, "-c", KILLED, str(scan), str(out), stage]
    assert subprocess.run(command, env=environment(), check=False).returncode == -9
    told: list[str] = []
    with ThreadPoolExecutor(2) as executor:
        workers = Cluster(executor, 4)
        build_model([scan], out, OPTIONS, clock=time.monotonic, tell=told.append, cluster=workers)
    assert "going on with the build that was stopped" in told[0]
    assert out.read_bytes() == (tmp_path / "plain.lpc").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.lpc", "plain.lpc", "scan.npz"]


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Dask]:
    folder = tmp_path / "dask"
    folder.mkdir()
    with ExitStack() as stack:
        yield Dask(folder, stack)


@pytest.mark.parametrize("stage", ["partition", "encode"])
def test_a_worker_killed_in_the_middle_leaves_no_trace(
    stage: str, points: PointBatch, reference: bytes, dask: Dask, tmp_path: Path
) -> None:
    with dask_cluster(dask.address, None) as workers:
        killing = Killing(stage, dask.workers[0].kill)
        assert made(points, tmp_path / "m.lpc", workers, killing) == reference
    assert dask.workers[0].wait() == -9
    assert dask.workers[1].poll() is None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dask", "m.lpc"]
