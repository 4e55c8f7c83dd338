"""Normals and colours guessed from the context of a cloud, in plain numpy: the oracle of `guess_compiled`.

A sample's *company* are context samples that stand beside it in two orders of space, and, for three samples of four,
two of its own cloud that are decoded before it. Near ones weigh more. Only integers (docs/format.md, Context).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .channels import rows_of
from .context import Near
from .octahedral import fold_codes, unfold_codes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from .attributes import Schema
    from .channels import Channels
    from .context import Part, Place

    Ints = NDArray[np.int32]

KEPT = 7
"""Bits of a coordinate that the orders look at: a step is then finer than the samples of a cloud are dense."""
MOST = 64
"""Weight of the nearest."""
LAYERS = ((0, 4), (2, 4), (1, 2))
"""First sample and step of those that are decoded together; their neighbours are decoded before."""

_TURNS = np.array([[1, 2, 0], [2, 0, 1], [0, 1, 2]])
"""Which axes stand first, second and third, seen along each of the three."""
_SPREAD = np.array([sum((value >> bit & 1) << (3 * bit) for bit in range(8)) for value in range(256)], np.int32)


def box(position: NDArray[np.uint16]) -> tuple[Place, Place]:
    """Smallest and largest local coordinates of (k, 3)."""
    columns = position.T.copy()  # three times as fast as the array as it is
    low, high = columns.min(axis=1).tolist(), columns.max(axis=1).tolist()
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def take(parts: Sequence[Part], schema: Schema) -> Near:
    """Take samples of ancestors, one part after another."""
    places, members = [np.empty((3, 0), np.int32)], []
    for cloud, low, high, away in parts:
        columns = cloud.position.T.copy()
        # Below `low` a difference wraps around: one comparison sees both ends.
        columns -= np.array(low, np.uint16)[:, None]
        outside = columns > np.array(high, np.uint16)[:, None] - np.array(low, np.uint16)[:, None]
        index = np.flatnonzero(~(outside[0] | outside[1] | outside[2]))
        place = np.empty((3, len(index)), np.int32)
        for column, least, add, out in zip(columns, low, away, place, strict=True):
            np.add(column.take(index), np.int32(least + add), out=out)
        places.append(place)
        members.append((cloud, index))
    return Near(np.concatenate(places, axis=1), rows_of(members, schema))


def add_guesses(
    position: NDArray[np.uint16], rows: NDArray[np.uint32], near: Near, channels: Channels, nbits: int
) -> None:
    """Turn the residuals of guessed channels, signed in uint32, into codes, in place."""
    sums, total, left, right = _company(position, near, channels, nbits)
    k = len(position)
    values = np.empty((len(sums), k), np.int32)
    for layer in LAYERS:
        part = slice(layer[0], None, layer[1])
        _add_neighbours(values, layer, left, right, sums, total)
        for field, (first, normal, bits) in enumerate(channels.guessed.tolist()):
            three = slice(3 * field, 3 * field + 3)
            if normal:
                residual = rows[first : first + 2, part].view(np.int32)
                values[three, part], codes = _add_normal(sums[three, part], residual, bits)
                rows[first : first + 2, part] = codes
            else:
                residual = rows[first : first + 3, part].view(np.int32)
                codes = (_mean(sums[three, part], total[part]) + residual).view(np.uint32) & _masks(bits)
                rows[first : first + 3, part] = codes
                values[three, part] = _signed(codes, bits)
    for field, (first, normal, bits) in enumerate(channels.guessed.tolist()):
        if normal:
            centre = (1 << (bits - 1)) - 1
            point = values[3 * field : 3 * field + 3]
            sound = rows[first : first + 2].max() <= 2 * centre
            rows[first : first + 2] = np.where(point.any(axis=0), fold_codes(point, centre), 0)
            if not sound:  # a mark that is found
                rows[first] = (1 << bits) - 1


def without_guesses(
    position: NDArray[np.uint16], rows: NDArray[np.uint32], near: Near, channels: Channels, nbits: int
) -> NDArray[np.uint32]:
    """Residuals of guessed channels, zigzag, (g, k)."""
    sums, total, left, right = _company(position, near, channels, nbits)
    values = _values(rows[channels.guessed_rows], channels)
    for layer in LAYERS:
        _add_neighbours(values, layer, left, right, sums, total)
    found = []
    for field, (_, normal, bits) in enumerate(channels.guessed.tolist()):
        three = slice(3 * field, 3 * field + 3)
        if normal:
            centre = (1 << (bits - 1)) - 1
            places, sign, guess = _guess_normal(sums[three], centre)
            point = values[three].reshape(-1).take(places)
            point[2] *= sign
            codes = np.where(point.any(axis=0), fold_codes(point, centre), 0)
            residual = (codes - guess - np.int32(centre)) & ((1 << bits) - 1)
            found.append(_zigzag(residual, np.array([[bits], [bits]])))
        else:
            residual = (values[three] - _mean(sums[three], total)).view(np.uint32) & _masks(bits)
            found.append(_zigzag(residual, np.array([[bits], [bits + 1], [bits + 1]])))
    return np.concatenate(found)


def _company(position: NDArray[np.uint16], near: Near, channels: Channels, nbits: int) -> tuple[Ints, Ints, Ints, Ints]:
    """Weighted sums over the context (3 f, k), their weight (k,), and the weights of left and right neighbours."""
    place = position.T.astype(np.int32, order="C")
    company = _beside(near.position, place, nbits)
    k, n = len(position), near.position.shape[1]
    # Squared distances of 11 bits are exact in 24 bits, of 16 bits in 53. Who is missing is far away and worth nothing.
    real: Any
    whole: Any
    real, whole, cut = (np.float32, np.int32, 22) if nbits <= 11 else (np.float64, np.int64, 51)
    distance = np.full((10, k), 1e30, real)
    padded = np.full((3, n + 1), 1e15, real)
    padded[:, :n] = near.position
    gap = np.empty((8, k), real)
    for axis in range(3):
        np.take(padded[axis], company, out=gap, mode="clip")
        gap -= place[axis]
        gap *= gap
        if axis == 0:
            distance[:8] = gap
        else:
            distance[:8] += gap
    for start, step in LAYERS[1:]:
        here = place[:, start::step]
        for which, beside in ((8, place[:, 0 :: 2 * start]), (9, place[:, 2 * start :: 2 * start])):
            count = min(here.shape[1], beside.shape[1])
            away = (here[:, :count] - beside[:, :count]).astype(real)
            away *= away
            distance[which, start::step][:count] = away.sum(axis=0)
    distance += real(1)
    size = distance.view(whole) >> cut  # two steps to a factor of 2
    size -= size.min(axis=0)
    np.minimum(size, 7, out=size)
    weight = np.int32(MOST) >> size.astype(np.int32, copy=False)
    known = np.zeros((3 * len(channels.guessed), n + 1), np.int32)
    known[:, :n] = _values(near.rows, channels)
    sums = np.empty((len(known), k), np.int32)
    for value, into in zip(known, sums, strict=True):
        np.einsum("ck,ck->k", value.take(company, mode="clip"), weight[:8], out=into)
    return sums, weight[:8].sum(axis=0, dtype=np.int32), weight[8], weight[9]


def _beside(near: Ints, place: Ints, nbits: int) -> NDArray[np.intp]:
    """Numbers of the context samples before and after each sample in two orders, (8, k); n: there is none."""
    k, n = place.shape[1], near.shape[1]
    both = np.concatenate([place, near], axis=1)  # samples stand before a context of the same code
    number = np.arange(k + n)
    found = []
    for order in range(2):
        cell = (both + order * ((1 << nbits) // 3)) >> max(0, nbits - KEPT)
        code = _SPREAD.take(cell[0]) | (_SPREAD.take(cell[1]) << 1) | (_SPREAD.take(cell[2]) << 2)
        key = (code.astype(np.int64) << 32) | number
        key.sort()
        key &= 0xFFFFFFFF
        line = np.full(n + 4, n, np.intp)
        line[2:-2] = key[key >= k] - k
        at = np.flatnonzero(key < k)
        after = np.empty(k, np.intp)
        after[key[at]] = at - number[:k]
        found += [line.take(after + beside) for beside in range(4)]
    return np.stack(found)


def _add_neighbours(values: Ints, layer: tuple[int, int], left: Ints, right: Ints, sums: Ints, total: Ints) -> None:
    """Add what samples of a layer have in their neighbours in the cloud."""
    start, step = layer
    if not start:
        return
    for weights, begin in ((left, 0), (right, 2 * start)):
        beside = values[:, begin :: 2 * start]
        weight = weights[start::step][: beside.shape[1]]
        count = len(weight)
        sums[:, start::step][:, :count] += beside[:, :count] * weight
        total[start::step][:count] += weight


def _values(rows: NDArray[np.uint32], channels: Channels) -> Ints:
    """Three signed numbers of each field: the point of a normal, 0 for none, or a colour's YCoCg-R."""
    found, at = [], 0
    for _, normal, bits in channels.guessed.tolist():
        if normal:
            codes = rows[at : at + 2]
            found.append(np.where(codes.any(axis=0), unfold_codes(codes, (1 << (bits - 1)) - 1), 0))
            at += 2
        else:
            found.append(_signed(rows[at : at + 3], bits))
            at += 3
    return np.concatenate(found).astype(np.int32, copy=False)


def _signed(codes: NDArray[np.uint32], bits: int) -> Ints:
    """Luma as it is, chroma with its sign."""
    values = codes.astype(np.int32)
    values[1:] -= (values[1:] & (1 << bits)) << 1
    return values


def _masks(bits: int) -> NDArray[np.uint32]:
    low = (1 << bits) - 1
    return np.array([[low], [2 * low + 1], [2 * low + 1]], np.uint32)


def _guess_normal(sums: Ints, centre: int) -> tuple[NDArray[np.intp], Ints, Ints]:
    """See sums along the axis of which they have most: where its numbers stand, its sign, and the guess (2, n)."""
    size = np.abs(sums)
    largest = (size[1] > size[0]).astype(np.intp)
    largest[size[2] > np.maximum(size[0], size[1])] = 2
    places = _TURNS.take(largest, axis=1)
    places *= sums.shape[1]
    places += np.arange(sums.shape[1])
    seen = sums.reshape(-1).take(places)
    length = np.maximum(size.sum(axis=0), 1).astype(np.float64)
    # Numbers below 2**53, quotients below 2**16: cutting the float cuts the quotient.
    share = seen[:2] * (2.0 * centre)
    share += np.copysign(length, share)
    share /= length * 2
    return places, (seen[2] >> 31) | np.int32(1), share.astype(np.int32)


def _add_normal(sums: Ints, residual: Ints, bits: int) -> tuple[Ints, NDArray[np.uint32]]:
    """Points of normals, and their codes along the axis of the guess."""
    centre = (1 << (bits - 1)) - 1
    places, sign, seen = _guess_normal(np.ascontiguousarray(sums), centre)
    seen += residual
    codes = (seen + np.int32(centre)) & np.int32((1 << bits) - 1)
    seen = codes - np.int32(centre)
    size = np.abs(seen)
    third = centre - size[0] - size[1]
    folded = (centre - size[::-1]) * ((seen >> 31) | np.int32(1))
    point = np.empty(sums.shape, np.int32)
    flat = point.reshape(-1)
    flat[places[:2]] = np.where(third < 0, folded, seen)
    flat[places[2]] = third * sign
    none = (codes[0] | codes[1]) == 0
    if none.any():
        point[:, none] = 0
    return point, codes.view(np.uint32)


def _mean(sums: Ints, total: Ints) -> Ints:
    """Means rounded to the nearest, halves up; 0 where there is nothing."""
    weight = np.maximum(total, 1).astype(np.float64)
    return np.floor((2.0 * sums + weight) / (2 * weight)).astype(np.int32)


def _zigzag(residual: Any, bits: Any) -> NDArray[np.uint32]:
    """Residuals modulo ``2**bits`` as unsigned numbers, small ones first."""
    levels = np.int64(1) << bits
    wide = residual.astype(np.int64)
    return np.where(wide >= levels >> 1, 2 * (levels - wide) - 1, 2 * wide).astype(np.uint32)
