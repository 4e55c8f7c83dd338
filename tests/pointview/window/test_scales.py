"""Tidy numbers of legends and scale bars."""

from __future__ import annotations

import math

import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointview.window.scales import ticks, tidy_length, tidy_step, unit_of, written_length, written_place

spans = st.floats(1e-6, 1e7)


@given(low=st.floats(-1e7, 1e7), span=spans, most=st.integers(2, 12))
def test_ticks_are_round_within_the_range_and_told_apart(low, span, most):
    high = low + span
    if high - low < 1e-9 * abs(low):
        return
    found = ticks(low, high, most)
    values = [value for value, _ in found]
    slack = 1e-6 * (high - low)
    assert all(low - slack <= value <= high + slack for value in values)
    assert len(values) <= most + 1
    step = tidy_step(high - low, most)
    assert len(values) >= math.floor((high - low) / step - 1e-6)
    assert all(abs(value / step - round(value / step)) < 1e-3 for value in values)


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (2322.9, 2338.58, ["2,325", "2,330", "2,335"]),
        (-0.003, 0.0041, ["-0.002", "0.000", "0.002", "0.004"]),
        (0, 65535, ["0", "20,000", "40,000", "60,000"]),
        (3.25, 3.25, ["3.25"]),
    ],
)
def test_ticks_as_people_write_them(low, high, texts):
    assert [text for _, text in ticks(low, high)] == texts


@given(longest=st.floats(1e-9, 1e9))
def test_a_tidy_length_fills_its_place(longest):
    length = tidy_length(longest)
    assert 0.39 * longest < length <= longest * (1 + 1e-9)
    assert f"{length:.6e}"[:8] in ("1.000000", "2.000000", "5.000000")


def test_lengths_in_their_unit():
    assert [written_length(length, "m") for length in (0.002, 0.05, 1.0, 500.0, 2000.0)] == [
        "2 mm", "5 cm", "1 m", "500 m", "2 km",
    ]  # fmt: skip
    assert written_length(0.05, "ft") == "0.05 ft"
    assert written_length(20.0, "") == "20"


@pytest.mark.parametrize("version", ["WKT1_GDAL", "WKT2_2019"])
@pytest.mark.parametrize(("code", "unit"), [(32718, "m"), (2154, "m"), (2263, "ft"), (4326, ""), (4978, "m")])
def test_the_unit_of_a_reference_system(code, unit, version):
    assert unit_of(pyproj.CRS(code).to_wkt(version)) == unit


def test_without_a_reference_system_there_is_no_unit():
    assert unit_of(None) == ""
    assert unit_of("nonsense") == ""


@pytest.mark.parametrize(
    ("place", "size", "text"),
    [
        ((515384.8012, 4918361.2178, 2330.7361), 60.0, "515384.801, 4918361.218, 2330.736"),
        ((-0.0123456, 0.1, 0.2), 0.3, "-0.01235, 0.10000, 0.20000"),
        ((1.25e6, 0.0, -3.4), 5e6, "1250000, 0, -3"),
        ((1.5, 2.5, 3.5), 0.0, "1.5, 2.5, 3.5"),
        ((1.23456789e-12, 0.0, 0.0), 1e-11, "1.234568e-12, 0, 0"),
    ],
)
def test_places_are_written_as_exactly_as_the_model_is_large(place, size, text):
    assert written_place(place, (0.0, 0.0, 0.0, size, 0.0, 0.0)) == text
