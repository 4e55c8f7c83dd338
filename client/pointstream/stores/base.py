"""What the access layer asks of a store."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import numpy as np

from lpc.header import HEADER_PROBE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.ranges import ByteRange
    from pointstream.goodput import Goodput

Sink = Callable[[int, bytes], None]
"""Called as ``sink(offset, chunk)`` with each piece of a range as it arrives and its place in the file.

Pieces come in order and without gaps; after a failure they may start again from an earlier offset, never a later one.
"""


class Store(Protocol):
    """Bytes of one file, by range.

    Attributes
    ----------
    name : str
        The path or address, as messages show it.
    length : int or None
        Bytes of the file; None as long as it is not known.
    meter : Goodput or None
        Of the link that the bytes come over; None where there is no link worth measuring.
    partial : bool
        What it does not hold never comes.
    warnings : tuple of str
        What the store has to do without, a line each.
    """

    name: str
    meter: Goodput | None

    @property
    def length(self) -> int | None:
        """Bytes of the file; None as long as it is not known."""

    @property
    def partial(self) -> bool:
        """Whether what it does not hold never comes."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the store has to do without, a line each."""

    async def opening_bytes(self) -> int:
        """Return how many of the file's first bytes to read first.

        Raises
        ------
        StoreError
        """

    async def read(self, wanted: ByteRange, sink: Sink | None = None) -> bytes:
        """Read a range; the result is shorter only where the file ends inside it.

        Raises
        ------
        StoreError
            Once, after everything that helps has been tried.
        """

    def holds(self, starts: NDArray[np.int64], stops: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which ranges it gives without asking over a link."""

    def vouch(self, place: ByteRange, data: bytes) -> bool:
        """Hear that these bytes of the header, a page or a cloud passed their checks; True if they are kept."""

    def reject(self, place: ByteRange) -> None:
        """Hear that the bytes of this range failed their checks: the next read is not to give the same again."""

    def forget(self, *, distrust_tags: bool = False) -> None:
        """Take whatever stands there now for the model: the length and the entity tag are learned anew.

        Parameters
        ----------
        distrust_tags : bool
            The tag changed and the model did not: do not compare tags of this host any more.
        """

    async def close(self) -> None:
        """Free what the store holds; reads in progress fail."""


class KeepsNothing:
    """The part of a store that has no memory of its own."""

    partial = False
    warnings: tuple[str, ...] = ()

    async def opening_bytes(self) -> int:
        """Ask for what holds header, first page and first clouds."""
        return HEADER_PROBE

    def holds(self, starts: NDArray[np.int64], stops: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Hold nothing."""
        del stops
        return np.zeros(len(starts), dtype=bool)

    def vouch(self, place: ByteRange, data: bytes) -> bool:
        """Keep nothing."""
        del place, data
        return False

    def reject(self, place: ByteRange) -> None:
        """Remember nothing."""
