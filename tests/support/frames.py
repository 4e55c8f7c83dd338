"""Frame loops for tests of the access layer."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from lpc.codec import decode_cloud
from lpc.header import parse_header
from lpc.index import IndexTree

if TYPE_CHECKING:
    from lpc.cloud import Cloud
    from pointstream.layer import AccessLayer

FRAME = 1 / 30


def whole_index(data: bytes) -> IndexTree:
    """The index of a whole file."""
    index = IndexTree(parse_header(data))
    for page in range(len(index.page_loaded)):
        place = index.page_range(page)
        index.add_page(page, data[place.start : place.stop])
    return index


def frame(layer: AccessLayer) -> np.ndarray[Any, Any]:
    """A frame that draws all that is here from the root down and wants all the rest, coarse first."""
    layer.end_frame(np.flatnonzero(~layer.resident), pinned=np.flatnonzero(layer.resident))
    return layer.resident


def subtrees(index: IndexTree, nodes: list[int]) -> list[int]:
    """Nodes and all below them."""
    found = set(nodes)
    for node in range(len(index)):
        if int(index.parent[node]) in found:
            found.add(node)
    return sorted(found)


async def fill(layer: AccessLayer, frames: int = 3000) -> int:
    """Run frames until nothing can be had any more; how many it took."""
    for number in range(frames):
        frame(layer)
        if not layer.wanting:
            return number
        await asyncio.sleep(FRAME)
    return frames


def decoded_clouds(data: bytes, engine: Literal["auto", "numpy"] = "auto") -> list[Cloud]:
    """All clouds of a whole file, one after another."""
    index = whole_index(data)
    clouds: list[Cloud] = []
    for node in range(len(index)):
        place = index.cloud_range(node)
        line, above = [], int(index.parent[node])
        while above >= 0:
            line.append(clouds[above])
            above = int(index.parent[above])
        samples, schema = int(index.samples[node]), index.header.attributes
        frame = data[place.start : place.stop]
        clouds.append(decode_cloud(frame, samples=samples, schema=schema, context=line[::-1], engine=engine))
    return clouds


def check_clouds(layer: AccessLayer, data: bytes) -> None:
    """Every resident cloud is the file's, to the last bit."""
    right = decoded_clouds(data)
    for node in np.flatnonzero(layer.resident).tolist():
        cloud = layer.take(node)
        assert (cloud.lattice() == right[node].lattice()).all()
        for name, codes in right[node].codes.items():
            assert (cloud.codes[name] == codes).all()
