"""Attribute codes as the codec stores them: one row of small unsigned integers per *channel*.

A normal has two channels, a colour three (YCoCg-R, lossless), a scalar one, or two above 32 bits
(docs/format.md, Cloud). Both codecs and all their checks work on rows and know nothing of attributes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from .attributes import Attribute, Schema
    from .cloud import Cloud

WIDE = 32
"""Bits of the widest channel; scalars above it are cut into a high and a low part."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Channels:
    """The channels of a schema, in the order in which the payload holds them.

    Parameters
    ----------
    bits : ndarray, (c,) int64
        A channel has ``2**bits`` levels, 1 <= bits <= 32.
    start : ndarray, (c,) uint32
        What predicts a sample that has no predecessor.
    normals : ndarray, (m, 2) int64
        For each normal its first row and M = 2**(bits - 1) - 1, the code of the centre.
    guessed : ndarray, (g, 3) int64
        Normals and colours, which a context can tell: first row, 1 for a normal or 0, bits of the attribute.
    groups : tuple of (int, int)
        Half-open runs of channels that share statistics, so that one zstd block serves a run best.
    """

    bits: NDArray[np.int64]
    start: NDArray[np.uint32]
    normals: NDArray[np.int64]
    guessed: NDArray[np.int64]
    groups: tuple[tuple[int, int], ...]

    def __len__(self) -> int:
        return len(self.bits)

    @property
    def guessed_rows(self) -> list[int]:
        """Rows of normals and colours."""
        return [first + i for first, normal, _ in self.guessed.tolist() for i in range(2 if normal else 3)]


def _shape(attribute: Attribute) -> tuple[list[int], int, list[int]]:
    """Bits of the channels of one attribute, their start value, and how many channels each block takes."""
    bits = attribute.bits
    if attribute.kind == "normal":
        return [bits, bits], (1 << (bits - 1)) - 1, [2]
    if attribute.kind == "color":
        return [bits, bits + 1, bits + 1], 0, [1, 1, 1]
    if bits > WIDE:
        return [bits - WIDE, WIDE], 0, [1, 1]
    return [bits], 0, [1]


@lru_cache(maxsize=64)
def channels_of(schema: Schema) -> Channels:
    """Channels of a schema; the same object for equal schemas."""
    bits: list[int] = []
    start: list[int] = []
    normals: list[tuple[int, int]] = []
    guessed: list[tuple[int, int, int]] = []
    groups: list[tuple[int, int]] = []
    for attribute in schema:
        widths, first, runs = _shape(attribute)
        for run in runs:
            end = groups[-1][1] if groups else 0
            groups.append((end, end + run))
        if attribute.kind == "normal":
            normals.append((len(bits), first))
        if attribute.kind != "scalar":
            guessed.append((len(bits), attribute.kind == "normal", attribute.bits))
        bits += widths
        start += [first] * len(widths)
    return Channels(
        bits=np.array(bits, np.int64),
        start=np.array(start, np.uint32),
        normals=np.array(normals, np.int64).reshape(-1, 2),
        guessed=np.array(guessed, np.int64).reshape(-1, 3),
        groups=tuple(groups),
    )


def to_channels(codes: Mapping[str, NDArray[Any]], schema: Schema, samples: int) -> NDArray[np.uint32]:
    """Spread attribute codes over channels.

    Parameters
    ----------
    codes : mapping of str to ndarray
        Codes by attribute name: normals (n, 2), colours (n, 3), scalars (n,), all below ``2**bits``.
    schema : Schema
    samples : int
        n.

    Returns
    -------
    ndarray, (c, n) uint32

    Raises
    ------
    ValueError
        If an attribute is missing or not of that shape, or a code is too large.
    """
    rows = np.empty((len(channels_of(schema)), samples), np.uint32)
    at = 0
    for attribute in schema:
        values = codes.get(attribute.name)
        shape = (samples,) if attribute.kind == "scalar" else (samples, attribute.components)
        if values is None or values.shape != shape:
            found = "is missing" if values is None else f"has shape {values.shape}"
            raise ValueError(f"codes of {attribute.name} must have shape {shape}: it {found}")
        top = (1 << attribute.bits) - (2 if attribute.kind == "normal" else 1)
        if samples and not 0 <= int(values.min()) <= int(values.max()) <= top:
            raise ValueError(f"a code of {attribute.name} is not between 0 and {top}")
        if attribute.kind == "normal":
            rows[at], rows[at + 1] = values[:, 0], values[:, 1]
            at += 2
        elif attribute.kind == "color":
            rows[at : at + 3] = _ycocg(values, attribute.bits)
            at += 3
        elif attribute.bits > WIDE:
            wide = values.astype(np.uint64)
            rows[at], rows[at + 1] = wide >> np.uint64(WIDE), wide & np.uint64(0xFFFFFFFF)
            at += 2
        else:
            rows[at] = values
            at += 1
    return rows


def rows_of(members: Sequence[tuple[Cloud, NDArray[np.intp]]], schema: Schema) -> NDArray[np.uint32]:
    """Rows of the normals and colours of some samples of some clouds, (g, n)."""
    rows: list[NDArray[Any]] = []
    for attribute in schema:
        if attribute.kind != "scalar":
            parts: list[list[NDArray[Any]]] = [[np.empty(0, attribute.code_dtype)] for _ in range(attribute.components)]
            for cloud, index in members:
                for column, part in zip(cloud.codes[attribute.name].T, parts, strict=True):
                    part.append(column.take(index))
            values = [np.concatenate(part) for part in parts]
            rows += values if attribute.kind == "normal" else [*_ycocg(np.stack(values, axis=1), attribute.bits)]
    samples = sum(len(index) for _, index in members)
    return np.array(rows).astype(np.uint32).reshape(len(rows), samples)  # there may be no row, or no sample


def from_channels(rows: NDArray[np.uint32], schema: Schema) -> dict[str, NDArray[Any]]:
    """Inverse of `to_channels`, in the code dtype of each attribute."""
    codes: dict[str, NDArray[Any]] = {}
    at = 0
    for attribute in schema:
        if attribute.kind == "normal":
            values = np.empty((rows.shape[1], 2), attribute.code_dtype)
            values[:, 0], values[:, 1] = rows[at], rows[at + 1]
            at += 2
        elif attribute.kind == "color":
            values = _rgb(rows[at : at + 3], attribute)
            at += 3
        elif attribute.bits > WIDE:
            values = (rows[at].astype(np.uint64) << np.uint64(WIDE)) | rows[at + 1]
            at += 2
        else:
            values = rows[at].astype(attribute.code_dtype)
            at += 1
        codes[attribute.name] = values
    return codes


def _ycocg(values: NDArray[Any], bits: int) -> NDArray[np.int32]:
    """YCoCg-R (Malvar and Sullivan 2003): lossless lifting, chroma modulo ``2**(bits + 1)``."""
    red, green, blue = values.T.astype(np.int32)
    orange = red - blue
    base = blue + (orange >> 1)
    lime = green - base
    modulo = (1 << (bits + 1)) - 1
    return np.stack([base + (lime >> 1), orange & modulo, lime & modulo])


def _rgb(rows: NDArray[np.uint32], attribute: Attribute) -> NDArray[Any]:
    """Undo `_ycocg`. Rows that no colour gives still give a colour: it is cut to the attribute's bits."""
    half = 1 << attribute.bits
    luma, orange, lime = rows.astype(np.int32)
    orange -= (orange & half) << 1
    lime -= (lime & half) << 1
    values = np.empty((rows.shape[1], 3), attribute.code_dtype)
    base = luma - (lime >> 1)
    blue = base - (orange >> 1)
    levels = half - 1
    values[:, 0], values[:, 1], values[:, 2] = (blue + orange) & levels, (lime + base) & levels, blue & levels
    return values
