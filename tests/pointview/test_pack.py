"""What a backend holds decodes to what the format says."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from support import models

from lpc.attributes import Attribute
from lpc.cloud import Cloud
from lpc.octahedral import decode_normals
from pointview.render.pack import Packer

ORIGIN = (5e5, 6e6, 1e3)


def header(*attributes):
    return SimpleNamespace(origin=ORIGIN, step=0.001, attributes=attributes)


def cloud(shift=0, **codes):
    rng = np.random.default_rng(0)
    position = rng.integers(0, 65536, (50, 3)).astype(np.uint16)
    low = rng.integers(0, 1 << shift, (50, 3)).astype(np.uint32) if shift else None
    return Cloud(origin=np.array([10, -20, 3_000_000]), position=position, shift=shift, low=low, codes=codes)


@pytest.mark.parametrize("shift", [0, 1, 5])
def test_positions_are_within_the_dropped_bits(shift):
    original = cloud(shift)
    packed = Packer(header()).pack(original, 100)
    drawn = packed.origin + packed.scale * packed.vertex[:, :3].astype(np.float64)
    exact = np.array(ORIGIN) + 0.001 * original.lattice()
    assert np.abs(drawn - exact).max() <= 0.001 * (2**shift - 1) / 2 + 1e-8


@pytest.mark.parametrize("bits", [4, 8, 10, 16])
def test_normals_of_any_width(bits):
    normal = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[:2] = [[0, 0, -1], [0, 0, 0]]
    attribute = Attribute(name="normal", kind="normal", dtype="<f4", bits=bits)
    from lpc.octahedral import encode_normals

    codes = encode_normals(normal, bits)
    if bits == 16:
        codes[2] = [1, 1]  # all but (0, 0): must not become "no normal"
    word = Packer(header(attribute)).pack(cloud(normal=codes), 100).vertex[:, 3]
    drawn = decode_normals(np.stack([word & 255, word >> 8], axis=1).astype(np.uint8), 8)
    exact = decode_normals(codes, bits)
    assert word[1] == 0
    assert word[2] != 0
    cosine = np.einsum("ij,ij->i", drawn, exact)[np.arange(50) != 1]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 1.5


@pytest.mark.parametrize(("bits", "dtype", "shift"), [(8, "|u1", 0), (8, "<u2", 0), (12, "<u2", 4), (16, "<u2", 8)])
def test_colours_of_any_depth(bits, dtype, shift):
    codes = np.random.default_rng(2).integers(0, 1 << bits, (50, 3)).astype(np.uint16)
    attribute = Attribute(name="color", kind="color", dtype=dtype, bits=bits)
    packed = Packer(header(attribute)).pack(cloud(color=codes), 100)
    np.testing.assert_array_equal(packed.color[:, :3], codes >> shift)


@pytest.mark.parametrize(("depth", "bits"), [(8, 5), (8, 1), (16, 6), (12, 9)])
def test_colours_that_lost_bits_are_as_bright_as_they_were(depth, bits):
    attribute = Attribute(name="color", kind="color", dtype="<u2", bits=bits, depth=depth)
    codes = np.random.default_rng(2).integers(0, 1 << bits, (50, 3)).astype(np.uint16)
    codes[0] = (1 << bits) - 1
    packed = Packer(header(attribute)).pack(cloud(color=codes), 100)
    assert packed.color[:, :3].max() == 255
    np.testing.assert_array_equal(packed.color[:, :3], attribute.decode(codes) >> (depth - 8))


def test_a_cloud_that_is_too_large_is_cut():
    assert len(Packer(header()).pack(cloud(), 20).vertex) == 20


def test_the_packed_model_is_the_model():
    model = models.sphere(500, at=ORIGIN)
    packer = Packer(model.header)
    for node in range(model.header.nodes):
        packed = packer.pack(model.take(node), 256)
        drawn = packed.origin + packed.scale * packed.vertex[:, :3].astype(np.float64)
        np.testing.assert_allclose(drawn, model.positions(node), rtol=0, atol=1e-6)
