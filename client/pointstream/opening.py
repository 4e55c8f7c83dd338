"""From the first bytes of a file to its index tree, as they come: the first request is the first picture."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

import numpy as np

from lpc.errors import FormatError, LpcError, ModelChanged, Truncated
from lpc.header import HEADER_PROBE, Header, parse_header
from lpc.index import IndexTree
from lpc.ranges import ByteRange

if TYPE_CHECKING:
    from .stores import Store


class Opening:
    """Header and page 0 out of a growing prefix of a file.

    Attributes
    ----------
    header : Header or None
        As soon as its bytes are there.
    index : IndexTree or None
        As soon as page 0 is there, or when the file is known to end before it (then without any node).
    needed : int
        Bytes of prefix that the next step takes; what is there may be more.
    used : int
        Bytes of the prefix that header and page 0 take, as far as they are there.

    Parameters
    ----------
    probe : int
        Bytes of the first read.
    """

    def __init__(self, probe: int = HEADER_PROBE) -> None:
        self.header: Header | None = None
        self.index: IndexTree | None = None
        self.needed = probe
        self.used = 0

    def look(self, data: bytes | bytearray, *, ended: bool = False) -> bool:
        """Take in a prefix that has grown; True once the index is there.

        Parameters
        ----------
        data : bytes
            The file's first bytes.
        ended : bool
            The file ends here.

        Raises
        ------
        FormatError
            If this is no model, damaged, newer than this program, or ends inside its header.
        """
        if self.index is not None:
            return True
        if self.header is None:
            try:
                self.header = parse_header(bytes(data))
            except Truncated as error:
                self.needed = error.needed
                if ended:
                    raise
                return False
        index = IndexTree(self.header)
        page = index.page_range(0)
        self.needed = page.stop
        if len(data) >= page.stop:
            index.add_page(0, bytes(data[page.start : page.stop]))
        elif not ended:
            return False
        self.index = index
        self.used = page.stop if index.page_loaded[0] else self.header.page0
        return True


def naming(name: str, error: LpcError) -> LpcError:
    """Put the path or address before the text of an error that lacks it: people open more than one model."""
    text = str(error)
    if name not in text:
        error.args = (f"{name}: {text}",)
    return error


async def open_index(store: Store) -> tuple[IndexTree, bytes]:
    """Read header and first page: one request of `HEADER_PROBE` bytes, more only if the header is larger.

    Returns
    -------
    index : IndexTree
    data : bytes
        The file's first bytes, all that were read.

    Raises
    ------
    StoreError, FormatError
    """
    opening, data = Opening(await store.opening_bytes()), b""
    while True:
        part = b"" if hole_at(store, len(data)) else await store.read(ByteRange(len(data), opening.needed))
        data += part
        try:
            done = opening.look(data, ended=len(data) < opening.needed or not part)
        except FormatError as error:
            naming(store.name, error)
            raise
        if done:
            assert opening.index is not None
            if vouch_opening(store, opening, data):
                _vouch_clouds(store, opening.index, data)
            return opening.index, data


def hole_at(store: Store, place: int) -> bool:
    """Whether what a store gives of this place is not the model's: for an opening, the file ends there."""
    return store.partial and not store.holds(np.array([place]), np.array([place + 1]))[0]


def vouch_opening(store: Store, opening: Opening, data: bytes | bytearray) -> bool:
    """Tell a store that header and first page passed their checks; True if it keeps such things."""
    assert opening.index is not None
    start = opening.index.header.page0
    kept = store.vouch(ByteRange(0, start), bytes(data[:start]))
    if opening.index.page_loaded[0]:
        page = opening.index.page_range(0)
        store.vouch(page, bytes(data[page.start : page.stop]))
    return kept


def _vouch_clouds(store: Store, index: IndexTree, data: bytes) -> None:
    """Tell a store which clouds of the first page came along and are sound."""
    for node in np.flatnonzero(index.available(len(data))).tolist():
        place = index.cloud_range(node)
        cloud = data[place.start : place.stop]
        if zlib.crc32(cloud) == int(index.crc[node]):
            store.vouch(place, cloud)


def add_page(index: IndexTree, page: int, data: bytes) -> None:
    """Add a page to an index tree, and tell one of another build from a damaged one.

    Raises
    ------
    ModelChanged
        If the page is sound and its build tag is another.
    Corrupt
        If it is not sound.
    """
    tag, crc = data[:8], int.from_bytes(data[20:24], "little")
    if tag != index.header.tag and zlib.crc32(data[24:], zlib.crc32(data[:20])) == crc:
        raise ModelChanged(f"page {page} belongs to another build of the model: it was replaced while being read")
    index.add_page(page, data)
