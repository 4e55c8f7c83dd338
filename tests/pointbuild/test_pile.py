"""Samples at one place, more than are sorted in memory together: the same chain as in one bucket with all others."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from oracles import surfaces
from support.built import build_points

import pointbuild.pile
from lpc.errors import BuildError
from lpc.points import PointBatch
from pointbuild.plan import Bucket

if TYPE_CHECKING:
    from pathlib import Path

RNG = np.random.default_rng(4)


def with_piles(spread: float) -> PointBatch:
    """A surface with two piles on it; `spread` is too little for a path to tell but not for float64."""
    surface = surfaces.bumpy(3000, seed=1, color=True)
    parts = [surface]
    for sample, count in ((10, 100_000), (2000, 900)):
        pile = PointBatch.concatenate([surface.take(slice(sample, sample + 1))] * count)
        turned = RNG.normal(size=(count, 3)).astype(np.float32)
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        color = RNG.integers(0, 256, (count, 3)).astype(np.uint8)
        xyz = pile.xyz + RNG.random(pile.xyz.shape) * spread
        parts.append(PointBatch(xyz, {"normal": turned, "color": color}))
    points = PointBatch.concatenate(parts)
    return points.take(RNG.permutation(len(points)))


@pytest.mark.parametrize("spread", [0.0, 2.0**-51])
@pytest.mark.parametrize("cloud_size", [64, 300])
def test_a_pile_in_a_bucket_of_its_own_leaves_no_trace(
    spread: float, cloud_size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = with_piles(spread)
    monkeypatch.setattr(pointbuild.pile, "CHUNK", 999)
    piles = []
    real = pointbuild.pile.partition_pile
    monkeypatch.setattr("pointbuild.divide.partition_pile", lambda *a, **k: piles.append(0) or real(*a, **k))
    error = 1e-3 if spread else None
    one, other = tmp_path / "a.lpc", tmp_path / "b.lpc"
    apart = build_points(points, one, cloud_size=cloud_size, bucket_samples=800, threads=2, position_error=error)
    assert len(piles) == 2
    together = build_points(points, other, cloud_size=cloud_size, bucket_samples=1 << 20, position_error=error)
    assert len(piles) == 2
    assert apart.data == together.data
    assert (apart.index.samples == 65535).any()


@pytest.mark.parametrize("kinds", [1, 3])
def test_a_pile_of_equal_samples_is_sorted_on_disk_as_any(
    kinds: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their priorities are equal, so no slice of priorities is small."""
    monkeypatch.setattr(pointbuild.pile, "CHUNK", 999)
    surface = surfaces.bumpy(3000, seed=1, color=True)
    pile = PointBatch.concatenate([surface.take(slice(0, kinds))] * (90_000 // kinds))
    pile.xyz[:] = surface.xyz[0]
    points = PointBatch.concatenate([surface, pile])
    points = points.take(RNG.permutation(len(points)))
    apart = build_points(points, tmp_path / "a.lpc", cloud_size=64, bucket_samples=800)
    together = build_points(points, tmp_path / "b.lpc", cloud_size=64, bucket_samples=1 << 20)
    assert apart.data == together.data


def test_more_than_a_chain_can_hold_is_said_before_the_work() -> None:
    most = 65535 * 256
    pointbuild.pile.check_piles([Bucket(0, 10**9), Bucket(3, most, coincident=True)])
    with pytest.raises(BuildError, match="too many samples stand at one place"):
        pointbuild.pile.check_piles([Bucket(3, most + 1, coincident=True)])
