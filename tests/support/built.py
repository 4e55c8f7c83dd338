"""Build models of arrays, and read them back with `lpc` alone."""

from __future__ import annotations

import time
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.codec import cloud_to_points, decode_cloud
from lpc.header import Header, parse_header
from lpc.index import IndexTree
from lpc.points import PointBatch
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from lpc.cloud import Cloud


@dataclass(frozen=True)
class Built:
    """A model that was read whole: every node's samples."""

    data: bytes
    header: Header
    index: IndexTree
    clouds: list[PointBatch]

    def everything(self) -> PointBatch:
        return PointBatch.concatenate(self.clouds)

    def members(self) -> list[frozenset[int]]:
        """Input places of each node's samples, for models of `numbered` points."""
        return [frozenset(cloud.attributes["place"].tolist()) for cloud in self.clouds]

    def descendants(self, node: int) -> list[int]:
        found = [node]
        for parent in found:
            found += [child for child in self.index.children[parent].tolist() if child >= 0]
        return found


def read_model(path: Path) -> Built:
    data = path.read_bytes()
    header = parse_header(data)
    assert header.bytes == len(data)
    index = IndexTree(header)
    for page in range(header.pages):
        where = index.page_range(page)
        index.add_page(page, data[where.start : where.stop])
    decoded: list[Cloud] = []
    for node in range(header.nodes):
        where = index.cloud_range(node)
        frame = data[where.start : where.stop]
        assert zlib.crc32(frame) == index.crc[node]
        line, above = [], int(index.parent[node])
        while above >= 0:
            line.append(decoded[above])
            above = int(index.parent[above])
        decoded.append(
            decode_cloud(frame, samples=int(index.samples[node]), schema=header.attributes, context=line[::-1])
        )
    return Built(data, header, index, [cloud_to_points(cloud, header) for cloud in decoded])


def numbered(xyz: NDArray[np.float64], **attributes: NDArray[Any]) -> PointBatch:
    """Points that know their place in the input."""
    return PointBatch(np.asarray(xyz, np.float64), {"place": np.arange(len(xyz), dtype=np.uint32), **attributes})


def build_points(points: PointBatch, out: Path, **options: Any) -> Built:
    """Build all attributes of points."""
    chosen = BuildOptions(**{"attributes": ("all",), "threads": 1, **options})
    build_model([ArrayScan(points)], out, chosen, clock=time.monotonic)
    return read_model(out)
