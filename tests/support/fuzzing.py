"""What the fuzzer and its findings are run on: the readers of header, page and cloud, and seeds that they accept.

Each target takes any bytes; whatever it raises besides the format's errors is a finding. Checksums are put right first,
since a stranger who makes a file can do so too.
"""

from __future__ import annotations

import struct
import zlib
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import zstandard
from oracles.build import build_bytes
from support.frames import decoded_clouds

from lpc.codec import decode_cloud
from lpc.errors import FormatError
from lpc.header import parse_header
from lpc.index import IndexTree
from lpc.page import PAGE_HEADER, RECORD
from lpc.points import PointBatch

if TYPE_CHECKING:
    from collections.abc import Callable

    from lpc.cloud import Cloud


@cache
def sound() -> bytes:
    """A small model with every kind of attribute."""
    draw = np.random.default_rng(0)
    xyz = draw.normal(size=(900, 3))
    attributes = {
        "normal": (xyz / np.linalg.norm(xyz, axis=1)[:, None]).astype(np.float32),
        "color": draw.integers(0, 256, (900, 3)).astype(np.uint8),
        "time": draw.normal(size=900),
        "class": draw.integers(0, 9, 900).astype(np.uint8),
    }
    return build_bytes(PointBatch(xyz, attributes), cloud_size=64, page_nodes=8)


@cache
def context() -> list[Cloud]:
    """Clouds that any other may be told from."""
    return decoded_clouds(sound())[:4]


def _tree() -> IndexTree:
    index = IndexTree(parse_header(sound()))
    for page in range(2):
        place = index.page_range(page)
        index.add_page(page, sound()[place.start : place.stop])
    return index


def read_header(data: bytes) -> None:
    """Parse a header under a right checksum."""
    fixed = bytearray(data)
    if len(fixed) >= 24:
        fixed[:8] = sound()[:8]
        length = struct.unpack_from("<I", fixed, 12)[0]
        fixed[16:20] = struct.pack("<I", zlib.crc32(fixed[24 : 24 + length]))
    header = parse_header(bytes(fixed))
    IndexTree(header)
    header.to_bytes()


def read_page(data: bytes) -> None:
    """Add a page to a tree that has two, under a right tag and checksum."""
    index = _tree()
    missing = index.missing_pages(np.arange(len(index)))
    number = int(missing[(data[0] if data else 0) % len(missing)])
    fixed = bytearray(data[1:])
    fixed[:8] = index.header.tag
    if len(fixed) >= PAGE_HEADER:
        size = PAGE_HEADER + RECORD.itemsize * struct.unpack_from("<I", fixed, 12)[0]
        fixed[20:24] = struct.pack("<I", zlib.crc32(fixed[24:size], zlib.crc32(fixed[:20])))
    before = index.known.copy()
    try:
        index.add_page(number, bytes(fixed))
    except FormatError:
        assert (index.known == before).all(), "a page that was refused left something"
        raise
    rows = np.flatnonzero(index.known)
    assert np.isfinite(index.center[rows]).all()
    assert (np.isfinite(index.radius[rows]) & (index.radius[rows] >= 0)).all()
    assert (index.offset[rows] + index.size[rows] <= index.header.bytes).all()


def read_cloud(data: bytes) -> None:
    """Decode a payload in a right frame, by both engines; they must agree."""
    header = parse_header(sound())
    samples = 1 + (data[0] if data else 0) % 64
    frame = zstandard.ZstdCompressor(write_checksum=True).compress(data[1:])
    outcomes = []
    for engine in ("numpy", "compiled"):
        try:
            cloud = decode_cloud(frame, samples=samples, schema=header.attributes, context=context(), engine=engine)  # type: ignore[arg-type]
        except FormatError as error:
            outcomes.append(type(error))
        else:
            lattice = cloud.lattice()
            assert lattice.shape == (samples, 3)
            outcomes.append(lattice.tobytes() + b"".join(codes.tobytes() for codes in cloud.codes.values()))
    assert outcomes[0] == outcomes[1], "the engines disagree"


def read_frame(data: bytes) -> None:
    """Decode a cloud as it comes from the line."""
    header = parse_header(sound())
    decode_cloud(data[1:], samples=1 + (data[0] if data else 0) % 64, schema=header.attributes, engine="numpy")


TARGETS: dict[str, Callable[[bytes], None]] = {
    "header": read_header,
    "page": read_page,
    "cloud": read_cloud,
    "frame": read_frame,
}


def seeds(target: str) -> list[bytes]:
    """Inputs that a target accepts, or nearly."""
    data = sound()
    index = _tree()
    if target == "header":
        return [data[: index.header.page0]]
    if target == "page":
        starts = [index.page_range(int(page)).start for page in index.missing_pages(np.arange(len(index)))]
        return [bytes([number]) + data[start : start + 2000] for number, start in enumerate(starts)]
    frames = []
    for node in np.flatnonzero(index.known).tolist():
        place = index.cloud_range(node)
        cloud = data[place.start : place.stop]
        content = zstandard.ZstdDecompressor().decompress(cloud) if target == "cloud" else cloud
        frames.append(bytes([int(index.samples[node]) - 1]) + content)
    return frames


def run_one(target: str, data: bytes) -> None:
    """Run a target; only what is a finding comes out."""
    try:
        TARGETS[target](data)
    except FormatError as error:
        text = str(error)
        assert "\n" not in text, "an error of several lines"
        assert len(text) < 400, "an error without end"
