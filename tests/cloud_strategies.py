"""Hypothesis strategies for clouds: lattice coordinates with codes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from hypothesis import strategies as st

from lpc.attributes import Attribute, Schema
from lpc.octahedral import encode_normals

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.cloud import Cloud


@dataclass(frozen=True, slots=True, kw_only=True)
class RawCloud:
    """What `encode_cloud` takes."""

    lattice: NDArray[np.int64]
    codes: dict[str, NDArray[Any]]
    schema: Schema

    def __len__(self) -> int:
        return len(self.lattice)

    def take(self, order: NDArray[Any]) -> RawCloud:
        codes = {name: values[order] for name, values in self.codes.items()}
        return RawCloud(lattice=self.lattice[order], codes=codes, schema=self.schema)


ATTRIBUTES = (
    Attribute(name="normal", kind="normal", dtype="<f4", bits=8),
    Attribute(name="fine_normal", kind="normal", dtype="<f4", bits=13),
    Attribute(name="color", kind="color", dtype="|u1", bits=8),
    Attribute(name="deep_color", kind="color", dtype="<u2", bits=16),
    Attribute(name="flag", kind="scalar", dtype="|u1", bits=1),
    Attribute(name="classification", kind="scalar", dtype="|u1", bits=5),
    Attribute(name="intensity", kind="scalar", dtype="<u2", bits=16),
    Attribute(name="ticks", kind="scalar", dtype="<u4", bits=32),
    Attribute(name="serial", kind="scalar", dtype="<u8", bits=33),
    Attribute(name="time", kind="scalar", dtype="<f8", bits=64),
)


def random_codes(rng: np.random.Generator, attribute: Attribute, samples: int, smooth: bool) -> NDArray[Any]:
    """Codes of one attribute, noise over the whole range or a slow drift."""
    if attribute.kind == "normal":
        spread = 0.1 if smooth else 1.0
        normals = rng.normal(size=3) + spread * rng.normal(size=(samples, 3))
        normals[rng.random(samples) < 0.05] = 0.0
        return encode_normals(normals, attribute.bits)
    shape = (samples, 3) if attribute.kind == "color" else (samples,)
    if smooth:
        middle = int(rng.integers(0, 1 << attribute.bits, dtype=np.uint64, endpoint=False))
        drift = rng.integers(0, 4, shape, dtype=np.uint64)
        return ((np.uint64(middle) + drift) % np.uint64(2**attribute.bits - 1)).astype(attribute.code_dtype)
    top = (1 << attribute.bits) - 1
    return rng.integers(0, top, shape, dtype=np.uint64, endpoint=True).astype(attribute.code_dtype)


@st.composite
def raw_clouds(draw: st.DrawFn, most: int = 200) -> RawCloud:
    """Clouds of 1 to `most` samples, from all coincident to 2**48 steps wide, with any attributes."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    samples = draw(st.integers(1, most))
    extents = [1 << draw(st.sampled_from([0, 1, 3, 7, 10, 12, 16, 17, 24, 40, 48])) for _ in range(3)]
    corner = [draw(st.integers(-(2**51), 2**51)) for _ in range(3)]
    lattice = np.stack([rng.integers(0, extent, samples) for extent in extents], axis=1) + np.array(corner)
    if draw(st.booleans()):  # coincident samples, some with equal attributes
        lattice = lattice[rng.integers(0, max(1, samples // 4), samples)]
    schema = tuple(draw(st.lists(st.sampled_from(ATTRIBUTES), unique=True, max_size=4)))
    smooth = draw(st.booleans())
    codes = {attribute.name: random_codes(rng, attribute, samples, smooth) for attribute in schema}
    return RawCloud(lattice=lattice, codes=codes, schema=schema)


def rows(lattice: Any, codes: dict[str, Any]) -> list[list[int]]:
    """Samples with their codes as lists of integers, sorted: to compare as sets with repetitions."""
    parts = [np.asarray(lattice).astype(object)]
    parts += [np.asarray(values).reshape(len(parts[0]), -1).astype(object) for values in codes.values()]
    return sorted(np.concatenate(parts, axis=1).tolist())


def assert_same(first: Cloud, second: Cloud) -> None:
    assert first.shift == second.shift
    np.testing.assert_array_equal(first.origin, second.origin)
    np.testing.assert_array_equal(first.position, second.position)
    assert (first.low is None) == (second.low is None)
    if first.low is not None and second.low is not None:
        np.testing.assert_array_equal(first.low, second.low)
    assert first.codes.keys() == second.codes.keys()
    for name, values in first.codes.items():
        assert values.dtype == second.codes[name].dtype
        np.testing.assert_array_equal(values, second.codes[name])
