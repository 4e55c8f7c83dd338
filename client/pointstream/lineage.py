"""Clouds that others are guessed from: a cloud is decoded after its nearest ancestors (docs/format.md, Context)."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

from lpc.context import is_told, line_of
from lpc.errors import Corrupt

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from lpc.cloud import Cloud
    from lpc.index import IndexTree

Family = dict[int, "Cloud | Corrupt"]
"""Nodes that have been decoded, or could not be."""


def ancestors(index: IndexTree, node: int) -> list[int]:
    """Nodes that a cloud is guessed from, from the root down; none where no page says which they are."""
    return line_of(node, index.parent) if is_told(index.header) and index.linked[node] else []


def context(index: IndexTree, node: int, family: Mapping[int, Cloud | Corrupt]) -> list[Cloud] | None:
    """Give the decoded ancestors of a node; None where no cloud of the model is guessed from any.

    Raises
    ------
    Corrupt
        If one of them is damaged, or a page that says which they are: `Untold`.
    """
    if not is_told(index.header):
        return None
    if not index.linked[node]:
        raise Untold(f"cloud {node}: the page that says what it is told from is not here")
    clouds = []
    for above in ancestors(index, node):
        cloud = family[above]
        if isinstance(cloud, Corrupt):
            raise Untold(f"cloud {node}: it is told from one that is damaged ({cloud})")
        clouds.append(cloud)
    return clouds


class Untold(Corrupt):
    """Nothing is known to be wrong with a cloud, but one that it is told from is damaged."""


class Lineage:
    """Decoded inner nodes of a model that is read in file order; the least recently used go first.

    Parameters
    ----------
    index : IndexTree
    capacity : int
        Bytes of clouds to keep. Whatever it is all nodes can be decoded: what went is asked for again.
    """

    def __init__(self, index: IndexTree, capacity: int) -> None:
        self._index, self._capacity, self._bytes = index, capacity, 0
        self._clouds: OrderedDict[int, Cloud | Corrupt] = OrderedDict()

    def family(self, nodes: Iterable[int]) -> tuple[Family, list[int]]:
        """Give all that these nodes need and that is here, and what is not and must be decoded before, coarse first."""
        own = set(nodes)
        family: Family = {}
        missing: set[int] = set()
        waiting = list(own)
        while waiting:
            for above in ancestors(self._index, waiting.pop()):
                if above in self._clouds:
                    self._clouds.move_to_end(above)
                    family[above] = self._clouds[above]
                elif above not in own and above not in missing:
                    missing.add(above)
                    waiting.append(above)
        return family, sorted(missing)

    def keep(self, family: Family) -> None:
        """Take in what was decoded, as far as it has children."""
        for node, cloud in family.items():
            if node not in self._clouds and (self._index.children[node] >= 0).any():
                self._clouds[node] = cloud
                self._bytes += 0 if isinstance(cloud, Corrupt) else cloud.nbytes
        while self._bytes > self._capacity:
            _, cloud = self._clouds.popitem(last=False)
            self._bytes -= 0 if isinstance(cloud, Corrupt) else cloud.nbytes
