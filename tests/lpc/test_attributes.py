"""Values to codes and back: exact, or within the stated error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lpc.attributes import Attribute
from lpc.errors import Corrupt

DEPTHS = [(depth, bits) for depth in (3, 7, 8, 11, 16) for bits in range(1, depth)]


def color(bits: int, **more: Any) -> Attribute:
    return Attribute(name="color", kind="color", dtype=more.pop("dtype", "<u2"), bits=bits, **more)


@pytest.mark.parametrize(("depth", "bits"), DEPTHS)
def test_fewer_bits_of_a_colour_keep_black_white_and_the_stated_error(depth: int, bits: int) -> None:
    attribute = color(bits, depth=depth)
    values = np.arange(1 << depth, dtype=np.uint16)
    codes = attribute.encode(values)
    assert codes.max() < 1 << bits
    assert codes.dtype == attribute.code_dtype
    found = attribute.decode(codes)
    assert found.dtype == values.dtype
    assert (found[0], found[-1]) == (values[0], values[-1])
    apart = np.abs(found.astype(np.int64) - values)
    assert apart.max() == attribute.max_error
    for other in (codes.astype(np.int64) - 1, codes.astype(np.int64) + 1):
        other = np.clip(other, 0, (1 << bits) - 1).astype(attribute.code_dtype)
        assert (apart <= np.abs(attribute.decode(other).astype(np.int64) - values) + 1).all()  # none is much nearer
    np.testing.assert_array_equal(attribute.encode(found), codes)


def test_the_error_counts_in_units_of_the_value() -> None:
    values = np.arange(256, dtype=np.uint16) * 257
    attribute = color(5, depth=8, scale=257)
    assert attribute.max_error == 4 * 257
    found = attribute.decode(attribute.encode(values)).astype(np.int64)
    assert np.abs(found - values).max() == 4 * 257
    assert color(8).max_error == 0


@pytest.mark.parametrize("entry", [{"bits": 5, "depth": 8}, {"bits": 8}, {"bits": 8, "scale": 257}])
def test_the_header_has_a_depth_only_where_there_is_one(entry: dict[str, int]) -> None:
    attribute = color(**entry)
    told = attribute.to_json()
    assert ("depth" in told) == ("depth" in entry)
    assert Attribute.from_json(told) == attribute


@pytest.mark.parametrize(
    "entry", [{"depth": 8}, {"depth": 5}, {"depth": 17}, {"depth": -1}, {"kind": "scalar", "depth": 9}]
)
def test_depths_that_cannot_be(entry: dict[str, Any]) -> None:
    told = {**color(8).to_json(), **entry}
    with pytest.raises(Corrupt, match="depth"):
        Attribute.from_json(told)
