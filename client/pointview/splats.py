"""The splats: large enough that a random sampling shows a closed surface, and no larger.

Samples with a spacing of r (one per area r^2, placed at random) leave the share `exp(-area / r^2)` of the surface
uncovered by splats of that area. LPC 4 draws squares of side r: 37% holes, hidden there by a projection that is
larger than need be. Splats here have an area of `CLOSING^2 r^2`: 0.3%, in gaps hardly wider than a splat, which are
closed in the picture (`HOLE`). What remains is 0.01% of a closed surface, less than 0.05% at any moment of a stream,
and silhouettes grow by a seventh of the spacing, hardly anywhere by half of it (`benchmarks/moments.py`).

A splat is one pixel where it is no larger. A larger one is a disc: in the tangent plane of its sample where there is a
normal or its neighbours make one (`render.planes`), which keeps silhouettes thin and depths right; else facing the
eye. Discs overlap by far, and a *bulge* decides between them: the depth grows with the square of the
distance from the centre, so the nearest sample is seen, each in a cell of its own.
"""

from __future__ import annotations

import math

CLOSING = 2.4
"""Side of a square splat over the spacing of its samples; round splats have the same area."""

ROUND = 2.0 / math.sqrt(math.pi)
"""Diameter of a disc over the side of the square of the same area."""

ROUND_FROM = 1.0
"""Splats with a side above this many pixels are discs; below, a splat is the pixel that its sample falls into."""

BULGE = 2.0
"""How far behind its centre the rim of a disc is, over its radius. Decides which is seen; the depth of a picture
stays that of the disc. More than the depth that a surface gains over a radius, so that where surfaces lie close behind
one another the one whose samples are there is seen; and less than the thickness of what has a far side."""

STEEPEST = 0.15
"""Least cosine between a disc's normal and the direction to the eye: one seen from the side would cover nothing."""

LARGEST = 160.0
"""No splat has a larger side, pixels: its disc stays within 255, the least that OpenGL implementations allow, even
where the perspective stretches it at the rim of the picture."""

HOLE = 1.0
"""Widest half of a gap that is taken for a hole of the sampling, sides of the splats around it. Random samples leave
one gap or other at any density, and no scan is evenly dense; what fits into such a gap is no detail of the model."""

FACES = 5
"""Directions, of eight, in which the wall around a hole must go on into it: its plane reaches the hole within `HOLE`
too. The surface falls away behind a silhouette, so what lies between silhouettes, near as they are, stays open."""

FACE = 0.25
"""Over what length the slope of such a wall is measured, sides of its splat: one disc has one slope."""

REACH = 1.0
"""A sample this near to a coarser cell, in spacings of that cell, helps to close it (`places`)."""

LARGEST_HOLE = 64
"""And in pixels."""

WALLS = 7
"""Directions, of eight, in which a nearer surface must stand around a hole: fewer would round off corners."""

KERNEL = 0.22
"""Standard deviation of a blended sample's Gaussian in its plane, sides of its splat: half the spacing."""

PIXEL = 0.3
"""That of a pixel's filter in blended pictures, pixels: as wide as the box of the pixel, whose variance is 1/12."""

KERNEL_ENDS = 2.6
"""Where both end, standard deviations: at the rim of the disc, so that samples reach every pixel of it, and beyond the
corners of a pixel, so that every sample reaches one."""

BEHIND = 1.0
"""How far behind the surface that is seen a blended sample still belongs to it, measured across the surface: radii of
its kernel, or pixels where these are larger."""

SLANTED = 0.3
"""Least cosine between plane and ray that this allows for: a plane seen more from the side may be a wrong one."""
