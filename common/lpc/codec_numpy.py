"""The payload of a cloud in plain numpy: the oracle of the compiled codec, and what runs where numba is missing.

Vectorised over the samples. Prediction is additive, ``value = value of j + residual`` modulo a power of two,
so decoding follows the tree of predecessors by pointer doubling: log2(k) rounds instead of k steps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .guess_numpy import add_guesses as add_guesses
from .guess_numpy import box as box
from .guess_numpy import take as take
from .guess_numpy import without_guesses
from .normals_numpy import best_turn
from .normals_numpy import turn_back as turn_back
from .payload import CONTEXT, RAW_BITS, TOP_BITS, Layout, Packed, Placed, Unpacked, may_flip

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .channels import Channels
    from .context import Near

_SPREAD = ((16, 0x0000FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249))
_GATHER = ((2, 0x0C30C30C30C3), (4, 0x00F00F00F00F), (8, 0x0000FF0000FF), (16, 0xFFFF))
"""Shift and mask per round: from 16 bits side by side to every third of 48, and back."""


def arrange(
    lattice: NDArray[np.int64], rows: NDArray[np.uint32], begin: int, end: int, *, flipping: bool = True
) -> Placed:
    """Put the samples begin to end in the order of the file; `flipping`: flips of axes are tried."""
    points = lattice[begin:end]
    corner = points.min(axis=0)
    local = points - corner
    width = int(local.max()).bit_length()
    shift = max(0, width - TOP_BITS)
    nbits = width - shift
    top = local >> shift
    span = top.max(axis=0)
    rotation = min(range(3), key=lambda turn: _cost(_morton(top, turn)))
    flips = 0
    if flipping and may_flip(corner.tolist(), shift):
        flips = min(range(8), key=lambda flips: _cost(_morton(_flipped(top, span, flips), rotation)))
    code = _morton(_flipped(top, span, flips), rotation)
    order = np.lexsort((*rows[::-1, begin:end], *local.T[::-1], code))
    # The last sample of a flipped axis stands at the end of its range.
    ahead = np.where(flips >> np.arange(3) & 1, (1 << nbits) - 1 - span, 0)
    position = (top[order] + ahead).astype(np.uint16)
    return Placed(rotation, flips, nbits, shift, corner - ahead, order + begin, code[order], position)


def pack(
    placed: Placed,
    lattice: NDArray[np.int64],
    rows: NDArray[np.uint32],
    channels: Channels,
    window: int,
    near: Near | None,
) -> Packed:
    """Pack a cloud; normals and colours are guessed from what is near if that is given."""
    code, shift = placed.code, placed.shift
    rows = rows[:, placed.order]
    low_bits = ((lattice[placed.order] - placed.corner) & ((1 << shift) - 1)).astype(np.uint64).ravel()
    streams = [_pack_bits(low_bits, np.full(low_bits.size, shift, np.int64))] if shift else []
    guessed = channels.guessed_rows if near else []
    window = window if len(guessed) < len(channels) else 0
    before = _nearest(placed.position, window)
    turn = CONTEXT if near else 0
    if not near and len(channels.normals):
        turn, rows = best_turn(rows, before, channels)
    residuals: list[Any] = [
        None if row in guessed else _zigzag(rows[row], before, channels, row) for row in range(len(channels))
    ]
    if near:
        found = without_guesses(placed.position, rows, near, channels, placed.nbits)
        for row, residual in zip(guessed, found, strict=True):
            residuals[row] = residual.astype(np.uint64)
    numbers = [np.diff(code, prepend=np.uint64(0)), *residuals]
    tokens = np.empty((len(numbers), len(code)), np.uint8)
    for stream, number in enumerate(numbers):
        length = _bit_length(number)
        raw = np.maximum(length - 2, 0)
        next_bit = (number >> raw.astype(np.uint64)).astype(np.int64) & 1
        tokens[stream] = np.where(length < 2, number.astype(np.int64), ((length - 1) << 1) | next_bit)
        streams.append(_pack_bits(number & ((np.uint64(1) << raw.astype(np.uint64)) - np.uint64(1)), raw))
    return Packed(placed, turn, window, np.concatenate(streams), tokens)


def decode(payload: bytes, layout: Layout, channels: Channels) -> Unpacked:
    """Unpack a payload that `parse_layout` found true; guessed channels get their residuals, signed."""
    data = np.frombuffer(payload + bytes(8), np.uint8)
    k, starts = layout.samples, layout.starts.tolist()
    tokens = data[layout.tokens : layout.tokens + (1 + len(channels)) * k].reshape(-1, k)

    low = None
    if layout.shift:
        width = np.full(3 * k, layout.shift, np.int64)
        low = _read_bits(data, starts[0], width).astype(np.uint32).reshape(k, 3)
    code = np.cumsum(_numbers(data, starts[1], tokens[0]), dtype=np.uint64)
    position = np.empty((k, 3), np.uint16)
    for slot in range(3):
        axis = (layout.rotation + slot) % 3
        position[:, axis] = _gather(code >> np.uint64(slot))
        if layout.flips >> axis & 1:
            position[:, axis] ^= np.uint16((1 << layout.nbits) - 1)

    rows = np.empty((len(channels), k), np.uint32)
    if len(channels):
        residuals = np.zeros((len(channels), k + 1), np.uint32)  # place 0: before the first sample
        for row in range(len(channels)):
            number = _numbers(data, starts[2 + row], tokens[1 + row]).astype(np.uint32)
            residuals[row, 1:] = (number >> np.uint32(1)) ^ (np.uint32(0) - (number & np.uint32(1)))
        before = _nearest(position, layout.window)
        guessed = channels.guessed_rows if layout.turn == CONTEXT else []
        added = set(range(len(channels))) - set(guessed)
        jump = np.zeros(k + 1, np.intp)
        jump[1:] = np.where(before == 0, 0, np.arange(1, k + 1) - before)
        while added and jump.any():
            for row in added:
                residuals[row] += residuals[row].take(jump)
            jump = jump.take(jump)
        modulo = ((np.int64(1) << channels.bits) - 1).astype(np.uint32)
        rows = (residuals[:, 1:] + channels.start[:, None]) & modulo[:, None]
        rows[guessed] = residuals[guessed, 1:]
    return Unpacked(int(code.max()), position, low, rows)


def _zigzag(row: NDArray[np.uint32], before: NDArray[np.int64], channels: Channels, at: int) -> NDArray[np.uint64]:
    """Residuals of channel `at` as unsigned numbers, small ones first."""
    levels = 1 << int(channels.bits[at])
    value = row.astype(np.int64)
    guess = np.where(before == 0, int(channels.start[at]), value[np.arange(len(value)) - before])
    residual = (value - guess) & (levels - 1)
    return np.where(residual >= levels >> 1, 2 * (levels - residual) - 1, 2 * residual).astype(np.uint64)


def _flipped(top: NDArray[np.int64], span: NDArray[np.int64], flips: int) -> NDArray[np.int64]:
    """Count the axes in `flips` down from their last sample."""
    return np.where(flips >> np.arange(3) & 1, span - top, top)


def _cost(code: NDArray[np.uint64]) -> int:
    """Bits of the differences of codes in order: what rotation and flips of the axes are chosen by."""
    ordered = np.sort(code)
    return int(_bit_length(np.concatenate([ordered[:1], ordered[1:] - ordered[:-1]])).sum())


def _bit_length(number: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Bits of numbers below 2**53."""
    return np.frexp(number.astype(np.float64))[1].astype(np.int64)


def _morton(top: NDArray[np.int64], rotation: int) -> NDArray[np.uint64]:
    """Interleave (n, 3) coordinates below 2**16: bit 3i + s is bit i of axis (rotation + s) mod 3."""
    code = np.zeros(len(top), np.uint64)
    for slot in range(3):
        spread = top[:, (rotation + slot) % 3].astype(np.uint64)
        for by, mask in _SPREAD:
            spread = (spread | (spread << np.uint64(by))) & np.uint64(mask)
        code |= spread << np.uint64(slot)
    return code


def _gather(code: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Every third bit of 48-bit codes, closed up: undoes one axis of `_morton`."""
    code = code & np.uint64(0x249249249249)
    for by, mask in _GATHER:
        code = (code | (code >> np.uint64(by))) & np.uint64(mask)
    return code


def _nearest(top: NDArray[Any], window: int) -> NDArray[np.int64]:
    """How far back in order the nearest of the previous `window` samples stands (L1); 0: there is none."""
    k = len(top)
    if window == 0:
        return np.zeros(k, np.int64)
    padded = np.full((3, window + k), -(1 << 25), np.int32)  # far away: L1 distances stay below 3 * 2**22
    padded[:, window:] = top.T
    padded[:, window:] <<= 6  # leaves room for how far back
    best = np.full(k, np.iinfo(np.int32).max, np.int32)
    gap = np.empty((3, k), np.int32)
    x, y, z = gap
    for back in range(window):
        np.subtract(padded[:, window:], padded[:, window - 1 - back : -1 - back], out=gap)
        np.abs(gap, out=gap)
        x += y
        x += z
        x += back
        np.minimum(best, x, out=best)
    before = (best & 63).astype(np.int64) + 1
    before[:1] = 0
    return before


def _pack_bits(number: NDArray[np.uint64], width: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Write numbers of `width` bits one after another, least significant bit first, padded to a byte."""
    end = np.cumsum(width)
    place = np.arange(end[-1])
    which = np.searchsorted(end, place, side="right")
    bit = (number[which] >> (place - (end - width)[which]).astype(np.uint64)) & np.uint64(1)
    return np.packbits(bit.astype(np.uint8), bitorder="little")


def _read_bits(data: NDArray[np.uint8], start: int, width: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Read numbers of `width` bits, at most 57 each, from byte `start` on."""
    place = np.cumsum(width) - width
    words = np.ndarray(len(data) - 7, "<u8", data.data, 0, (1,))  # the 8 bytes at every byte
    word = words[start + (place >> 3)] >> (place & 7).astype(np.uint64)
    return word & ((np.uint64(1) << width.astype(np.uint64)) - np.uint64(1))


def _numbers(data: NDArray[np.uint8], start: int, tokens: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Numbers from their tokens and the raw stream at byte `start`."""
    width = RAW_BITS[tokens]
    raw = _read_bits(data, start, width.astype(np.int64))
    lead = np.where(tokens < 2, tokens, 2 | (tokens & 1)).astype(np.uint64)
    return (lead << width.astype(np.uint64)) | raw
