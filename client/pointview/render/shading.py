"""The light, the same numbers for every backend.

With normals: a lamp above the eye's left shoulder, ambient, diffuse and a soft highlight (Phong):

    n, l, v      unit vectors in camera space: normal, to the lamp, to the eye
    d            n . l, at least 0; n is turned toward the eye first where the style is two-sided
    h            reflection of the lamp: max(0, (2 (n . l) n - l) . v) ** SHININESS, 0 where n . l <= 0
    rgb          albedo * (AMBIENT + DIFFUSE * d) + SPECULAR * h

Without normals: eye-dome lighting (Boucheny 2009), from depth z alone. A pixel is darkened by how much nearer its eight
neighbours at a distance of m pixels are; empty neighbours count as equally far:

    m            NEIGHBOUR times the side of the pixel's splat, rounded, at least 1
    s            focal * mean over neighbours q of max(0, ln z(p) - ln z(q)) / m
    rgb          albedo * (DARKEST + (1 - DARKEST) * exp(-strength * s))

`focal / m` turns the step of ln z into the tangent of the surface's slope, so the look depends neither on the
resolution of the picture nor on the distance to the model; and neighbours one splat away see the slope, not the rim of
the splat they all lie in.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

LAMP = (-0.35, 0.55, 1.0)
"""Direction to the lamp in camera space: right, up, toward the eye; normalised by `lamp`."""

AMBIENT = 0.22
DIFFUSE = 0.80
SPECULAR = 0.12
SHININESS = 16
UNLIT = 0.80
"""Factor of the albedo for the samples without normal of a model that has normals."""

NEIGHBOUR = 0.4
"""Distance of the neighbours of eye-dome lighting, sides of a splat: about the spacing of its samples."""


DARKEST = 0.25
"""What eye-dome lighting leaves of a pixel at an edge; without it foliage is all outlines."""


def lamp() -> NDArray[np.float32]:
    """Return the unit vector to the lamp in camera space: right, up, depth (which points away from the eye)."""
    length = math.hypot(*LAMP)
    return np.array([LAMP[0] / length, LAMP[1] / length, -LAMP[2] / length], dtype=np.float32)
