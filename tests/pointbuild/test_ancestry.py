"""What is kept of inner nodes stays within its bytes, and makes no difference to the model."""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING

import numpy as np
import pytest
from oracles import surfaces

import pointbuild.build
from lpc.cloud import Cloud
from lpc.context import ANCESTORS
from pointbuild import BuildOptions, build_model
from pointbuild.ancestry import OBJECT_BYTES, Ancestor, Ancestry
from pointbuild.arrays import ArrayScan

if TYPE_CHECKING:
    from pathlib import Path

DEPTH = np.arange(20)
"""A chain: node i is on level i."""


def ancestor(samples: int = 100) -> Ancestor:
    return Ancestor(Cloud(origin=np.zeros(3, np.int64), position=np.zeros((samples, 3), np.uint16)), -1)


SIZE = ancestor().cloud.nbytes + OBJECT_BYTES


def test_what_does_not_fit_is_not_kept() -> None:
    ancestry = Ancestry(2 * SIZE + 1)
    ancestry.keep({node: ancestor() for node in (3, 4, 5)}, DEPTH, 3)
    assert ancestry.find(range(9)).keys() == {3, 4}
    ancestry.keep({3: ancestor(), 6: ancestor()}, DEPTH, 3)  # known, and too much
    assert ancestry.find(range(9)).keys() == {3, 4}


def test_levels_go_when_nothing_below_them_is_to_come() -> None:
    ancestry = Ancestry(2 * SIZE)
    ancestry.keep({0: ancestor(), 1: ancestor()}, DEPTH, 0)
    ancestry.keep({}, DEPTH, ANCESTORS)
    assert ancestry.find(range(9)).keys() == {0, 1}
    ancestry.keep({5: ancestor()}, DEPTH, ANCESTORS + 1)
    assert ancestry.find(range(9)).keys() == {1, 5}


def test_other_machines_begin_with_nothing() -> None:
    ancestry = Ancestry(10 * SIZE)
    ancestry.keep({1: ancestor()}, DEPTH, 1)
    assert not pickle.loads(pickle.dumps(ancestry)).find([1])


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_the_bytes_of_a_model_do_not_depend_on_it(
    share: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = ArrayScan(surfaces.torus(30_000, color=True))
    options = BuildOptions(cloud_size=64, threads=2)
    build_model([scan], tmp_path / "all.lpc", options, clock=lambda: 0.0)
    publish = pointbuild.build.publish
    few = int(share * 30_000 * 11)
    monkeypatch.setattr(
        pointbuild.build, "publish", lambda *args, ancestor_bytes, **more: publish(*args, ancestor_bytes=few, **more)
    )
    build_model([scan], tmp_path / "few.lpc", options, clock=lambda: 0.0)
    assert (tmp_path / "few.lpc").read_bytes() == (tmp_path / "all.lpc").read_bytes()
