"""The frame loop's own copy of what is here: what a frame reads can neither be locked nor vanish under it.

The access layer lives on another thread. It posts what came and what it dropped; the frame loop takes the news between
two frames. Clouds are shared and never change. The index tree is shared too: its rows are written before they are
`known`, so a frame that looks at known rows alone, as `refine` does, needs no lock.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from lpc.cloud import Cloud
    from lpc.header import Header
    from lpc.index import IndexTree


@dataclass(frozen=True, slots=True)
class Opened:
    """A model, or another build of it, in place of what was there."""

    index: IndexTree
    build: int


@dataclass(frozen=True, slots=True)
class Came:
    """A cloud is here."""

    node: int
    cloud: Cloud


@dataclass(frozen=True, slots=True)
class Gone:
    """Clouds were dropped for want of memory."""

    nodes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Failed:
    """The model cannot be had."""

    text: str


News = Opened | Came | Gone | Failed


@dataclass(slots=True)
class Mirror:
    """What the next frame draws from.

    Attributes
    ----------
    index : IndexTree or None
        None until the model is open.
    build : int
        Which build of the model; grows when the host replaces it.
    resident : (nodes,) bool
    clouds : dict of int to Cloud
        The resident ones.
    failure : str
        Why there is no model; empty if there may be one.
    """

    index: IndexTree | None = None
    build: int = 0
    resident: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    clouds: dict[int, Cloud] = field(default_factory=dict)
    failure: str = ""
    _pages: int = 0

    @property
    def header(self) -> Header:
        """Header of the present build; there must be one."""
        assert self.index is not None
        return self.index.header

    def take_in(self, news: Iterable[News]) -> bool:
        """Apply news in order; True if a frame may look different after them."""
        changed = False
        for item in news:
            changed = True
            match item:
                case Opened(index, build):
                    self.index, self.build, self.failure = index, build, ""
                    self.resident = np.zeros(index.header.nodes, dtype=bool)
                    self.clouds, self._pages = {}, 0
                case Came(node, cloud):
                    self.clouds[node] = cloud
                    self.resident[node] = True
                case Gone(nodes):
                    for node in nodes:
                        self.clouds.pop(node, None)
                    self.resident[list(nodes)] = False
                case Failed(text):
                    self.failure = text
        if self.index is not None:
            pages = int(np.count_nonzero(self.index.page_loaded))
            changed |= pages != self._pages
            self._pages = pages
        return changed

    def take(self, node: int) -> Cloud:
        """Return a resident cloud: what a renderer is given to ask."""
        return self.clouds[node]
