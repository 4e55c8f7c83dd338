"""Samples that are in memory already, as a scan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .readers import ScanInfo

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lpc.points import PointBatch


class ArrayScan:
    """A scan over a `PointBatch`.

    Parameters
    ----------
    points : PointBatch
    crs : str, optional
        Coordinate reference system as WKT.
    name : str
        What messages call it.
    """

    def __init__(self, points: PointBatch, *, crs: str | None = None, name: str = "array") -> None:
        self.points = points
        self.info = ScanInfo(
            path=Path(name),
            samples_hint=len(points),
            crs=crs,
            attributes={key: np.asarray(values).dtype for key, values in points.attributes.items()},
            raw_bytes=points.xyz.nbytes + sum(values.nbytes for values in points.attributes.values()),
        )

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Cut the arrays into batches."""
        for begin in range(0, len(self.points), size):
            yield self.points.take(slice(begin, begin + size))
