"""Thin parts of a cloud: found with their spacing, and nothing else taken for one."""

from __future__ import annotations

import numpy as np
import pytest

from lpc.octahedral import encode_normals
from pointview.render import thin as module
from pointview.render.tables import STEPS
from pointview.render.thin import FEWEST, LARGEST_GRID, thin

SIDE = 60_000


def plane(counts, *, seed=0):
    """Samples of a square whose left part is dense, the right one thin: (k, 3) positions, true spacings."""
    rng = np.random.default_rng(seed)
    dense, sparse = (rng.random((count, 2)) * [SIDE / 2, SIDE] for count in counts)
    flat = np.concatenate([dense, sparse + np.array([SIDE / 2, 0])])
    spacing = np.repeat([np.sqrt(SIDE * SIDE / 2 / count) for count in counts], counts)
    tilted = np.stack([flat[:, 0], flat[:, 1] * 0.8, 5000 + flat[:, 1] * 0.6], axis=1)
    return tilted.astype(np.uint16), spacing


def code_of(normal, count):
    u, v = encode_normals(np.array([normal], dtype=np.float32), 8)[0].astype(np.uint16)
    return np.full(count, u | v << 8, dtype=np.uint16)


@pytest.mark.parametrize("ratio", [9, 20, 40])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_thin_half_of_a_plane(ratio, seed):
    position, spacing = plane((2000, 2000 // ratio), seed=seed)
    codes = thin(position, code_of((0, -0.6, 0.8), len(position)))
    sparse = spacing > spacing[0]
    assert (codes[~sparse] > 0).mean() < 0.01
    inner = sparse & (position[:, 0] > SIDE / 2 + spacing[-1])
    assert (codes[inner] > 0).mean() > 0.8
    apart = 2.0 ** (codes[inner & (codes > 0)] / STEPS)
    assert 0.7 * spacing[-1] < np.median(apart) < 1.3 * spacing[-1]
    assert apart.max() < 2.5 * spacing[-1]


@pytest.mark.parametrize("seed", range(4))
def test_an_even_cloud_has_none(seed):
    position, _ = plane((1000, 1000), seed=seed)
    assert (thin(position, code_of((0, -0.6, 0.8), len(position))) > 0).mean() < 0.002


def test_strays_and_samples_without_plane_stay_as_they_are():
    position, _ = plane((2000, 20))
    rng = np.random.default_rng(3)
    strays = rng.integers(0, 65_536, (60, 3)).astype(np.uint16)
    position = np.concatenate([position, strays])
    normal = code_of((0, -0.6, 0.8), len(position))
    bytes_of = rng.normal(size=(60, 3)).astype(np.float32)
    bytes_of /= np.linalg.norm(bytes_of, axis=1)[:, None]
    u, v = encode_normals(bytes_of, 8).astype(np.uint16).T
    normal[-60:] = u | v << 8
    assert np.count_nonzero(thin(position, normal)[-60:]) <= 3
    assert not thin(position, np.zeros_like(normal)).any()


def test_few_samples_say_nothing():
    position, _ = plane((FEWEST - 2, 1))
    assert not thin(position, code_of((0, -0.6, 0.8), len(position))).any()
    same = np.full((100, 3), 7, dtype=np.uint16)
    assert not thin(same, code_of((0, 0, 1), 100)).any()


def test_grids_of_a_dense_clump_with_strays_stay_small(monkeypatch):
    rng = np.random.default_rng(5)
    position = rng.integers(30_000, 30_100, (2000, 3)).astype(np.uint16)
    position[:4] = rng.integers(0, 65_536, (4, 3))
    shapes, shape = [], module._shape
    monkeypatch.setattr(module, "_shape", lambda *box: shapes.append(shape(*box)) or shapes[-1])
    assert not thin(position, code_of((0, 0, 1), len(position))).any()
    assert np.max(shapes) <= LARGEST_GRID + 3
