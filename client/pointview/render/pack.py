"""Clouds as the renderers hold them: 12 bytes a sample, still quantised.

    u16 x, y, z     position inside the cloud, in steps of `scale` from `origin`
    u16 normal      two octahedral bytes, the first in the low byte; 0: none. Of a model without normals that of the
                    sample's plane (`planes`), of either sign
    u8  r, g, b     colour; white where the model has none
    u8  spacing     of the cloud's samples around this one, where it is in a thin part of the cloud (`thin`); 0: no

The same bytes feed the CPU kernels and OpenGL's vertex fetch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .planes import planes
from .thin import thin

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.attributes import Attribute
    from lpc.cloud import Cloud
    from lpc.header import Header

SAMPLE_BYTES = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class PackedCloud:
    """One cloud ready to upload.

    Parameters
    ----------
    vertex : (k, 4) uint16
        x, y, z, normal.
    color : (k, 4) uint8
    origin : (3,) float64
        Model space position of (0, 0, 0).
    scale : float
        Model units of one step.
    thin : bool
        Whether some samples have a spacing of their own.
    """

    vertex: NDArray[np.uint16]
    color: NDArray[np.uint8]
    origin: NDArray[np.float64]
    scale: float
    thin: bool


class Packer:
    """Packs the clouds of one model."""

    def __init__(self, header: Header) -> None:
        self._origin = np.array(header.origin, dtype=np.float64)
        self._step = float(header.step)
        self._normal = _find(header, "normal")
        self._color = _find(header, "color")
        self.has_normals = self._normal is not None
        self.has_colors = self._color is not None

    def pack(self, cloud: Cloud, most: int) -> PackedCloud:
        """Pack at most `most` samples.

        Notes
        -----
        A cloud exceeds the model's cloud size only where more samples than that coincide, so what is cut off would be
        drawn over what is not.
        """
        count = min(len(cloud), most)
        vertex = np.zeros((count, 4), dtype=np.uint16)
        vertex[:, :3] = cloud.position[:count]
        if self._normal is not None and self._normal.name in cloud.codes:
            vertex[:, 3] = _normal_bytes(cloud.codes[self._normal.name][:count], self._normal.bits)
        elif self._normal is None:
            vertex[:, 3] = planes(vertex[:, :3])
        color = np.full((count, 4), 255, dtype=np.uint8)
        if self._color is not None and self._color.name in cloud.codes:
            color[:, :3] = _color_bytes(cloud.codes[self._color.name][:count], self._color)
        color[:, 3] = thin(vertex[:, :3], vertex[:, 3])
        cell = 2.0**cloud.shift
        dropped = (cell - 1) / 2  # the low bits that are not drawn, on average
        origin = self._origin + self._step * (cloud.origin.astype(np.float64) + dropped)
        return PackedCloud(
            vertex=vertex, color=color, origin=origin, scale=self._step * cell, thin=bool(color[:, 3].any())
        )


def _find(header: Header, kind: str) -> Attribute | None:
    return next((attribute for attribute in header.attributes if attribute.kind == kind), None)


def _color_bytes(codes: NDArray[Any], attribute: Attribute) -> NDArray[Any]:
    """Colour codes of any width as a byte a channel."""
    return attribute.full(codes) >> max((attribute.depth or attribute.bits) - 8, 0)


def _normal_bytes(codes: NDArray[Any], bits: int) -> NDArray[np.uint16]:
    """Octahedral codes of any width as two bytes in one uint16; (0, 0) stays, and nothing else becomes it."""
    if bits == 8:
        wide = codes.astype(np.uint16)
    else:
        half = float(2 ** (bits - 1) - 1)
        wide = np.rint(codes * (127.0 / half)).astype(np.uint16)
        rounded_to_none = (wide == 0).all(axis=1) & (codes != 0).any(axis=1)
        wide[rounded_to_none, 1] = 254  # another corner of the square: -z as well
    return wide[:, 0] | (wide[:, 1] << np.uint16(8))
