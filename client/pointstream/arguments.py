"""Kinds of option values that several commands share; a wrong one is exit status 2 and one line."""

from __future__ import annotations

import math
from typing import Any

import click

Bounds = tuple[float, float, float, float, float, float]

MOST = 2**62
"""Largest count that is taken: what is computed with it stays within 64 bits."""
DEEPEST = 255
"""Level of the deepest node that a file may have."""


class Number(click.FloatRange):
    """A finite number in a range: click's own ranges let NaN pass, which is neither below nor above anything."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


POSITIVE = Number(min=0, min_open=True)
"""A finite number above 0: lengths, pixels, seconds."""
COUNT = click.IntRange(min=1, max=MOST)
"""A whole number of things."""


class BoundsType(click.ParamType[Bounds]):
    """X0,Y0,Z0,X1,Y1,Z1, model units."""

    name = "X0,Y0,Z0,X1,Y1,Z1"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Bounds:
        """Return six finite numbers, the lower corner first."""
        try:
            x0, y0, z0, x1, y1, z1 = bounds = tuple(float(part) for part in value.split(","))
        except ValueError:
            self.fail(f"{value!r} is not six numbers X0,Y0,Z0,X1,Y1,Z1", param, ctx)
        if not all(map(math.isfinite, bounds)) or not (x0 <= x1 and y0 <= y1 and z0 <= z1):
            self.fail(f"{value!r} is not X0,Y0,Z0,X1,Y1,Z1 with X0 <= X1 and so on, all finite", param, ctx)
        return x0, y0, z0, x1, y1, z1


BOUNDS = BoundsType()
