"""What came before any frame wanted it, and how much of it was drawn in the end. Pure.

*Ahead* are the body bytes of requests that were made when no frame wanted anything of theirs, gaps between objects and
unfinished replies included. A cloud among them is *used* when a frame draws it, a page when a frame draws a node of it;
what memory dropped before is not. The rest is *wasted*, so far.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Foresight:
    """Counters of one layer; the model may change under them.

    Attributes
    ----------
    received, used : int
        Bytes that came ahead, and those among them that were used.
    """

    def __init__(self) -> None:
        self.received = self.used = 0
        self._sizes: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._pages: dict[int, int] = {}
        self._page_nodes = 1

    def begin(self, nodes: int, page_nodes: int) -> None:
        """Start anew with a model of so many nodes; what came of the one before and was not drawn stays wasted."""
        self._sizes = np.zeros(nodes, dtype=np.int64)
        self._pages, self._page_nodes = {}, page_nodes

    @property
    def wasted(self) -> int:
        """Bytes that came ahead and were not used."""
        return self.received - self.used

    def landed(self, nbytes: int) -> None:
        """Count bytes that came ahead."""
        self.received += nbytes

    def came(self, key: int, size: int) -> None:
        """Note that a cloud (or page ``~key``) of those bytes, `size` of them, is complete and can be used."""
        if key < 0:
            self._pages[~key] = size
        else:
            self._sizes[key] = size

    def drew(self, nodes: NDArray[np.int64]) -> None:
        """Note what a frame draws."""
        self.used += int(self._sizes[nodes].sum())
        self._sizes[nodes] = 0
        if self._pages:
            for page in np.unique(nodes // self._page_nodes).tolist():
                self.used += self._pages.pop(page, 0)

    def dropped(self, nodes: list[int]) -> None:
        """Note what is not in memory any more: if it is drawn later, it came another time."""
        self._sizes[nodes] = 0
