"""Positions as integers on one lattice for the whole model.

The step follows from the spacing: half of it bounds the Euclidean error, as in LPC section 6. One lattice for
all clouds makes seams exact and quantising twice harmless.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from .errors import BuildError

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_BITS = 48
"""A coordinate has 16 bits and at most 32 low bits."""

SLACK = 0.999
"""Of the bound that the step uses: the rest is for the rounding of float64, however far from the origin a model lies.

The bound is of what a reader decodes, in float64. A renderer that places splats in float32 adds its own rounding,
0.004 of a step, to a splat that is 1.7 steps wide or more.
"""

EPSILON = 2.0**-52

MOST_STEPS = 2.0**50
"""From 0 to any coordinate: further, a lattice point is not told from its neighbours in float64."""


def position_step(spacing: float, extent: float, position_error: float | None = None) -> float:
    """Edge of a lattice cell.

    Parameters
    ----------
    spacing : float
        r, the square root of the area per sample, model units. May be 0 (all samples coincide).
    extent : float
        Longest side of the bounding box, model units.
    position_error : float, optional
        The Euclidean error that is allowed, model units; r / 2 if not given (LPC section 6).

    Returns
    -------
    float
        Above 0; ``extent / step`` stays below 2**48.

    Raises
    ------
    BuildError
        If the requested error is not a positive number or needs more than 48 bits.
    """
    finest = extent / 2.0 ** (MAX_BITS - 1)
    if position_error is not None:
        if not (math.isfinite(position_error) and position_error > 0):
            raise BuildError(f"a position error of {position_error:g} is not a positive length")
        step = SLACK * 2.0 * position_error / math.sqrt(3.0)
        if step < finest or step == 0.0:
            least = finest * math.sqrt(3.0) / (2.0 * SLACK)
            raise BuildError(
                f"a position error of {position_error:g} needs more than {MAX_BITS} bits a coordinate over "
                f"{extent:g}; ask for at least {least:.3g}"
            )
        return step
    step = max(SLACK * spacing / math.sqrt(3.0), finest)
    return step if step > 0.0 else 1.0


def quantise(xyz: NDArray[np.float64], origin: NDArray[np.float64], step: float) -> NDArray[np.int64]:
    """Nearest lattice points of (n, 3) positions; float64 throughout.

    An origin that is a multiple of the step, as the builder's are, does not enter the rounding: a position half way
    between two points goes to the same one whatever the origin.
    """
    start = np.rint(origin / step)
    whole = (start * step == origin) & (np.abs(start) < 2 * EPSILON**-1)
    scaled = xyz - np.where(whole, 0.0, origin)
    scaled /= step
    np.rint(scaled, out=scaled)
    scaled -= np.where(whole, start, 0.0)
    return scaled.astype(np.int64)


def dequantise(lattice: NDArray[np.int64], origin: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Positions of (n, 3) lattice points."""
    xyz = lattice * np.float64(step)
    xyz += origin
    return xyz


def position_error_bound(step: float, origin: NDArray[np.float64], extent: float) -> float:
    """No position moves further than this in `quantise` and `dequantise`.

    Half a cell's diagonal and the rounding of float64: per axis, 2**-53 of the coordinate in each of division, origin
    and sum and 2**-53 of the extent in the product, all taken twice.
    """
    far = float(np.abs(origin).max()) + extent
    return math.sqrt(3.0) * (step / 2.0 + EPSILON * (extent + 3.0 * far))


def paper_bits(extent: float, spacing: float) -> int:
    """Bits per coordinate by the paper's rule: the smallest b with ``extent / 2**b < r / 2`` (LPC table 1)."""
    if not (extent >= 0.0 and spacing > 0.0):
        raise ValueError(f"extent {extent:g} and spacing {spacing:g} give no number of bits")
    bits = 0
    while extent / 2.0**bits >= spacing / 2.0:
        bits += 1
    return bits
