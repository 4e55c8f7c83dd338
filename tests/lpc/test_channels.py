"""Attribute codes spread over channels and gathered again."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lpc.attributes import Attribute
from lpc.channels import channels_of, from_channels, to_channels


def attribute(kind: str, bits: int) -> Attribute:
    return Attribute(name="a", kind=kind, dtype="<u8" if kind == "scalar" else "<u2", bits=bits)  # type: ignore[arg-type]


@given(st.integers(1, 16), st.integers(0, 2**32))
def test_colours_are_lossless_and_fit_their_channels(bits: int, seed: int) -> None:
    schema = (attribute("color", bits),)
    rng = np.random.default_rng(seed)
    extremes = np.array([[r, g, b] for r in (0, 1) for g in (0, 1) for b in (0, 1)]) * (2**bits - 1)
    values = np.concatenate([extremes, rng.integers(0, 2**bits, (50, 3))]).astype(schema[0].code_dtype)
    rows = to_channels({"a": values}, schema, len(values))
    assert (rows.max(axis=1) < 1 << channels_of(schema).bits).all()
    np.testing.assert_array_equal(from_channels(rows, schema)["a"], values)


@given(st.integers(1, 64), st.data())
def test_scalars_are_lossless(bits: int, data: st.DataObject) -> None:
    schema = (attribute("scalar", bits),)
    values = np.array(data.draw(st.lists(st.integers(0, 2**bits - 1), min_size=1)), schema[0].code_dtype)
    rows = to_channels({"a": values}, schema, len(values))
    assert len(rows) == len(channels_of(schema)) == (2 if bits > 32 else 1)
    back = from_channels(rows, schema)["a"]
    assert back.dtype == schema[0].code_dtype
    np.testing.assert_array_equal(back, values)


def test_grey_has_no_chroma() -> None:
    grey = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    rows = to_channels({"a": grey}, (attribute("color", 8),), 256)
    np.testing.assert_array_equal(rows, [np.arange(256), np.zeros(256), np.zeros(256)])


@given(st.integers(1, 16), st.integers(0, 2**32))
def test_rows_that_no_colour_gives_still_give_codes_in_range(bits: int, seed: int) -> None:
    schema = (attribute("color", bits),)
    top = (np.int64(1) << channels_of(schema).bits)[:, None]
    rows = np.random.default_rng(seed).integers(0, top, (3, 100)).astype(np.uint32)
    assert from_channels(rows, schema)["a"].max() < 1 << bits


@pytest.mark.parametrize(
    ("kind", "bits", "codes"),
    [
        ("scalar", 4, np.array([16])),
        ("scalar", 40, np.array([1 << 40])),
        ("color", 8, np.array([[256, 0, 256]])),
        ("normal", 8, np.array([[0, 255]])),
        ("scalar", 4, np.array([-1])),
        ("normal", 8, np.array([[255, 0]])),
    ],
)
def test_codes_beyond_their_bits_are_refused(kind: str, bits: int, codes: np.ndarray) -> None:
    with pytest.raises(ValueError, match="between 0 and"):
        to_channels({"a": codes}, (attribute(kind, bits),), 1)


def test_a_normal_needs_two_bits() -> None:
    with pytest.raises(ValueError, match="2 to 16"):
        attribute("normal", 1)
