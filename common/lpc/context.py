"""The context of a cloud: the samples of its nearest ancestors that stand where its own do (docs/format.md, Context).

A cloud is decoded after its ancestors, and these have about as many samples in its box as it has itself, on all sides
of each: better company than the samples before it in its own order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from .channels import rows_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from .attributes import Schema
    from .cloud import Cloud
    from .header import Header

Place = tuple[int, int, int]

ANCESTORS = 4
"""Of those further up hardly any sample is near."""
FAST = "fast"
"""The effort of a writer that takes no context."""


def has_context(schema: Schema) -> bool:
    """Whether clouds may be told from their ancestors: normals and colours are."""
    return any(attribute.kind != "scalar" for attribute in schema)


def takes_context(schema: Schema, effort: str) -> bool:
    """Whether our writer tells them so: not where it has to be fast."""
    return effort != FAST and has_context(schema)


def is_told(header: Header) -> bool:
    """Whether clouds of a model may be told so: none is where `packing` says that it was built fast."""
    packing = header.extra.get("packing")
    return has_context(header.attributes) and not (isinstance(packing, dict) and packing.get("effort") == FAST)


def line_of(number: int, parent: Sequence[int] | NDArray[Any]) -> list[int]:
    """Nearest ancestors of a node, from the root down; a root's parent is -1."""
    line = [number]
    while len(line) <= ANCESTORS and parent[line[-1]] >= 0:
        line.append(int(parent[line[-1]]))
    return line[:0:-1]


def with_ancestors(nodes: NDArray[np.int64], parent: NDArray[Any], generations: int) -> NDArray[np.int64]:
    """Give nodes and their nearest ancestors, each once, parents first.

    Parameters
    ----------
    nodes : ndarray, (k,) int64
    parent : ndarray, (n,) of integers
        -1 for the root.
    generations : int
        How many ancestors of each.
    """
    found, line = [nodes], nodes
    while generations and len(line):
        line = np.unique(parent[line])
        line = line[line >= 0].astype(np.int64)
        found.append(line)
        generations -= 1
    return np.unique(np.concatenate(found))


@dataclass(frozen=True, slots=True)
class Near:
    """Samples of a context: local coordinates of the cloud, (3, n) int32, and their guessed channels, (g, n)."""

    position: NDArray[np.int32]
    rows: NDArray[np.uint32]


class Engine(Protocol):
    """What `guess_numpy` and `guess_compiled` both do here."""

    def box(self, position: NDArray[np.uint16]) -> tuple[Place, Place]:
        """Smallest and largest local coordinates of (k, 3)."""

    def take(self, parts: Sequence[Part], schema: Schema) -> Near:
        """Take samples of ancestors, one part after another."""


class Part(NamedTuple):
    """Samples of an ancestor from `low` to `high`, in its local coordinates; those plus `away` are the cloud's."""

    cloud: Cloud
    low: Place
    high: Place
    away: Place


def select(
    clouds: Sequence[Cloud], schema: Schema, *, corner: Place, shift: int, position: NDArray[np.uint16], engine: Engine
) -> Near:
    """Take the samples of ancestors that stand in the box of a cloud.

    Parameters
    ----------
    clouds : sequence of Cloud
        The ancestors, from the root down.
    schema : Schema
    corner, shift
        Of the cloud.
    position : ndarray, (k, 3) uint16
        All its local coordinates without low bits: their box is meant.
    engine : Engine
    """
    clouds, (low, high) = clouds[-ANCESTORS:], engine.box(position)
    if shift or any(cloud.low is not None for cloud in clouds):
        return _select_wide(clouds, schema, corner, shift, low, high)
    parts = []
    for cloud in clouds:
        x, y, z = (int(above) - own for above, own in zip(cloud.origin.tolist(), corner, strict=True))
        least = max(low[0] - x, 0), max(low[1] - y, 0), max(low[2] - z, 0)
        most = min(high[0] - x, 0xFFFF), min(high[1] - y, 0xFFFF), min(high[2] - z, 0xFFFF)
        if least[0] <= most[0] and least[1] <= most[1] and least[2] <= most[2]:
            parts.append(Part(cloud, least, most, (x, y, z)))
    return engine.take(parts, schema)


def _select_wide(clouds: Sequence[Cloud], schema: Schema, corner: Place, shift: int, low: Place, high: Place) -> Near:
    """Do so where low bits are kept apart."""
    places, members = [np.empty((3, 0), np.int32)], []
    for cloud in clouds:
        local = (cloud.lattice() - np.array(corner, np.int64)) >> shift
        index = np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))
        places.append(local[index].T.astype(np.int32))
        members.append((cloud, index))
    return Near(np.concatenate(places, axis=1), rows_of(members, schema))
