"""What every reader gives: a scan that can be read in batches, as often as one likes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from lpc.points import PointBatch

Normals = Literal["auto", "keep", "estimate", "drop"]

CUT_SHORT = "the file is cut short, copy it again"

DEFAULT_ATTRIBUTES = ("normal", "color", "intensity", "classification")
"""Kept whenever a scan has them; anything else only when all attributes are asked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadOptions:
    """What to take from a scan besides positions.

    Parameters
    ----------
    normals : {"auto", "keep", "estimate", "drop"}
        ``auto``: those of the file, else from the faces of a mesh, else none. ``keep``: only those of the file.
        ``estimate`` and ``drop``: the reader gives none (`pointbuild.normals.estimate` adds estimated ones).
    attributes : {"default", "all"}
        ``default`` takes `DEFAULT_ATTRIBUTES`, ``all`` everything that is a number.
    """

    normals: Normals = "auto"
    attributes: Literal["default", "all"] = "default"

    @property
    def file_normals(self) -> bool:
        """Normals that stand in the file are wanted."""
        return self.normals in ("auto", "keep")

    @property
    def face_normals(self) -> bool:
        """Normals may be made from faces where the file has none."""
        return self.normals == "auto"

    def wants(self, name: str) -> bool:
        """Whether the scalar attribute `name` is wanted."""
        return self.attributes == "all" or name in DEFAULT_ATTRIBUTES


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanInfo:
    """What is known of a scan before its samples are read.

    Parameters
    ----------
    path : Path
        The file.
    samples_hint : int or None
        Number of records, non-finite ones included, where the file declares it; reading checks it.
    bounds_hint : tuple of 6 floats or None
        Declared box x0, y0, z0, x1, y1, z1 in model units. Nothing guarantees it.
    crs : str or None
        Coordinate reference system as WKT.
    attributes : mapping of str to dtype
        Names and value dtypes of the attributes that every batch has: ``normal`` float32 (n, 3), ``color`` uint8 or
        uint16 (n, 3), others (n,).
    raw_bytes : int
        Length of the file.
    left_out : mapping of str to str
        What the file holds and the batches do not, and why.
    scale : tuple of 3 floats or None
        Of positions that are stored as integers.
    """

    path: Path
    samples_hint: int | None = None
    bounds_hint: tuple[float, float, float, float, float, float] | None = None
    crs: str | None = None
    attributes: Mapping[str, np.dtype[Any]] = field(default_factory=dict)
    raw_bytes: int = 0
    left_out: Mapping[str, str] = field(default_factory=dict)
    scale: tuple[float, ...] | None = None


class Scan(Protocol):
    """Samples of one file; a record's index is its position in the order of the batches."""

    @property
    def info(self) -> ScanInfo:
        """What is known before reading."""
        ...

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Read from the start in batches of at most `size` samples.

        Every call yields the same samples in the same order.

        Records whose position is not finite come as they stand: see `finite`.

        Raises
        ------
        ScanError
            If the file is damaged or holds fewer samples than it declares.
        """
        ...


def finite(batch: PointBatch) -> tuple[PointBatch, dict[str, int]]:
    """Drop the records that have no position; nothing else is ever dropped.

    Parameters
    ----------
    batch : PointBatch
        As a reader yields it.

    Returns
    -------
    batch : PointBatch
        Records with three finite coordinates; normals that are not finite become zero vectors (none).
    counts : dict
        Dropped records: ``nan`` if any coordinate is not a number, else ``infinite``.
    """
    counts = {"nan": 0, "infinite": 0}
    good = finite_rows(batch.xyz)
    if not good.all():
        nan = int(np.isnan(batch.xyz).any(axis=1).sum())
        counts = {"nan": nan, "infinite": len(batch) - int(good.sum()) - nan}
        batch = batch.take(good)
    normal = batch.normal
    if normal is not None:
        bad = ~finite_rows(normal)
        if bad.any():
            mended = normal.copy()
            mended[bad] = 0
            batch = PointBatch(batch.xyz, {**batch.attributes, "normal": mended})
    return batch, counts


def finite_rows(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Tell which rows of (n, 3) values are finite."""
    # A column at a time: numpy is five times slower when it reduces along an axis of three.
    good: NDArray[np.bool_] = np.isfinite(values[:, 0]) & np.isfinite(values[:, 1]) & np.isfinite(values[:, 2])
    return good


def unit(normals: NDArray[Any]) -> NDArray[np.float32]:
    """Scale vectors (n, 3) to length 1, as float32; zero vectors and vectors that are not finite stay as they are."""
    with np.errstate(over="ignore"):
        out = np.array(normals, dtype=np.float32, order="C")
    length = np.sqrt(np.einsum("ij,ij->i", out, out, dtype=np.float64))
    length[~(length > 0) | ~np.isfinite(length)] = 1
    out /= length[:, None].astype(np.float32)
    return out
