"""Vertex normals of a mesh from its faces, face by face.

A vertex normal is the sum of the area vectors of the faces around it, scaled to length 1: faces weigh by their area.
The faces stream; held in memory are positions and sums of the vertices, 24 bytes each, and then the normals, 12.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpc.errors import ScanError

from .kernels import add_polygons
from .scan import finite_rows, unit

_SLICE = 1 << 18


class VertexNormals:
    """Adds up faces.

    Parameters
    ----------
    batches : iterable of ndarray, (k, 3) float64
        All vertices in order.
    """

    def __init__(self, batches: Iterable[NDArray[np.float64]]) -> None:
        origin: NDArray[np.float64] | None = None
        parts: list[NDArray[np.float32]] = []
        reach = float(np.finfo(np.float32).tiny)
        for xyz in batches:
            good = xyz[finite_rows(xyz)]
            if origin is None and len(good):
                origin = good[0]
            # Relative to one of them, float32 keeps the shape of a mesh that stands millions of units off.
            relative = xyz - (0.0 if origin is None else origin)
            reach = max(reach, float(np.max(np.abs(relative[np.isfinite(relative)]), initial=0.0)))
            with np.errstate(over="ignore"):
                parts.append(relative.astype(np.float32))
        self._xyz = np.concatenate(parts) if parts else np.empty((0, 3), np.float32)
        self._xyz /= np.float32(reach)  # area vectors of tiny meshes must not underflow
        parts.clear()
        self._sums = np.zeros_like(self._xyz)

    def add(self, counts: NDArray[np.int64], indices: NDArray[Any]) -> None:
        """Add polygons: `counts` (f,) corners each, `indices` of their vertices one after another.

        Raises
        ------
        ScanError
            If an index names no vertex.
        """
        corners = np.asarray(indices).astype(np.int64)
        if len(corners) and (corners.min() < 0 or corners.max() >= len(self._xyz)):
            bad = corners.min() if corners.min() < 0 else corners.max()
            raise ScanError(f"a face names vertex {bad:,} of {len(self._xyz):,}; the file is damaged")
        add_polygons(self._xyz, counts, corners, self._sums)

    def finish(self) -> NDArray[np.float32]:
        """Return unit normals (n, 3), zero for vertices of no face; the positions are let go."""
        normals, self._xyz, self._sums = self._sums, np.empty((0, 3), np.float32), np.empty((0, 3), np.float32)
        for start in range(0, len(normals), _SLICE):
            normals[start : start + _SLICE] = unit(normals[start : start + _SLICE])
        return normals
