"""What the access layer asks of a store."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
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
    """

    name: str
    length: int | None
    meter: Goodput | None

    async def read(self, wanted: ByteRange, sink: Sink | None = None) -> bytes:
        """Read a range; the result is shorter only where the file ends inside it.

        Raises
        ------
        StoreError
            Once, after everything that helps has been tried.
        """

    def forget(self, *, distrust_tags: bool = False) -> None:
        """Take whatever stands there now for the model: the length and the entity tag are learned anew.

        Parameters
        ----------
        distrust_tags : bool
            The tag changed and the model did not: do not compare tags of this host any more.
        """

    async def close(self) -> None:
        """Free what the store holds; reads in progress fail."""
