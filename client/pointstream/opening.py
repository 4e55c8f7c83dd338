"""From the first bytes of a file to its index tree, as they come: the first request is the first picture."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

from lpc.errors import ModelChanged, Truncated
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
    """

    def __init__(self) -> None:
        self.header: Header | None = None
        self.index: IndexTree | None = None
        self.needed = HEADER_PROBE

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
        return True


async def open_index(store: Store) -> IndexTree:
    """Read header and first page: one request of `HEADER_PROBE` bytes, more only if the header is larger.

    Raises
    ------
    StoreError, FormatError
    """
    opening, data = Opening(), b""
    while True:
        part = await store.read(ByteRange(len(data), max(opening.needed, HEADER_PROBE)))
        data += part
        if opening.look(data, ended=len(data) < opening.needed or not part):
            assert opening.index is not None
            return opening.index


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
