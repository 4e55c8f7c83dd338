"""The ceiling on resident memory: sizes follow from it, and a build that would use more keeps it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import surfaces
from support.built import build_points

from lpc.errors import BuildError
from pointbuild import BuildOptions
from pointbuild.memory import NODE_BYTES, READ_BYTES, RESERVE, bucket_bytes, choose_sizes

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
    assert held + (sizes.threads + 2) * sizes.block * READ_BYTES <= memory * MEBI
    assert 1 <= sizes.threads <= threads
    assert sizes.bucket >= 4 * cloud_size


@given(row=st.integers(32, 600), threads=st.integers(1, 8))
def test_what_is_said_to_be_enough_is(row: int, threads: int) -> None:
    with pytest.raises(BuildError) as told:
        choose_sizes(BuildOptions(memory_bytes=MEBI, threads=threads), 10**7, row, 150 * MEBI)
    enough = int(str(told.value).split("allow at least ")[1].split(" MiB")[0])
    choose_sizes(BuildOptions(memory_bytes=enough * MEBI, threads=threads), 10**7, row, 150 * MEBI)


def test_a_build_keeps_the_ceiling(tmp_path: Path) -> None:
    """Left alone, two threads would sort 800,000 samples each and take 320 MiB in all."""
    build_points(surfaces.bumpy(500), tmp_path / "m.lpc")  # the child finds all kernels compiled
    np.savez(tmp_path / "scan.npz", xyz=np.random.default_rng(0).random((1_600_000, 3)))
    paths = os.pathsep.join(str(REPOSITORY / part) for part in ("common", "server"))
    done = subprocess.run(
        [sys.executable, "-c", "from pointbuild.cli import build; build()", str(tmp_path / "scan.npz"),
         "-o", str(tmp_path / "m.lpc"), "--memory", "290M", "--threads", "2", "--json"],
        env={**os.environ, "PYTHONPATH": paths}, capture_output=True, check=True,
    )  # fmt: skip
    assert json.loads(done.stdout)["peak_rss_bytes"] <= 290 * MEBI
