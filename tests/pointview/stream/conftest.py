"""Two models: one that is here within a second of ADSL, and one that never is."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import surfaces
from oracles.build import build_bytes
from support.built import build_points


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """A torus of 130 KB, half of it colours that no codec can shorten: more than the first request brings."""
    points = surfaces.torus(24_000)
    points.attributes["color"] = np.random.default_rng(1).integers(0, 256, (len(points), 3), dtype=np.uint8)
    path = tmp_path_factory.mktemp("small") / "torus.lpc"
    path.write_bytes(build_bytes(points, cloud_size=512, page_nodes=16, spacing=0.0253))
    assert 120_000 < path.stat().st_size < 150_000
    return path


@pytest.fixture(scope="session")
def endless(tmp_path_factory):
    """A field of 2 MB, most of it colours that no codec can shorten: 13 s of ADSL."""
    points = surfaces.bumpy(250_000)
    points.attributes["color"] = np.random.default_rng(1).integers(0, 65536, (len(points), 3), dtype=np.uint16)
    path = tmp_path_factory.mktemp("endless") / "field.lpc"
    build_points(points, path)
    assert path.stat().st_size > 13 * 156_250
    return path
