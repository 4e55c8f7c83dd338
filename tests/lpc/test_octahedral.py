"""Normals: the error that the header may promise, and codes that mean one direction each."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lpc.octahedral import decode_normals, encode_normals, fold_codes, max_error_degrees, unfold_codes
from lpc.octahedral_compiled import unit_vectors

ENGINES = ("compiled", "numpy")


def directions(count: int) -> Any:
    """Evenly random directions and the hard ones: near axes, edges and face centres of the octahedron."""
    rng = np.random.default_rng(4)
    even = rng.normal(size=(count, 3))
    hard = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)])
    near = np.repeat(hard, count // 26, axis=0) + rng.normal(size=(26 * (count // 26), 3)) * 0.02
    normals = np.concatenate([even, hard, near])
    return normals / np.linalg.norm(normals, axis=1)[:, None]


def angles(first: Any, second: Any) -> Any:
    """Degrees between unit vectors, exact for small angles, too."""
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(first - second, axis=1) / 2, 0, 1)))


@pytest.mark.parametrize("bits", range(2, 17))
def test_no_normal_moves_further_than_promised(bits: int) -> None:
    normals = directions(30_000)
    moved = angles(decode_normals(encode_normals(normals, bits), bits).astype(float), normals)
    assert moved.max() <= max_error_degrees(bits)
    assert moved.max() >= 0.6 * max_error_degrees(bits)


def test_promise_at_eight_bits() -> None:
    assert 0.63 < max_error_degrees(8) < 0.65


@pytest.mark.parametrize("bits", [3, 5, 6])
def test_the_search_finds_what_trying_all_codes_finds(bits: int) -> None:
    levels = (1 << bits) - 1
    codes = np.stack(np.meshgrid(np.arange(levels), np.arange(levels), indexing="ij"), axis=-1).reshape(-1, 2)[1:]
    table = decode_normals(codes, bits).astype(float)
    normals = directions(2000)
    best = np.degrees(np.arccos(np.clip((normals @ table.T).max(axis=1), -1, 1)))
    found = angles(decode_normals(encode_normals(normals, bits), bits).astype(float), normals)
    # a code outside the square around the sample may be nearer, by little and seldom
    assert np.quantile(found - best, 0.9) < 1e-3
    assert (found - best).max() < 0.2 * max_error_degrees(bits)


@pytest.mark.parametrize("bits", [2, 8, 11, 16])
def test_engines_agree(bits: int) -> None:
    normals = directions(20_000)
    compiled, plain = (encode_normals(normals, bits, engine=engine) for engine in ("compiled", "numpy"))
    assert compiled.dtype == plain.dtype == (np.uint8 if bits <= 8 else np.uint16)
    np.testing.assert_array_equal(compiled, plain)


@pytest.mark.parametrize("bits", range(2, 17))
def test_engines_decode_alike(bits: int) -> None:
    most = (1 << bits) - 2
    codes = np.random.default_rng(bits).integers(0, most + 1, (5000, 2)).astype(np.uint16)
    codes[:4] = [[0, 0], [0, most], [most, 0], [most // 2, most // 2]]
    np.testing.assert_array_equal(unit_vectors(codes, bits), decode_normals(codes, bits))


@given(arrays(np.float64, (6, 3), elements=st.floats(allow_subnormal=True)))
def test_any_floats_encode_alike_and_only_nothing_is_no_normal(normals: Any) -> None:
    compiled, plain = (encode_normals(normals, engine=engine) for engine in ("compiled", "numpy"))
    np.testing.assert_array_equal(compiled, plain)
    real = np.isfinite(normals).all(axis=1) & (normals != 0).any(axis=1)
    np.testing.assert_array_equal((compiled != 0).any(axis=1), real)
    np.testing.assert_array_equal(decode_normals(compiled).any(axis=1), real)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_axes_are_exact(engine: Any, axis: int, sign: float) -> None:
    normal = np.zeros((1, 3), np.float32)
    normal[0, axis] = sign
    for bits in (2, 8, 16):
        np.testing.assert_array_equal(decode_normals(encode_normals(normal, bits, engine=engine), bits), normal)


def test_every_direction_has_one_code_that_encodes_again() -> None:
    levels = 2**8 - 1
    codes = np.stack(np.meshgrid(np.arange(levels), np.arange(levels), indexing="ij"), axis=-1).reshape(-1, 2)[1:]
    canonical = fold_codes(unfold_codes(codes.T, 127), 127).T
    again = encode_normals(decode_normals(codes))
    np.testing.assert_array_equal(again, canonical)
    np.testing.assert_array_equal(decode_normals(canonical), decode_normals(codes))
    assert len(np.unique(canonical, axis=0)) == len(np.unique(decode_normals(codes), axis=0))


@pytest.mark.parametrize("length", [1e-300, 1e-30, 3.0, 1e300])
@pytest.mark.parametrize("engine", ENGINES)
def test_length_does_not_matter(length: float, engine: Any) -> None:
    normals = directions(500)
    np.testing.assert_array_equal(encode_normals(normals * length, engine=engine)[:400], encode_normals(normals)[:400])


def test_decoded_normals_are_unit_vectors() -> None:
    normals = decode_normals(encode_normals(directions(1000)))
    assert normals.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("bits", [0, 1, 17])
def test_bits_out_of_range(bits: int) -> None:
    for call in (lambda: encode_normals(np.ones((1, 3)), bits), lambda: max_error_degrees(bits)):
        with pytest.raises(ValueError, match="bits"):
            call()
