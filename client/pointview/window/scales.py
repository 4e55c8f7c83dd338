"""Tidy numbers: ticks of a legend, the length of a scale bar, the unit of a model. Pure."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

STEPS = (1.0, 2.0, 5.0, 10.0)

MOST_DECIMALS = 10
"""Fewer are written; smaller numbers have an exponent."""

UNITS = {"metre": "m", "meter": "m", "foot": "ft", "us survey foot": "ft", "foot_us": "ft", "kilometre": "km"}
"""Names of length units in WKT, and what stands behind a number."""


def tidy_step(span: float, most: int) -> float:
    """Least of 1, 2 or 5 times a power of ten that divides a span into at most `most` parts."""
    power = 10.0 ** math.floor(math.log10(span / most))
    return next(step * power for step in STEPS if step * power * most >= span * (1 - 1e-9))


def ticks(low: float, high: float, most: int = 6) -> list[tuple[float, str]]:
    """Round values from low to high and how they are written, with as many decimals as tell them apart."""
    if not (math.isfinite(low) and math.isfinite(high) and high > low):
        return [(low, f"{low:g}")]
    step = tidy_step(high - low, most)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    if decimals > 8 or (first and abs(first) * step >= 1e15):
        return [(number * step, f"{number * step:g}") for number in range(first, last + 1)]
    return [(number * step, f"{number * step:,.{decimals}f}") for number in range(first, last + 1)]


def tidy_length(longest: float) -> float:
    """Largest of 1, 2 or 5 times a power of ten up to a length > 0."""
    power = 10.0 ** math.floor(math.log10(longest) + 1e-12)
    return max(step * power for step in STEPS if step * power <= longest * (1 + 1e-9))


def written_length(length: float, unit: str) -> str:
    """How a length is written: short ones of metres in cm or mm, long ones in km."""
    if unit == "m":
        for factor, name in ((1e-3, "km"), (1.0, "m"), (1e2, "cm"), (1e3, "mm")):
            if length * factor >= 1 - 1e-9:
                return f"{length * factor:g} {name}"
    return f"{length:g} {unit}".rstrip()


def written_place(place: Sequence[float], bounds: Sequence[float]) -> str:
    """How a point is written: to a ten-thousandth of the model's extent, wherever the model lies."""
    extent = math.dist(bounds[:3], bounds[3:])
    decimals = max(0, -math.floor(math.log10(1e-4 * extent))) if extent > 0 else MOST_DECIMALS
    return ", ".join(f"{value:.7g}" if decimals >= MOST_DECIMALS else f"{value:.{decimals}f}" for value in place)


def unit_of(crs: str | None) -> str:
    """Return what stands behind lengths of a model, by the WKT of its reference system; empty if it does not say."""
    if crs is None:
        return ""
    axes = crs.rpartition("CS[")[2] if "CS[" in crs.partition("[")[2] else crs
    found = re.findall(r'(?:LENGTHUNIT|UNIT)\["([^"]+)"', axes, re.IGNORECASE)
    return UNITS.get(found[-1].lower(), "") if found else ""
