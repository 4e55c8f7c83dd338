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
from .scan import unit


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
        for xyz in batches:
            if origin is None and np.isfinite(xyz).all(axis=1).any():
                origin = xyz[np.isfinite(xyz).all(axis=1)][0]
            # Relative to one of them, float32 keeps the shape of a mesh that stands millions of units off.
            with np.errstate(over="ignore"):
                parts.append((xyz - (0.0 if origin is None else origin)).astype(np.float32))
        self._xyz = np.concatenate(parts) if parts else np.empty((0, 3), np.float32)
        reach = float(
            np.max(np.abs(self._xyz, where=np.isfinite(self._xyz), out=np.zeros_like(self._xyz)), initial=0.0)
        )
        self._xyz /= max(reach, float(np.finfo(np.float32).tiny))  # area vectors of tiny meshes must not underflow
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
        normals = unit(self._sums)
        self._xyz = self._sums = np.empty((0, 3), np.float32)
        return normals
