"""A copy of a part of a model, as `pointstream fetch` leaves it: a file with holes and the map of what is there."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lpc.errors import StoreError
from lpc.header import HEADER_PROBE, parse_header
from lpc.ranges import ByteRange

from .local import LocalStore
from .sparse import SparseFile

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray


class PartialStore(LocalStore):
    """A local file of which only what its map names is there.

    Raises
    ------
    NotFound, StoreError
        If it cannot be opened.
    FormatError
        If it does not start with a header.
    """

    partial = True

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        header = parse_header(self.read_now(ByteRange(0, HEADER_PROBE)))
        try:
            self._here = SparseFile(path, length=header.bytes, tag=header.tag, writable=False)
        except OSError as error:
            self._file.close()
            raise StoreError(f"{path}: its map cannot be read: {error.strerror or error}") from error

    def holds(self, starts: NDArray[np.int64], stops: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which ranges the map names."""
        return self._here.holds(starts, stops)

    async def opening_bytes(self) -> int:
        """Read no hole at the start."""
        holes = self._here.missing(ByteRange(0, HEADER_PROBE))
        return holes[0].start if holes and holes[0].start > 0 else HEADER_PROBE

    async def close(self) -> None:
        """Close the file."""
        await super().close()
        self._here.close()
