"""What a sample carries besides its position, and how it becomes integers.

The codec only knows unsigned integer *codes*; this module says which codes stand for which values
(docs/format.md, Attributes). An attribute is described once per model, in the header.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .errors import Corrupt

Kind = Literal["normal", "color", "scalar"]

MAX_ATTRIBUTES = 64
MAX_NAME = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class Attribute:
    """One attribute of a model.

    Parameters
    ----------
    name : str
        ``normal``, ``color``, ``intensity``, ``classification``, ... as `export` writes it.
    kind : {"normal", "color", "scalar"}
        Normals are octahedral codes (n, 2), colours (n, 3), scalars (n,).
    dtype : str
        numpy dtype of the values that `export` gives back, little-endian (``"<u2"``); ``"<f4"`` for normals.
    bits : int
        Bits of one code, 1 to 64. Normals: bits per octahedral axis, 2 to 16 (8 is the default).
    offset : int
        Scalars of integer dtype: value = code * scale + offset.
    scale : int
        Colours and integer scalars: value = code * scale (+ offset). 16-bit colours that only ever hold
        v * 256 or v * 257 are kept as 8-bit codes with that scale.
    depth : int
        Colours that are stored with fewer bits than they came with: how many those were, above `bits`. Codes are evenly
        spread over the ``2**depth`` levels, both ends included. 0: values are stored as they came.
    """

    name: str
    kind: Kind
    dtype: str
    bits: int
    offset: int = 0
    scale: int = 1
    depth: int = 0

    def __post_init__(self) -> None:
        if not (0 < len(self.name) <= MAX_NAME):
            raise Corrupt(f"attribute name of {len(self.name)} characters (1 to {MAX_NAME} are allowed)")
        if self.kind not in ("normal", "color", "scalar"):
            raise Corrupt(f"attribute {self.name}: unknown kind {self.kind!r}")
        least, most = {"normal": (2, 16), "color": (1, 16), "scalar": (1, 64)}[self.kind]
        if not least <= self.bits <= most:
            raise Corrupt(f"attribute {self.name}: {self.bits} bits ({least} to {most} are allowed)")
        if self.scale < 1:
            raise Corrupt(f"attribute {self.name}: scale {self.scale} is not positive")
        if self.depth and not (self.kind == "color" and self.bits < self.depth <= most):
            raise Corrupt(f"attribute {self.name}: a depth of {self.depth} bits, and {self.bits} are stored")
        try:
            item = np.dtype(self.dtype)
        except (TypeError, ValueError, SyntaxError) as error:  # numpy evaluates what looks like a list of fields
            raise Corrupt(f"attribute {self.name}: dtype {self.dtype!r} is none of numpy's") from error
        if item.kind not in "iuf" or item.itemsize > 8:
            raise Corrupt(f"attribute {self.name}: dtype {self.dtype!r} is not a plain number")

    @property
    def components(self) -> int:
        """Codes per sample: 2 for normals, 3 for colours, 1 for scalars."""
        return {"normal": 2, "color": 3, "scalar": 1}[self.kind]

    @property
    def code_dtype(self) -> np.dtype[Any]:
        """Smallest unsigned dtype that holds a code."""
        for dtype in (np.uint8, np.uint16, np.uint32):
            if self.bits <= np.iinfo(dtype).bits:
                return np.dtype(dtype)
        return np.dtype(np.uint64)

    @property
    def max_error(self) -> int:
        """No decoded value of a colour or scalar is further than this from what was encoded; 0: they are equal."""
        if not self.depth:
            return 0
        spacing = -(-((1 << self.depth) - 1) // ((1 << self.bits) - 1))
        return spacing // 2 * self.scale

    def encode(self, values: NDArray[Any]) -> NDArray[Any]:
        """Codes of colour or scalar values; exact but for `max_error`, see `decode`.

        Parameters
        ----------
        values : ndarray
            (n, 3) for colours, (n,) for scalars, of `dtype`.

        Returns
        -------
        ndarray of `code_dtype`
            Same shape. Floats keep their bits (sign-magnitude turned into an ordered integer).
        """
        item = np.dtype(self.dtype)
        if item.kind == "f":
            unsigned = np.dtype(f"<u{item.itemsize}")
            bits = np.ascontiguousarray(values, dtype=item).view(unsigned)
            top = unsigned.type(1 << (8 * item.itemsize - 1))
            return np.where(bits & top, ~bits, bits | top).astype(self.code_dtype)
        wide = np.ascontiguousarray(values, dtype=item).astype(np.uint64)  # two's complement wraps, and wraps back
        wide -= np.uint64(self.offset % (1 << 64))
        wide //= np.uint64(self.scale)
        if self.depth:
            levels, top = np.uint64((1 << self.bits) - 1), np.uint64((1 << self.depth) - 1)
            wide = (wide * levels + top // np.uint64(2)) // top
        return wide.astype(self.code_dtype)

    def decode(self, codes: NDArray[Any]) -> NDArray[Any]:
        """Values of colour or scalar codes: the inverse of `encode`, within `max_error`."""
        item = np.dtype(self.dtype)
        if item.kind == "f":
            unsigned = np.dtype(f"<u{item.itemsize}")
            bits = codes.astype(unsigned)
            top = unsigned.type(1 << (8 * item.itemsize - 1))
            return np.where(bits & top, bits ^ top, ~bits).view(item)
        wide = self.full(codes).astype(np.uint64) * np.uint64(self.scale)
        wide += np.uint64(self.offset % (1 << 64))
        return wide.astype(item)

    def full(self, codes: NDArray[Any]) -> NDArray[Any]:
        """Codes of colours as they would be if all bits had been stored."""
        if not self.depth:
            return codes
        levels, top = np.uint32((1 << self.bits) - 1), np.uint32((1 << self.depth) - 1)
        return ((codes.astype(np.uint32) * top + levels // np.uint32(2)) // levels).astype(
            np.uint8 if self.depth <= 8 else np.uint16
        )

    def to_json(self) -> dict[str, object]:
        """As it stands in the header."""
        entry: dict[str, object] = {
            "name": self.name,
            "kind": self.kind,
            "dtype": self.dtype,
            "bits": self.bits,
            "offset": self.offset,
            "scale": self.scale,
        }
        return entry | ({"depth": self.depth} if self.depth else {})

    @classmethod
    def from_json(cls, entry: dict[str, Any]) -> Attribute:
        """Inverse of `to_json`.

        Raises
        ------
        Corrupt
            If a field is missing, of the wrong type or out of range.
        """
        try:
            return cls(
                name=str(entry["name"]),
                kind=entry["kind"],
                dtype=str(entry["dtype"]),
                bits=int(entry["bits"]),
                offset=int(entry["offset"]),
                scale=int(entry["scale"]),
                depth=int(entry.get("depth", 0)),
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            if isinstance(error, Corrupt):
                raise
            raise Corrupt(f"header: attribute entry {str(entry)[:80]} cannot be read") from error


Schema = tuple[Attribute, ...]
"""The attributes of a model in the order in which the codec writes them."""
