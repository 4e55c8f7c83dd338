"""One decoded cloud, still quantised: what the access layer hands out and the renderer draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Cloud:
    """The samples of one node as integers, in Morton order.

    A sample stands at ``model_origin + step * (origin + ((position << shift) | low))``; `lattice` gives the
    integer part. `position` alone is what the renderer uploads: its error is below extent / 65536 of the cloud.

    Parameters
    ----------
    origin : ndarray, (3,) int64
        Lattice coordinates of the corner that positions count from; none is below it on any axis.
    position : ndarray, (k, 3) uint16
        Lattice coordinates relative to `origin`, without their `shift` low bits.
    shift : int
        Low bits kept apart; 0 unless the cloud spans more than 65,535 steps.
    low : ndarray, (k, 3) uint32, or None
        Those bits where `shift` > 0.
    codes : mapping of str to ndarray
        Codes by attribute name: normals (k, 2), colours (k, 3), scalars (k,).
    """

    origin: NDArray[np.int64]
    position: NDArray[np.uint16]
    shift: int = 0
    low: NDArray[np.uint32] | None = None
    codes: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.position)

    def lattice(self) -> NDArray[np.int64]:
        """Lattice coordinates relative to the model's origin, (k, 3) int64."""
        local = self.position.astype(np.int64)
        if self.low is not None:
            local = (local << self.shift) | self.low
        return local + self.origin

    @property
    def nbytes(self) -> int:
        """Bytes of memory that the arrays hold."""
        total = self.origin.nbytes + self.position.nbytes + (0 if self.low is None else self.low.nbytes)
        return total + sum(codes.nbytes for codes in self.codes.values())
