"""The file: header, pages and clouds, written under another name, made durable, then renamed."""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, BinaryIO

from lpc.errors import BuildError
from lpc.page import pack_pages

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from lpc.header import Header

_COPY = 1 << 20


def write_model(out: Path, part: Path, header: Header, records: NDArray[Any], clouds: BinaryIO) -> None:
    """Write a model; a file of that name is replaced at the end and at once, or not at all.

    Parameters
    ----------
    out : Path
    part : Path
        The file's name until it is whole; on the same disk.
    header : Header
        Sealed.
    records : ndarray, (nodes,) RECORD
    clouds : binary file
        All clouds in the order of the nodes, without gaps; read from its start.
    """
    with replacing(out, part) as file:
        file.write(header.to_bytes())
        clouds.seek(0)
        for number, (_, page) in enumerate(pack_pages(header.tag, records, header.page_nodes, header.page0)):
            file.write(page)
            begin = number * header.page_nodes
            _copy(clouds, file, int(records["size"][begin : begin + header.page_nodes].sum(dtype="u8")))


@contextmanager
def replacing(out: Path, part: Path) -> Iterator[BinaryIO]:
    """Give a new file `part` that takes the name `out` when the block ends well, and vanishes when it does not."""
    try:
        with part.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(out)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    folder = os.open(out.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _copy(source: BinaryIO, target: BinaryIO, length: int) -> None:
    while length:
        piece = source.read(min(length, _COPY))
        if not piece:
            raise BuildError("a temporary file of the build is shorter than it was: is another program cleaning up?")
        target.write(piece)
        length -= len(piece)
