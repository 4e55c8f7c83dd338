"""A sample as one row of bytes: what the passes after the survey move around.

A row holds the lattice point and the attribute codes. Rows are whole 8-byte words, which is how kernels copy and hash
them: priorities are made of rows wherever they are wanted, for less than it takes to write them down and read them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numba import njit

from .extend import OWNER
from .priority import priorities

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from contextlib import AbstractContextManager

    from numpy.typing import NDArray

    from lpc.attributes import Attribute, Schema


class Rows(Protocol):
    """All rows of a build, bucket by bucket: what the stages after the scatter need of them.

    Parameters
    ----------
    dtype : dtype
        Of a row.
    first : ndarray, (buckets + 1,) int64
        Bucket b is the rows ``first[b]`` to ``first[b + 1]``.
    """

    dtype: np.dtype[Any]
    first: NDArray[np.int64]

    def read(self, row: int, out: NDArray[Any]) -> None:
        """Fill `out` with rows from number `row` on."""

    def chunks(self, row: int, count: int, most: int) -> Iterator[NDArray[Any]]:
        """Yield `count` rows from number `row` on, at most `most` at a time."""

    def replace(self, row: int, rows: NDArray[Any]) -> None:
        """Put all rows of a bucket, which begins at number `row`, in another order."""

    def rewriting(self, row: int) -> AbstractContextManager[int]:
        """Do so with a file that they are to be written to."""

    def settle(self, bucket: int) -> None:
        """Let go of the rows of buckets up to this one as they were."""

    def replaced(self) -> Rows:
        """Give the rows as they were replaced."""

    def remove(self) -> None:
        """Remove the files."""


def row_dtype(schema: Schema, *, short: bool = True, owned: bool = False) -> np.dtype[Any]:
    """Fields ``xyz`` and one per attribute, widest first and without gaps, padded to whole words.

    `short`: lattice coordinates have 32 bits. `owned`: there is also `OWNER`, in a word of its own.
    """
    fields: list[Any] = [("xyz", "<i4" if short else "<i8", (3,))]
    for attribute in sorted(schema, key=lambda entry: -entry.code_dtype.itemsize):
        shape = () if attribute.components == 1 else (attribute.components,)
        fields.append((attribute.name, f"<u{attribute.code_dtype.itemsize}", shape))
    fields = _whole(fields)
    return np.dtype(_whole([*fields, (OWNER, "<u4")]) if owned else fields)


def _whole(fields: list[Any]) -> list[Any]:
    """Make what is left of the last word a field: numpy copies fields alone, and all of a row is hashed."""
    size = np.dtype(fields).itemsize
    rest = whole_words(size) - size
    return [*fields, (f"\0{size}", f"V{rest}")] if rest else fields


def in_chunks(rows: Rows, row: int, count: int, most: int) -> Iterator[NDArray[Any]]:
    """`Rows.chunks` by means of `Rows.read`."""
    for at in range(row, row + count, most):
        out = np.empty(min(most, row + count - at), rows.dtype)
        rows.read(at, out)
        yield out


def row_start(short: bool) -> int:
    """Bytes of a row before its attributes."""
    return 12 if short else 24


def whole_words(size: int) -> int:
    """Bytes of the 8-byte words that hold so many bytes."""
    return -(-size // 8) * 8


def positions(rows: NDArray[Any]) -> NDArray[np.float64]:
    """Lattice coordinates (n, 3) of rows."""
    out = np.empty((len(rows), 3))
    copy_places(rows["xyz"], out)
    return out


def fill_rows(
    dtype: np.dtype[Any], places: NDArray[np.float64], values: Mapping[str, NDArray[Any]], schema: Schema
) -> NDArray[Any]:
    """Rows of spooled samples.

    Parameters
    ----------
    dtype : dtype
        Of `row_dtype`.
    places : ndarray, (n, 3) float64
        Lattice coordinates.
    values : mapping of str to ndarray
        Spool columns; normals are codes already.
    schema : Schema
    """
    rows = np.zeros(len(places), dtype)
    copy_places(places, rows["xyz"])
    for attribute in schema:
        column = values[attribute.name]
        rows[attribute.name] = column if attribute.kind == "normal" else encode_values(attribute, column)
    if OWNER in values:
        rows[OWNER] = values[OWNER]
    return rows


def copy_places(places: NDArray[Any], out: NDArray[Any]) -> None:
    """Copy whole numbers (n, 3) into an array of another type: numpy takes three times as long over columns of rows."""
    _copy(places, out)


@njit(cache=True, nogil=True)
def _copy(places: Any, out: Any) -> None:
    for i in range(len(places)):
        for axis in range(3):
            out[i, axis] = places[i, axis]


def priorities_of(rows: NDArray[Any], seed: int) -> NDArray[np.uint64]:
    """`priorities` of rows: of all that is in them but `OWNER`."""
    words = as_words(rows)
    return priorities(words[:, :-1] if OWNER in (rows.dtype.names or ()) else words, seed)


def encode_values(attribute: Attribute, values: NDArray[Any]) -> NDArray[Any]:
    """`Attribute.encode`, without its detour over 64 bits where a shift does."""
    if attribute.depth:
        return _code_table(attribute)[values]
    if attribute.offset == 0 and values.dtype.kind == "u":
        if attribute.scale == 1:
            return values.astype(attribute.code_dtype)
        if attribute.scale in (256, 257) and values.dtype.itemsize == 2:
            return (values >> 8).astype(np.uint8)  # 257 v is v in both bytes
    return attribute.encode(values)


@lru_cache(maxsize=1)
def _code_table(attribute: Attribute) -> NDArray[Any]:
    """Codes of all values of colours."""
    dtype = np.dtype(attribute.dtype)
    return attribute.encode(np.arange(np.iinfo(dtype).max + 1, dtype=dtype))


def as_words(rows: NDArray[Any]) -> NDArray[np.uint64]:
    """Rows as (n, words) uint64."""
    return rows.view(np.uint64).reshape(len(rows), rows.dtype.itemsize // 8)
