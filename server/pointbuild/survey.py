"""Pass 0: decode the scans once into the spool, and learn what only the whole input tells.

That is the bounding box, the records to reject, which attributes are constant, and how many bits the others need.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from lpc.attributes import Attribute, Kind, Schema
from lpc.constants import Constant
from lpc.errors import ScanError
from lpc.octahedral import encode_normals

from .estimate import Sketch
from .extend import OWNER
from .readers import finite
from .spool import Block, Column, Spool

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from lpc.points import PointBatch

    from .progress import Progress
    from .work import Crew


@dataclass(frozen=True, slots=True, kw_only=True)
class Precision:
    """How exactly attributes are kept; scalars always are as they came.

    Parameters
    ----------
    normal_bits : int
        Of an octahedral axis.
    color_bits : int or None
        Of a colour channel at most; None: as many as it takes to keep all values.
    """

    normal_bits: int = 8
    color_bits: int | None = None


@dataclass(frozen=True, slots=True)
class Survey:
    """What pass 0 found.

    Parameters
    ----------
    low, high : ndarray, (3,) float64
        Bounding box of the samples.
    schema : Schema
        The attributes that vary, in the order of the input's names.
    constants : dict of str to Constant
        Those that do not.
    left_out : dict of str to str
        Attributes that turned out to say nothing.
    rejected : dict of str to int
        Dropped records by reason.
    sketch : Sketch
        Random samples.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    schema: Schema
    constants: dict[str, Constant]
    left_out: dict[str, str]
    rejected: dict[str, int]
    sketch: Sketch = field(default_factory=Sketch)

    def to_json(self) -> dict[str, Any]:
        """Give everything but the sketch as plain values; numbers keep all their bits."""
        return {
            "box": [self.low.tolist(), self.high.tolist()],
            "schema": [attribute.to_json() for attribute in self.schema],
            "constants": {name: constant.to_json() for name, constant in self.constants.items()},
            "left_out": self.left_out,
            "rejected": self.rejected,
        }

    @classmethod
    def from_json(cls, entry: dict[str, Any]) -> Survey:
        """Inverse of `to_json`."""
        low, high = np.array(entry["box"])
        return cls(
            low,
            high,
            tuple(Attribute.from_json(attribute) for attribute in entry["schema"]),
            {name: Constant.from_json(constant) for name, constant in entry["constants"].items()},
            entry["left_out"],
            entry["rejected"],
        )


def columns_of(attributes: dict[str, np.dtype[Any]], precision: Precision, *, owned: bool) -> tuple[Column, ...]:
    """Columns of the spool: positions as they came, normals as codes, everything else as it came, and `OWNER`."""
    columns = [Column("xyz", np.dtype("<f8"), 3)]
    for name, dtype in attributes.items():
        if name == "normal":
            code = np.uint8 if precision.normal_bits <= 8 else np.uint16
            columns.append(Column(name, np.dtype(code), 2))
        else:
            columns.append(Column(name, dtype.newbyteorder("<"), 3 if name == "color" else 1))
    return (*columns, Column(OWNER, np.dtype("<u4"))) if owned else tuple(columns)


def survey(
    batches: Iterable[PointBatch],
    spool: Spool,
    crew: Crew,
    progress: Progress,
    precision: Precision,
    *,
    sketched: bool = True,
) -> Survey:
    """Fill the spool.

    Parameters
    ----------
    batches : iterable of PointBatch
        Samples with the attributes that the spool has columns for.
    spool : Spool
        Empty.
    crew : Crew
        Prepares batches while the next one is read.
    progress : Progress
    precision : Precision
    sketched : bool
        Random samples are wanted.

    Raises
    ------
    ScanError
        If no sample is left.
    """
    box = np.array([[np.inf] * 3, [-np.inf] * 3])
    sketch = Sketch()
    rejected: dict[str, int] = {}
    ranges = {column.name: _Range(column) for column in spool.columns[1:] if column.name != OWNER}
    prepare = partial(_prepare, normal_bits=precision.normal_bits, sketched=sketched)

    def looked_at() -> Iterator[tuple[Block, dict[str, NDArray[Any]], int]]:
        for batch, (values, low, high, drawn, dropped) in crew.map(prepare, batches):
            for reason, count in dropped.items():
                rejected[reason] = rejected.get(reason, 0) + count
            sketch.add(drawn)
            np.minimum(box[0], low, out=box[0])
            np.maximum(box[1], high, out=box[1])
            for name, found in ranges.items():
                found.add(values[name])
            yield spool.reserve(len(values["xyz"])), values, len(batch)

    for (_, _, count), _ in crew.map(lambda entry: spool.write(*entry[:2]), looked_at()):
        progress.advance(count)
    if not spool.samples:
        why = f": all {sum(rejected.values()):,} records are not finite" if rejected else ""
        raise ScanError(f"the input holds no usable sample{why}")
    schema, constants, left_out = [], {}, {}
    for name, found in ranges.items():
        verdict = found.verdict(precision)
        if isinstance(verdict, Attribute):
            schema.append(verdict)
        elif isinstance(verdict, Constant):
            constants[name] = verdict
        else:
            left_out[name] = verdict
    return Survey(box[0], box[1], tuple(schema), constants, left_out, {k: v for k, v in rejected.items() if v}, sketch)


def _prepare(
    batch: PointBatch, normal_bits: int, sketched: bool
) -> tuple[dict[str, NDArray[Any]], NDArray[Any], NDArray[Any], Sketch, dict[str, int]]:
    """Give the samples of a batch as columns, their box, some of them, and what was dropped."""
    dropped: dict[str, int] = {}
    box = np.empty((2, 3))
    good = _box(batch.xyz, box)
    if not good or (batch.normal is not None and not np.isfinite(batch.normal).all()):
        batch, dropped = finite(batch)
        _box(batch.xyz, box)
    values: dict[str, NDArray[Any]] = {"xyz": batch.xyz}
    for name, column in batch.attributes.items():
        values[name] = encode_normals(column, normal_bits) if name == "normal" else column
    return values, box[0], box[1], Sketch.of(batch.xyz) if sketched else Sketch(), dropped


@njit(cache=True, nogil=True)
def _box(xyz: Any, box: Any) -> Any:
    """Fill in the box of (n, 3) positions; whether all are finite."""
    good = True
    for axis in range(3):
        low, high = np.inf, -np.inf
        for i in range(len(xyz)):
            value = xyz[i, axis]
            low, high = min(low, value), max(high, value)
            good &= abs(value) < np.inf  # false for what is not a number
        box[0, axis], box[1, axis] = low, high
    return good


class _Range:
    """Which values an attribute takes, learnt block by block."""

    def __init__(self, column: Column) -> None:
        self.column = column
        self.kind: Kind = column.name if column.name in ("normal", "color") else "scalar"  # type: ignore[assignment]
        self.first: NDArray[Any] | None = None
        self.constant = True
        self.low = self.high = 0
        self.divisor = 0
        self.repeated = self.shifted = True  # 16-bit colours that are all 257 v, all 256 v

    def add(self, values: NDArray[Any]) -> None:
        if not len(values):
            return
        if self.kind == "normal":
            self.constant = self.constant and not values.any()
            return
        bits = values.view(f"<u{values.dtype.itemsize}")
        if self.first is None:
            self.first = values[0].copy()
            self.low = self.high = int(np.min(values[0])) if self.column.dtype.kind in "iu" else 0
        self.constant = self.constant and bool((bits == self.first.view(bits.dtype)).all())
        if self.column.dtype.kind in "iu":
            self._add_integers(values)

    def _add_integers(self, values: NDArray[Any]) -> None:
        low, high = int(values.min()), int(values.max())
        if self.kind == "color":
            if self.column.dtype.itemsize == 2 and (self.repeated or self.shifted):
                self.repeated = self.repeated and bool((values >> 8 == values & 255).all())
                self.shifted = self.shifted and not (values & 255).any()
        elif self.divisor != 1:
            apart = values.astype(np.uint64) - np.uint64(low % (1 << 64))
            self.divisor = math.gcd(self.divisor, abs(low - self.low), int(np.gcd.reduce(apart[:64])))
            if self.divisor != 1 and (self.divisor == 0 or (apart % np.uint64(self.divisor)).any()):
                self.divisor = math.gcd(self.divisor, int(np.gcd.reduce(apart)))
        self.low, self.high = min(self.low, low), max(self.high, high)

    def verdict(self, precision: Precision) -> Attribute | Constant | str:
        """How to store it, or its one value, or why not at all."""
        name, dtype = self.column.name, self.column.dtype.newbyteorder("<")
        if self.kind == "normal":
            attribute = Attribute(name=name, kind="normal", dtype="<f4", bits=precision.normal_bits)
            return "every normal is zero" if self.constant else attribute
        assert self.first is not None
        if self.constant and np.isfinite(self.first).all():
            value = self.first.tolist()
            return Constant(dtype.str, tuple(value) if isinstance(value, list) else value)
        if dtype.kind == "f":
            return Attribute(name=name, kind="scalar", dtype=dtype.str, bits=8 * dtype.itemsize)
        scale, offset = max(self.divisor, 1), self.low
        if self.kind == "color":
            offset = 0
            scale = 1 if dtype.itemsize == 1 else 257 if self.repeated else 256 if self.shifted else 1
        bits, depth = max(((self.high - offset) // scale).bit_length(), 1), 0
        if self.kind == "color" and precision.color_bits is not None and precision.color_bits < bits:
            bits, depth = precision.color_bits, bits
        return Attribute(name=name, kind=self.kind, dtype=dtype.str, bits=bits, offset=offset, scale=scale, depth=depth)
