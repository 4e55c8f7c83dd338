"""Samples as plain arrays: what readers give, what the builder takes, what `export` writes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class PointBatch:
    """Samples with attributes.

    Parameters
    ----------
    xyz : ndarray, (n, 3) float64
        Positions in model units.
    attributes : mapping of str to ndarray
        Values by name, first axis n: ``normal`` (n, 3) float32 (zero vector: none), ``color`` (n, 3) uint8 or
        uint16, any other name (n,) of an integer or float dtype (``intensity``, ``classification``, ...).
    """

    xyz: NDArray[np.float64]
    attributes: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3 or self.xyz.dtype != np.float64:
            raise ValueError(f"xyz must be (n, 3) float64, not {self.xyz.shape} {self.xyz.dtype}")
        for name, values in self.attributes.items():
            if len(values) != len(self.xyz):
                raise ValueError(f"{name} has {len(values)} values for {len(self.xyz)} samples")

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def normal(self) -> NDArray[np.float32] | None:
        """(n, 3) float32, or None where the samples have none."""
        return self.attributes.get("normal")

    @property
    def color(self) -> NDArray[Any] | None:
        """(n, 3) uint8 or uint16, or None where the samples have none."""
        return self.attributes.get("color")

    def take(self, which: NDArray[Any] | slice) -> PointBatch:
        """Return the samples at an index array, a mask or a slice."""
        return PointBatch(self.xyz[which], {name: values[which] for name, values in self.attributes.items()})

    @staticmethod
    def concatenate(batches: Iterable[PointBatch]) -> PointBatch:
        """Join batches of equal attributes; an empty batch without attributes when there are none."""
        parts = list(batches)
        if not parts:
            return PointBatch(np.empty((0, 3)))
        names = parts[0].attributes.keys()
        return PointBatch(
            np.concatenate([part.xyz for part in parts]),
            {name: np.concatenate([part.attributes[name] for part in parts]) for name in names},
        )
