"""The ceiling on resident memory: sizes follow from it, and a build that would use more keeps it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import surfaces

from lpc.errors import BuildError
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan
from pointbuild.memory import NODE_BYTES, RESERVE, bucket_bytes, choose_sizes, encode_bytes, read_bytes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from lpc.points import PointBatch

REPOSITORY = Path(__file__).resolve().parents[2]
MEBI = 1 << 20


@given(
    memory=st.integers(1, 8000),
    samples=st.integers(1, 10**9),
    row=st.integers(32, 600),
    cloud_size=st.sampled_from([1, 512, 2048, 65535]),
    threads=st.integers(1, 64),
)
def test_sizes_stay_under_the_ceiling(memory: int, samples: int, row: int, cloud_size: int, threads: int) -> None:
    options = BuildOptions(memory_bytes=memory * MEBI, threads=threads, cloud_size=cloud_size)
    try:
        sizes = choose_sizes(options, samples, row, 150 * MEBI)
    except BuildError:
        return
    held = 150 * MEBI + RESERVE + NODE_BYTES * 2 * (samples // cloud_size)
    assert held + sizes.threads * sizes.bucket * bucket_bytes(row) <= memory * MEBI
    assert held + (sizes.threads + 2) * sizes.block * read_bytes(row) <= memory * MEBI
    assert held + sizes.threads * encode_bytes(row, cloud_size) + sizes.ancestors <= memory * MEBI
    assert 1 <= sizes.threads <= threads
    assert sizes.bucket >= 4 * cloud_size


@given(row=st.integers(32, 600), threads=st.integers(1, 8))
def test_what_is_said_to_be_enough_is(row: int, threads: int) -> None:
    with pytest.raises(BuildError) as told:
        choose_sizes(BuildOptions(memory_bytes=MEBI, threads=threads), 10**7, row, 150 * MEBI)
    enough = int(str(told.value).split("allow at least ")[1].split(" MiB")[0])
    choose_sizes(BuildOptions(memory_bytes=enough * MEBI, threads=threads), 10**7, row, 150 * MEBI)


LIMITED_BUILD = """
import resource, sys
limit = int(sys.argv.pop(1))
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
from pointbuild.cli import build
build()
"""
RESERVED = 64 * MEBI  # of address space that is never touched: stacks of threads, arenas of allocators


def limited(limit: int, folder: Path, *arguments: str) -> dict[str, Any]:
    """Report of a build of scan.npz in a process whose data may not grow beyond `limit`."""
    paths = os.pathsep.join(str(REPOSITORY / part) for part in ("common", "server"))
    done = subprocess.run(
        [sys.executable, "-c", LIMITED_BUILD, str(limit), str(folder / "scan.npz"),
         "-o", str(folder / "m.lpc"), "--json", *arguments],
        env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-500:]
    report: dict[str, Any] = json.loads(done.stdout)
    return report


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Let a process of its own compile all kernels, which takes more memory than any build here."""
    folder = tmp_path_factory.mktemp("compiled")
    np.savez(folder / "scan.npz", xyz=np.eye(3))
    limited(1 << 40, folder)


def ordered(order: str) -> dict[str, NDArray[Any]]:
    """1.2 million samples, 65 bytes each while they are sorted: four times what the ceiling leaves room for."""
    rng = np.random.default_rng(0)
    xyz = rng.random((1_200_000, 3))
    if order == "by x":
        xyz = xyz[np.argsort(xyz[:, 0])]
    elif order == "by time":  # a scanner's sweeps: rows of y one after another
        xyz = xyz[np.argsort(np.floor(xyz[:, 1] * 300) + xyz[:, 0])]
    elif order == "in a corner":
        xyz[:-100] = xyz[:-100] ** 8 * 1e-3
    elif order == "in one place":
        xyz[: len(xyz) * 3 // 4] = 0.25
    return {"xyz": xyz, "color": rng.integers(0, 256, xyz.shape, np.uint8)}


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("order", ["shuffled", "by x", "by time", "in a corner", "in one place"])
def test_a_build_keeps_the_ceiling_under_a_limit_of_the_system(order: str, tmp_path: Path) -> None:
    """The system ends a process that asks for more; what is resident stays under the ceiling itself."""
    np.savez(tmp_path / "scan.npz", **ordered(order))  # type: ignore[arg-type]
    told = limited(290 * MEBI + RESERVED, tmp_path, "--memory", "290M", "--threads", "2")
    assert told["samples"] == 1_200_000
    assert told["peak_rss_bytes"] <= 290 * MEBI


def test_a_tighter_limit_of_the_system_is_said(tmp_path: Path) -> None:
    class Greedy(ArrayScan):
        def batches(self, size: int) -> Iterator[PointBatch]:
            raise MemoryError

    with pytest.raises(BuildError, match=r"less memory than the build of .* may use: lower --memory"):
        build_model([Greedy(surfaces.bumpy(100))], tmp_path / "m.lpc", BuildOptions(), clock=time.monotonic)
    assert list(tmp_path.iterdir()) == []
