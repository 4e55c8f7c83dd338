"""How large a splat must be so that a random sampling shows a closed surface.

Samples with a spacing of r (one per area r^2, placed at random) leave the share `exp(-area / r^2)` of the surface
uncovered by splats of that area. LPC 4 draws squares of side r: 37% holes, hidden there by a projection that is
larger than need be. Splats here have an area of `CLOSING^2 r^2`: 0.1% on a surface that faces the eye, less where it
is tilted: its samples move together, the splats stay as large. Measured on closed surfaces at any cut, 0.03% or less
of the pixels show the background or the far side.
"""

from __future__ import annotations

import math

CLOSING = 2.7
"""Side of a square splat over the spacing of its samples; round splats have the same area."""

ROUND = 2.0 / math.sqrt(math.pi)
"""Diameter of a disc over the side of the square of the same area."""

ROUND_FROM = 2.0
"""Splats larger than this many pixels are round; below, a square and a disc cover the same few pixels."""

LARGEST = 220.0
"""No splat has a larger side, pixels: its disc stays within 255, the least that OpenGL implementations allow."""
