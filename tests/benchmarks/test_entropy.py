"""The bound that sizes are held against."""

from __future__ import annotations

import numpy as np
import pytest
from codec import stream_bits
from entropy import NAMES, entropy, streams

from lpc.attributes import Attribute
from lpc.codec import encode_cloud
from lpc.octahedral import encode_normals
from lpc.payload import RAW_BITS

SCHEMA = (
    Attribute(name="normal", kind="normal", dtype="<f4", bits=8),
    Attribute(name="color", kind="color", dtype="|u1", bits=8),
)


def test_entropy_by_hand() -> None:
    assert entropy(np.array([4, 0, 4])) == pytest.approx(8)
    assert entropy(np.array([0, 9, 0])) == 0
    assert entropy(np.array([2, 1, 1])) == pytest.approx(6)


def test_no_stream_is_stored_below_its_entropy() -> None:
    rng = np.random.default_rng(2)
    xyz = rng.normal(size=(4000, 3))
    xyz /= np.linalg.norm(xyz, axis=1)[:, None]
    codes = {"normal": encode_normals(xyz), "color": rng.integers(0, 256, (4000, 3)).astype(np.uint8)}
    frame = encode_cloud(np.rint(xyz * 900).astype(np.int64), codes, SCHEMA)
    stored = stream_bits(frame, 4000, SCHEMA)
    found = streams(frame, 4000, SCHEMA)
    assert tuple(found) == NAMES
    assert [sum(map(len, found[name])) for name in NAMES] == [4000, 8000, 12_000]
    for name in NAMES:
        least = sum(entropy(np.bincount(tokens)) + RAW_BITS[tokens].sum(dtype=float) for tokens in found[name])
        assert 0.8 * stored[name] < least <= stored[name]
