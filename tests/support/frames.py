"""Frame loops for tests of the access layer."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.codec import decode_cloud
from lpc.header import parse_header
from lpc.index import IndexTree

if TYPE_CHECKING:
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


async def fill(layer: AccessLayer, frames: int = 3000) -> int:
    """Run frames until nothing can be had any more; how many it took."""
    for number in range(frames):
        frame(layer)
        if not layer.wanting:
            return number
        await asyncio.sleep(FRAME)
    return frames


def check_clouds(layer: AccessLayer, data: bytes) -> None:
    """Every resident cloud is the file's, to the last bit."""
    index = whole_index(data)
    for node in np.flatnonzero(layer.resident).tolist():
        place = index.cloud_range(node)
        right = decode_cloud(
            data[place.start : place.stop], samples=int(index.samples[node]), schema=index.header.attributes
        )
        cloud = layer.take(node)
        assert (cloud.lattice() == right.lattice()).all()
        for name, codes in right.codes.items():
            assert (cloud.codes[name] == codes).all()
