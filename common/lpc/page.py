"""Pages of the index: a run of node records with what finds their children (docs/format.md, Page)."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import Corrupt, Truncated
from .payload import MAX_SAMPLES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from .header import Header

RECORD = np.dtype(
    {
        "names": [
            "center",
            "radius",
            "spacing",
            "samples",
            "subtree",
            "size",
            "crc",
            "cone_axis",
            "cone_angle",
            "children",
        ],
        "formats": ["(3,)<u4", "<f4", "<f4", "<u4", "<u8", "<u4", "<u4", "(2,)u1", "<u2", "u1"],
        "offsets": [0, 12, 16, 20, 24, 32, 36, 40, 42, 44],
        "itemsize": 48,
    }
)
"""One node. `size` is the bytes of its cloud, `crc` their CRC-32, `children` the two bits."""

PAGE_HEADER = 48
CHILD_PAGES = 3  # 2 * page_nodes consecutive children touch at most three pages
SMALLEST_CLOUD = 16  # magic, frame header, one block header and checksum of any zstd frame
NO_CONE = 65535
COINCIDENT = 65535  # samples of an inner node whose samples are all at one place

_FIXED = struct.Struct("<8sIIII3Q")


@dataclass(frozen=True, slots=True)
class Page:
    """One parsed page.

    Parameters
    ----------
    first_node, first_child : int
        Number of the first node, and of the first child of any node of the page (whether there is one or not).
    child_pages : tuple of int
        File offsets of page ``first_child // page_nodes`` and the two after it; 0 where no child is, or for itself.
    records : ndarray, (n,) RECORD
        Read-only view into the bytes given.
    """

    first_node: int
    first_child: int
    child_pages: tuple[int, int, int]
    records: NDArray[Any]


def page_bytes(header: Header, page: int) -> int:
    """Exact length of a page, its clouds not included."""
    return PAGE_HEADER + RECORD.itemsize * page_records(header, page)


def page_records(header: Header, page: int) -> int:
    """Count the records of a page: `page_nodes`, or what is left for the last one."""
    if not 0 <= page < header.pages:
        raise ValueError(f"page {page} of {header.pages}")
    return min(header.page_nodes, header.nodes - page * header.page_nodes)


def pack_page(
    tag: bytes, first_node: int, first_child: int, child_pages: tuple[int, ...], records: NDArray[Any]
) -> bytes:
    """Bytes of a page; see `Page` for the arguments. `pack_pages` fills them in for a whole index."""
    body = np.ascontiguousarray(records).tobytes()
    blank = _FIXED.pack(tag, first_node, len(records), first_child, 0, *child_pages)
    crc = zlib.crc32(body, zlib.crc32(blank[24:], zlib.crc32(blank[:20])))
    return blank[:20] + struct.pack("<I", crc) + blank[24:] + body


def child_counts(records: NDArray[Any]) -> NDArray[np.int64]:
    """Children of each node: the bits of `children`."""
    bits = records["children"]
    return (bits & 1).astype(np.int64) + (bits >> 1)


def page_offsets(records: NDArray[Any], page_nodes: int, page0: int) -> NDArray[np.int64]:
    """File offsets of all pages, and of the end of the file: (pages + 1,) int64."""
    starts = np.arange(0, len(records), page_nodes)
    lengths = np.add.reduceat(records["size"].astype(np.int64) + RECORD.itemsize, starts) + PAGE_HEADER
    return page0 + np.concatenate([[0], np.cumsum(lengths)])


def pack_pages(tag: bytes, records: NDArray[Any], page_nodes: int, page0: int) -> Iterator[tuple[int, bytes]]:
    """Yield every page as (file offset, bytes); the clouds of its nodes follow it at once.

    Parameters
    ----------
    tag : bytes
        `Header.tag`.
    records : ndarray, (nodes,) RECORD
        Of all nodes, breadth-first.
    page_nodes, page0 : int
        As in the header.
    """
    offsets = page_offsets(records, page_nodes, page0)
    before = 1 + np.concatenate([[0], np.cumsum(child_counts(records))])
    for page, start in enumerate(range(0, len(records), page_nodes)):
        stop = min(start + page_nodes, len(records))
        first_child, end_child = int(before[start]), int(before[stop])
        numbers = child_page_numbers(page, first_child, end_child - first_child, page_nodes)
        wanted = tuple(int(offsets[number]) if number >= 0 else 0 for number in numbers)
        yield int(offsets[page]), pack_page(tag, start, first_child, wanted, records[start:stop])


def child_page_numbers(page: int, first_child: int, children: int, page_nodes: int) -> tuple[int, int, int]:
    """Pages whose offsets page `page` states, one per slot; -1 for a slot that stays 0."""
    first = first_child // page_nodes
    last = (first_child + children - 1) // page_nodes if children else -1
    slots = [number if page < number <= last else -1 for number in range(first, first + CHILD_PAGES)]
    return slots[0], slots[1], slots[2]


def parse_page(data: bytes | memoryview, header: Header, page: int) -> Page:
    """Read and check a page by itself; `lpc.index.IndexTree` checks it against the others.

    Parameters
    ----------
    data : bytes
        The file from the page's offset on; what follows the page is not looked at.
    header : Header
        Of the same file.
    page : int
        Number of the page.

    Raises
    ------
    Truncated
        If `data` is shorter than the page; its `needed` is the page's length.
    Corrupt
        If the page is of another build, damaged, or says what cannot be true.
    """
    count, length = page_records(header, page), page_bytes(header, page)
    data = memoryview(data).cast("B")
    if len(data) < length:
        raise Truncated(f"page {page}: {len(data)} of {length} bytes", length)
    tag, first_node, stated, first_child, crc, *child_pages = _FIXED.unpack_from(data)
    if tag != header.tag:
        raise Corrupt(f"page {page}: it belongs to another build of the model")
    if zlib.crc32(data[24:length], zlib.crc32(data[:20])) != crc:
        raise Corrupt(f"page {page}: checksum differs, the file is damaged")
    if first_node != page * header.page_nodes or stated != count:
        raise Corrupt(
            f"page {page}: it holds {stated} nodes from {first_node}, not {count} from {page * header.page_nodes}"
        )
    records: NDArray[Any] = np.frombuffer(data, dtype=RECORD, count=count, offset=PAGE_HEADER)
    records.flags.writeable = False
    _check_records(records, header, page)
    children = int(child_counts(records).sum())
    if first_child <= first_node or first_child + children > header.nodes:
        raise Corrupt(f"page {page}: children {first_child} to {first_child + children} of {header.nodes} nodes")
    numbers = child_page_numbers(page, first_child, children, header.page_nodes)
    if any((offset != 0) != (number >= 0) for offset, number in zip(child_pages, numbers, strict=True)):
        raise Corrupt(f"page {page}: offsets of its children's pages do not match its children")
    return Page(first_node, first_child, (child_pages[0], child_pages[1], child_pages[2]), records)


def _check_records(records: NDArray[Any], header: Header, page: int) -> None:
    samples = records["samples"].astype(np.uint64)
    subtree = records["subtree"]
    inner = records["children"] != 0
    for wrong, what in (
        (~(np.isfinite(records["radius"]) & (records["radius"] >= 0)), "radius"),
        (~(np.isfinite(records["spacing"]) & (records["spacing"] >= 0)), "spacing"),
        (records["children"] > 3, "children"),
        (records["size"] < SMALLEST_CLOUD, "bytes"),
        (samples < 1, "samples"),
        (samples > MAX_SAMPLES, "samples"),
        (inner & (samples > max(header.cloud_size, COINCIDENT)), "samples"),
        (subtree > header.samples, "subtree"),
        (np.where(inner, subtree <= samples, subtree != samples), "subtree"),
    ):
        if wrong.any():
            node = page * header.page_nodes + int(np.argmax(wrong))
            raise Corrupt(f"page {page}: {what} of node {node} cannot be true")
