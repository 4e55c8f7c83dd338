"""Models of known surfaces, built by the oracle and wholly decoded: what refine and the backends read."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from oracles import surfaces
from oracles.build import build_bytes
from support.frames import decoded_clouds, whole_index

from lpc.header import Header, parse_header
from lpc.points import PointBatch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.cloud import Cloud
    from lpc.index import IndexTree


@dataclass
class Model:
    """A model in memory; `taken` lists the clouds that a backend asked for."""

    header: Header
    index: IndexTree
    clouds: list[Cloud]
    taken: list[int] = field(default_factory=list)

    def __repr__(self) -> str:
        return f"<Model of {self.header.samples} samples>"

    def take(self, node: int) -> Cloud:
        self.taken.append(node)
        return self.clouds[node]

    @property
    def everything(self) -> NDArray[np.bool_]:
        return np.ones(self.header.nodes, dtype=bool)

    def first(self, nodes: int) -> NDArray[np.bool_]:
        """Only the first nodes are resident, as after a prefix of the file."""
        return np.arange(self.header.nodes) < nodes

    def positions(self, node: int) -> NDArray[np.float64]:
        """Decoded samples of a node, model space."""
        return np.array(self.header.origin) + self.header.step * self.clouds[node].lattice()


def build(
    points: PointBatch, spacing: float, *, cloud_size: int = 256, crs: str | None = None, normal_bits: int = 8
) -> Model:
    data = build_bytes(points, cloud_size=cloud_size, spacing=spacing, crs=crs, page_nodes=64, normal_bits=normal_bits)
    return load(data, engine="numpy")


def load(data: bytes, engine: Literal["auto", "numpy"] = "auto") -> Model:
    """Read a whole file."""
    return Model(header=parse_header(data), index=whole_index(data), clouds=decoded_clouds(data, engine))


def sphere(
    samples: int,
    *,
    cloud_size: int = 256,
    color: bool = False,
    normals: bool = True,
    crs: str | None = None,
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    radius: float = 1.0,
    normal_bits: int = 8,
) -> Model:
    points = surfaces.sphere(samples, radius=radius, color=color, normals=normals)
    points = PointBatch(points.xyz + np.array(at), points.attributes)
    return build(
        points, float(np.sqrt(4 * np.pi * radius**2 / samples)), cloud_size=cloud_size, crs=crs, normal_bits=normal_bits
    )


TORUS = (1.0, 0.35)


def torus(samples: int, *, cloud_size: int = 256, color: bool = False, normals: bool = True) -> Model:
    points = surfaces.torus(samples, color=color, normals=normals)
    spacing = float(np.sqrt(4 * np.pi**2 * TORUS[0] * TORUS[1] / samples))
    return build(points, spacing, cloud_size=cloud_size)
