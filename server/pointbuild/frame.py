"""The frame of a model: its lattice, chosen before samples are distributed, so that the tree is one of lattice points.

The lattice is that of all multiples of the step, whatever the samples' box: its points do not move when a model grows,
and a sample's point is its own affair. The model's origin is a lattice point at the low corner of the box; rows hold
whole steps from there. Everything that the tree depends on is made of these numbers and of attribute codes, which is
what a model holds as well: so samples that were decoded from a model are as good as those of a scan, and the order
in which samples come is of no account.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from lpc.errors import BuildError
from lpc.lattice import MOST_STEPS, SLACK, position_step

from .cells import Cells

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SHORT = 2**31 - 1


@dataclass(frozen=True, slots=True)
class Frame:
    """A lattice and the box of the samples on it.

    Parameters
    ----------
    step : float
        Edge of a lattice cell, model units.
    start : ndarray, (3,) float64
        Whole steps from 0 to the model's origin.
    low, high : ndarray, (3,) float64
        Box of the samples as they came, model units.
    spacing : float
        r of the model as it was estimated for the step, model units; 0: it was not.
    """

    step: float
    start: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    spacing: float = 0.0

    @classmethod
    def over(cls, low: NDArray[np.float64], high: NDArray[np.float64], step: float) -> Frame:
        """Lay the lattice under the box `low` to `high` (model units)."""
        start = np.rint(low / step)
        start -= start * step > low
        return cls(step, start, low, high)

    @property
    def origin(self) -> NDArray[np.float64]:
        """Lattice point (0, 0, 0), model units; not above the box."""
        return self.start * self.step

    @property
    def short(self) -> bool:
        """Coordinates fit into 32 bits."""
        return bool(self.places(self.high[None]).max() <= _SHORT)

    @property
    def cells(self) -> Cells:
        """How the box is divided, in lattice coordinates; points may be half a step outside."""
        cells = Cells.over(self.low, self.high)
        return replace(cells, low=(self.low - self.origin) / self.step, extent=cells.extent / self.step)

    def places(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Lattice coordinates (n, 3) of positions (n, 3), whole numbers."""
        out = np.empty_like(xyz)
        _snap(xyz, self.step, self.start, out)
        return out


def choose_step(
    spacing: float, low: NDArray[np.float64], high: NDArray[np.float64], position_error: float | None
) -> float:
    """Edge of a lattice cell.

    Parameters
    ----------
    spacing : float
        r of the model, model units; of no account where an error is wanted.
    low, high : ndarray, (3,) float64
        Box of the samples.
    position_error : float or None
        What is wanted; None: half the spacing.

    Raises
    ------
    BuildError
        If no lattice can hold the samples within the wanted error.
    """
    extent = float((high - low).max())
    far = float(np.abs([low, high]).max())
    if position_error is None and extent == 0.0:
        # Samples that all coincide are a lattice point: a power of two divides all numbers of its binade.
        return math.ldexp(1.0, math.frexp(far or 1.0)[1] - 53)
    step = position_step(spacing, extent, position_error)
    finest = far / MOST_STEPS
    if position_error is None:
        if spacing > 0 and step > SLACK * spacing:
            raise BuildError(
                f"the samples are {spacing:g} apart but spread over {extent:g}, more than 48 bits a coordinate can "
                "tell: remove the outliers, or allow a larger --position-error"
            )
        return max(step, finest)
    if step < finest:
        raise BuildError(
            f"a position error of {position_error:g} is less than float64 tells apart at coordinates of {far:g}; "
            f"ask for at least {finest * math.sqrt(3.0) / (2.0 * SLACK):.3g}"
        )
    return step


@njit(cache=True, nogil=True)
def _snap(xyz: Any, step: float, start: Any, out: Any) -> None:
    for i in range(len(xyz)):
        for axis in range(3):
            out[i, axis] = np.rint(xyz[i, axis] / step) - start[axis]
