"""Compiled loops of blended splatting: samples weighed by their kernels, and their mean as a colour (see `blending`).

Names: (right, up, depth) is a sample relative to the eye in camera space, (nx, ny, nz) the normal of its plane there.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

KERNEL = np.dtype(
    [
        ("focal", np.float32),
        ("width", np.float32),  # standard deviation of a sample's kernel, sides of its splat; see `splats`
        ("pixel", np.float32),  # that of the pixel's filter, pixels
        ("ends", np.float32),  # both end at this many deviations
        ("behind", np.float32),  # how far behind what is seen a sample still counts, radii of its kernel or pixels
        ("slanted", np.float32),  # least cosine to the ray that this allows for
    ]
)
"""What all kernels of a frame share."""

F = np.float32


@numba.njit(nogil=True, cache=True, error_model="numpy")
def gather(
    sums: NDArray[np.float32],
    samples: NDArray[Any],
    depth: NDArray[np.float32],
    top: int,
    bottom: int,
    kernel: Any,
) -> None:  # pragma: no cover - compiled
    """Add samples to the rows `top` to `bottom` of a picture.

    Parameters
    ----------
    sums : (h, w, 4) float32
        Weighted linear red, green, blue; weight.
    samples : (n,) tables.SAMPLE
    depth : (h, w) float32
        Of the surface that is seen; infinite where there is none.
    kernel : KERNEL

    Notes
    -----
    The kernel is a Gaussian in the plane of the sample, times its projection; the pixel's filter is one in the picture
    (Zwicker et al. 2001, EWA). To first order a step d in the plane is J d in the picture, so both together have the
    covariance `V = width^2 J J' + pixel^2`. The perspective is exact for all that: where a pixel's ray meets the plane
    at the depth t, the offset in the plane is J^-1 (t / depth) (p - center), for `x = focal right / depth` gives
    `J (q - sample) = (t / depth) (p - center)` at every point q of the plane, not only near the sample.
    """
    height, width, _ = sums.shape
    middle_x, middle_y, focal = F(width) * F(0.5), F(height) * F(0.5), kernel.focal
    inverse, pixel2, most = F(1.0) / focal, kernel.pixel * kernel.pixel, kernel.ends * kernel.ends
    for i in range(len(samples)):
        sample = samples[i]
        here, nx, ny, nz = sample.depth, sample.nx, sample.ny, sample.nz
        slope_x, slope_y = sample.right / here, sample.up / here
        px, py = middle_x + slope_x * focal, middle_y - slope_y * focal
        spread = kernel.width * sample.side
        spread2 = spread * spread
        lean_x, lean_y = nx - slope_x * nz, ny - slope_y * nz
        # J J' and its determinant; y counts downward in the picture. Far off the axis rounding may turn signs.
        xx = max(F(1.0) + slope_x * slope_x - lean_x * lean_x, F(0.0))
        yy = max(F(1.0) + slope_y * slope_y - lean_y * lean_y, F(0.0))
        xy = lean_x * lean_y - slope_x * slope_y
        along = nx * slope_x + ny * slope_y + nz
        # det V as a sum of what is positive: the textbook's difference loses thin ellipses to rounding.
        det = spread2 * along * spread2 * along + pixel2 * (spread2 * (xx + yy) + pixel2)
        xx, yy, xy = spread2 * xx + pixel2, spread2 * yy + pixel2, spread2 * xy
        radius = kernel.ends * spread * inverse
        stretch = kernel.ends / (F(1.0) - min(radius, F(0.5)))
        half_x, half_y = stretch * math.sqrt(xx), stretch * math.sqrt(yy)
        first = max(math.ceil(py - half_y - F(0.5)), top)
        last = min(math.ceil(py + half_y - F(0.5)), bottom)
        left = max(math.ceil(px - half_x - F(0.5)), 0)
        end = min(math.ceil(px + half_x - F(0.5)), width)
        if first >= last or left >= end:
            continue
        share = spread2 * abs(along) / math.sqrt(det)
        inverse_det = F(1.0) / det
        # Across the surface, not along the ray: seen from the side, it falls away fast.
        farthest = here * kernel.behind * max(radius, inverse) / max(abs(along), kernel.slanted)
        for row in range(first, last):
            dy = F(row) + F(0.5) - py
            part = ny * (middle_y - F(row) - F(0.5)) * inverse + nz
            for column in range(left, end):
                dx = F(column) + F(0.5) - px
                ratio = along / (nx * (F(column) + F(0.5) - middle_x) * inverse + part)
                q = abs(ratio * ratio * (yy * dx * dx - F(2.0) * xy * dx * dy + xx * dy * dy) * inverse_det)
                seen = depth[row, column]
                if q <= most and ratio > F(0.0) and ratio * here <= seen + farthest and seen != np.inf:
                    weight = share * math.exp(F(-0.5) * q)
                    sums[row, column, 0] += weight * sample.red
                    sums[row, column, 1] += weight * sample.green
                    sums[row, column, 2] += weight * sample.blue
                    sums[row, column, 3] += weight


@numba.njit(nogil=True, cache=True, error_model="numpy")
def mean(
    rgb: NDArray[np.uint8], sums: NDArray[np.float32], top: int, bottom: int, least: float
) -> None:  # pragma: no cover - compiled
    """Write the mean colours of the rows `top` to `bottom`; pixels with less weight than `least` stay as they are."""
    for row in range(top, bottom):
        for column in range(sums.shape[1]):
            weight = sums[row, column, 3]
            if not weight > least:
                continue
            for channel in range(3):
                value = sums[row, column, channel] / weight
                if value <= F(0.0031308):
                    value *= F(12.92)
                else:
                    value = F(1.055) * value ** F(1 / 2.4) - F(0.055)
                rgb[row, column, channel] = np.uint8(min(F(255.0) * value + F(0.5), F(255.0)))
