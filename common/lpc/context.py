"""The context of a cloud: the samples of its nearest ancestors that stand where its own do (docs/format.md, Context).

A cloud is decoded after its ancestors, and these have about as many samples in its box as it has itself, on all sides
of each: better company than the samples before it in its own order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .channels import rows_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from .attributes import Schema
    from .cloud import Cloud

    Inside = Callable[
        [NDArray[np.uint16], tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]],
        tuple[NDArray[np.int32], NDArray[np.intp]],
    ]

ANCESTORS = 4
"""Of those further up hardly any sample is near."""


def has_context(schema: Schema) -> bool:
    """Whether clouds are told from their ancestors: normals and colours are."""
    return any(attribute.kind != "scalar" for attribute in schema)


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


def select(
    clouds: Sequence[Cloud],
    schema: Schema,
    *,
    corner: tuple[int, int, int],
    shift: int,
    position: NDArray[np.uint16],
    inside: Inside,
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
    inside : callable
        ``inside(position, low, high, away)`` gives the coordinates plus `away` of samples from `low` to `high`, (3, n),
        and their numbers.
    """
    columns = position.T.copy()  # three times as fast as the array as it is
    low, high = columns.min(axis=1).tolist(), columns.max(axis=1).tolist()
    places, members = [np.empty((3, 0), np.int32)], []
    for cloud in clouds[-ANCESTORS:]:
        x, y, z = (int(above) - own for above, own in zip(cloud.origin.tolist(), corner, strict=True))
        if cloud.low is None and shift == 0:
            least = max(low[0] - x, 0), max(low[1] - y, 0), max(low[2] - z, 0)
            most = min(high[0] - x, 0xFFFF), min(high[1] - y, 0xFFFF), min(high[2] - z, 0xFFFF)
            if least[0] > most[0] or least[1] > most[1] or least[2] > most[2]:
                continue
            place, index = inside(cloud.position, least, most, (x, y, z))
        else:
            local = (cloud.lattice() - np.array(corner, np.int64)) >> shift
            index = np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))
            place = local[index].T.astype(np.int32)
        places.append(place)
        members.append((cloud, index))
    return Near(np.concatenate(places, axis=1), rows_of(members, schema))
