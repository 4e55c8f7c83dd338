"""Blended splatting sample by sample over whole pictures in float64: slow and obvious.

The kernel of a sample is written as the definition has it: the Gaussian in the plane as a map of plane coordinates, its
projection by numerical differentiation, the pixel's filter added as a covariance, the inverse by `numpy.linalg`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pointview import splats

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


def to_linear(level: Any) -> Array:
    """Light of levels of sRGB, 0 to 255."""
    share = np.asarray(level, dtype=float) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def to_levels(light: Array) -> Array:
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def axes_of(normal: Array) -> Array:
    """Two unit vectors along a plane, (2, 3)."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(normal, first)])


def project(point: Array, focal: float, middle: Array) -> Array:
    """Pixel of a position in camera space: right, up, depth."""
    return middle + focal * np.array([point[0], -point[1]]) / point[2]


def weights(center: Array, normal: Array, side: float, depth: Array, focal: float) -> Array:
    """What one sample weighs at each pixel of a picture of such depth, (h, w)."""
    height, width = depth.shape
    middle = np.array([width / 2, height / 2])
    deviation = splats.KERNEL * side * center[2] / focal  # model units
    along = axes_of(normal)
    step = 1e-5 * center[2]
    jacobian = np.stack(
        [
            (project(center + step * axis, focal, middle) - project(center - step * axis, focal, middle)) / (2 * step)
            for axis in along
        ],
        axis=1,
    )
    covariance = deviation**2 * jacobian @ jacobian.T + splats.PIXEL**2 * np.eye(2)
    row, column = np.mgrid[0:height, 0:width] + 0.5
    ray = np.stack([(column - middle[0]) / focal, (middle[1] - row) / focal, np.ones(depth.shape)], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        here = (normal @ center) / (ray @ normal)
        inside = (here[..., None] * ray - center) @ along.T  # plane coordinates of where the ray meets the plane
        offset = inside @ jacobian.T  # the same in pixels around the sample
        q = np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(covariance), offset)
        lean = max(abs(normal @ center) / center[2], splats.SLANTED)
        slack = splats.BEHIND * max(splats.KERNEL_ENDS * deviation, center[2] / focal) / lean
        counts = (q <= splats.KERNEL_ENDS**2) & (here > 0) & (here <= depth + slack) & np.isfinite(depth)
        share = deviation**2 * abs(np.linalg.det(jacobian)) / np.sqrt(np.linalg.det(covariance))
        return np.where(counts, share * np.exp(-q / 2), 0.0)


def blend(
    rgb: NDArray[np.uint8], depth: Array, samples: list[tuple[Array, Array, float, Array]], focal: float
) -> Array:
    """Picture of samples (center, plane's normal, side of the splat, lit levels) over a picture of discs."""
    total, weight = np.zeros(rgb.shape), np.zeros(depth.shape)
    for center, normal, side, levels in samples:
        own = weights(center, normal, side, depth, focal)
        total += own[..., None] * to_linear(levels)
        weight += own
    reached = weight > 0
    picture = rgb.astype(float)
    picture[reached] = to_levels(total[reached] / weight[reached][:, None])
    return picture
