"""The lattice keeps its promise about errors, at any size and any distance from the origin."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lpc.errors import BuildError
from lpc.lattice import dequantise, paper_bits, position_error_bound, position_step, quantise


@pytest.mark.parametrize(
    ("extent", "spacing", "bits"),
    [(5200, 2, 13), (5200, 1, 14), (2700, 0.25, 15), (2048, 1, 13)],  # David 2 mm, David 1 mm, St. Matthew, isosurface
)
def test_bits_of_the_paper(extent: float, spacing: float, bits: int) -> None:
    assert paper_bits(extent, spacing) == bits


def test_bits_of_the_paper_by_its_words() -> None:
    assert paper_bits(0.0, 1.0) == 0
    assert paper_bits(1.0, 1.0) == 2  # 1 / 2 is not below r / 2
    for spacing in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="spacing"):
            paper_bits(1.0, spacing)


def test_step_from_the_spacing_keeps_the_error_under_half_of_it() -> None:
    step = position_step(2.0, 1000.0)
    assert step == pytest.approx(0.999 * 2.0 / 3**0.5)
    assert position_error_bound(step, np.zeros(3), 1000.0) < 1.0


@given(st.floats(1e-3, 10.0), st.floats(1.0, 1e5), st.floats(0.0, 1e7))
def test_rounding_stays_inside_the_slack(spacing: float, extent: float, away: float) -> None:
    step = position_step(spacing, extent)
    assert position_error_bound(step, np.array([away, -away, 0.0]), extent) < spacing / 2


def test_step_from_a_bound() -> None:
    step = position_step(5.0, 1000.0, 0.01)
    assert 0.0098 < position_error_bound(step, np.full(3, 1e6), 1000.0) < 0.01


@pytest.mark.parametrize("error", [0.0, -1.0, float("nan"), float("inf"), 1e-12])
def test_a_bound_that_cannot_be_kept_is_refused_in_one_line(error: float) -> None:
    with pytest.raises(BuildError, match="position error") as caught:
        position_step(1.0, 1000.0, error)
    assert "\n" not in str(caught.value)


def test_the_advice_of_a_refusal_works() -> None:
    with pytest.raises(BuildError) as caught:
        position_step(1.0, 1000.0, 1e-13)
    least = float(str(caught.value).rsplit(" ", 1)[1])
    assert position_step(1.0, 1000.0, least * 1.01) > 0


@given(st.floats(0, 1e9), st.floats(0, 1e9))
def test_step_is_positive_and_spans_less_than_48_bits(spacing: float, extent: float) -> None:
    step = position_step(spacing, extent)
    assert step > 0
    assert extent / step < 2**48


def error(xyz: Any, origin: Any, step: float) -> float:
    """Largest distance between positions and what comes back, in exact arithmetic."""
    back = dequantise(quantise(xyz, origin, step), origin, step)
    squares = [
        sum((Fraction(a) - Fraction(b)) ** 2 for a, b in zip(p, q, strict=True))
        for p, q in zip(xyz.tolist(), back.tolist(), strict=True)
    ]
    return float(max(squares)) ** 0.5


@given(
    st.tuples(*[st.floats(-1e7, 1e7)] * 3),
    st.floats(1e-3, 1e5),
    st.floats(0, 47),
    st.integers(0, 2**32),
)
def test_no_position_moves_further_than_the_bound(
    origin: tuple[float, ...], extent: float, bits: float, seed: int
) -> None:
    step = extent / 2**bits
    corner = np.array(origin)
    xyz = corner + np.random.default_rng(seed).random((20, 3)) * extent
    reach = float((xyz - corner).max())
    assert error(xyz, corner, step) <= position_error_bound(step, corner, reach)


def test_millimetres_survive_at_utm_coordinates() -> None:
    origin = np.array([8_500_000.0, 9_999_999.0, 300.0])
    rng = np.random.default_rng(1)
    xyz = origin + np.round(rng.random((1000, 3)) * 2000, 3)
    step = position_step(0.5, 2000.0, 0.0005)
    back = dequantise(quantise(xyz, origin, step), origin, step)
    np.testing.assert_array_equal(np.round(back - origin, 3), np.round(xyz - origin, 3))
    assert np.linalg.norm(back - xyz, axis=1).max() <= 0.0005


def test_half_the_bound_is_used() -> None:
    rng = np.random.default_rng(2)
    step = position_step(1.0, 100.0)
    assert error(rng.random((2000, 3)) * 100, np.zeros(3), step) > 0.4


@given(st.integers(0, 2**32), st.integers(0, 30))
def test_quantising_twice_changes_nothing(seed: int, bits: int) -> None:
    lattice = np.random.default_rng(seed).integers(0, 1 << bits, (50, 3), endpoint=True)
    origin = np.array([1e6, -2e6, 17.25])
    np.testing.assert_array_equal(quantise(dequantise(lattice, origin, 0.001), origin, 0.001), lattice)
