"""Attributes that have one value everywhere: the header holds it, the clouds do not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import Corrupt

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Constant:
    """The one value that an attribute has everywhere; it costs nothing per sample.

    Parameters
    ----------
    dtype : str
        numpy dtype of a component, little-endian.
    value : int, float or tuple of them
        A tuple for attributes of several components (``normal``, ``color``). Floats are finite.
    """

    dtype: str
    value: int | float | tuple[int | float, ...]

    def __post_init__(self) -> None:
        parts = self.value if isinstance(self.value, tuple) else (self.value,)
        if not 1 <= len(parts) <= 4 or not all(is_number(part) for part in parts):
            raise Corrupt(f"header: constant value {str(self.value)[:40]} is not a number or a few of them")
        try:
            item = np.dtype(self.dtype)
            if item.kind not in "iuf" or item.itemsize > 8:
                raise Corrupt(f"header: constant of dtype {self.dtype!r} is not a plain number")
            with np.errstate(over="raise"):
                np.array(self.value, dtype=item)
        except (TypeError, ValueError, SyntaxError, OverflowError, FloatingPointError) as error:
            if isinstance(error, Corrupt):
                raise
            raise Corrupt(f"header: constant {self.value} does not fit dtype {self.dtype!r}") from error

    def fill(self, samples: int) -> NDArray[Any]:
        """Values of `samples` samples: (samples,) or (samples, components), read-only and without memory of its own."""
        value = np.array(self.value, dtype=self.dtype)
        return np.broadcast_to(value, (samples, *value.shape))

    def to_json(self) -> dict[str, object]:
        """As it stands in the header."""
        return {"dtype": self.dtype, "value": list(self.value) if isinstance(self.value, tuple) else self.value}

    @classmethod
    def from_json(cls, entry: object) -> Constant:
        """Inverse of `to_json`; raises Corrupt."""
        if not isinstance(entry, dict) or not isinstance(entry.get("dtype"), str) or "value" not in entry:
            raise Corrupt(f"header: constant {str(entry)[:80]} has no dtype and value")
        value = entry["value"]
        return cls(entry["dtype"], tuple(value) if isinstance(value, list) else value)


def is_number(value: object) -> bool:
    """Whether a value from JSON is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return isinstance(value, int) or math.isfinite(value)
