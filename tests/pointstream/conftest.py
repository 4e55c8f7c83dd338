"""Models that the tests of this folder share; built once."""

from __future__ import annotations

import numpy as np
import pytest
from oracles.build import build_bytes

from lpc.points import PointBatch


def samples(n: int, seed: int = 0) -> PointBatch:
    """A sphere with normals, colours and scalars, some samples of it coincident."""
    rng = np.random.default_rng(seed)
    xyz = rng.normal(size=(n, 3))
    xyz /= np.linalg.norm(xyz, axis=1)[:, None]
    normal = xyz.astype(np.float32)
    normal[: n // 50] = 0
    xyz[n // 3 : n // 3 + 40] = xyz[n // 3]
    return PointBatch(
        xyz * 10.0 + (500_000.0, 4_000_000.0, 120.0),
        {
            "normal": normal,
            "color": rng.integers(0, 256, (n, 3)).astype(np.uint8),
            "intensity": rng.integers(0, 4000, n).astype(np.uint16),
        },
    )


@pytest.fixture(scope="session")
def scan() -> PointBatch:
    """20,000 samples."""
    return samples(20_000)


@pytest.fixture(scope="session")
def model(scan: PointBatch) -> bytes:
    """Their .lpc file: about 120 clouds on 8 pages, three times as large as the probe."""
    return build_bytes(scan, cloud_size=256, page_nodes=16, seed=3)


@pytest.fixture(scope="session")
def large_model() -> bytes:
    """Clouds of about 4 KB on three pages, 600 KB: four seconds of ADSL."""
    return build_bytes(samples(80_000, seed=2), cloud_size=768, page_nodes=64, seed=6)


@pytest.fixture(scope="session")
def other_model() -> bytes:
    """Another build."""
    return build_bytes(samples(15_000, seed=5), cloud_size=256, page_nodes=16, seed=4)
