"""The payload of a cloud: its header, its sizes, and every check that makes decoding it safe.

Both decoders index without looking, the compiled one by necessity. `parse_layout` is the one place that
proves a payload harmless first (docs/format.md, Cloud).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .errors import Corrupt

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .channels import Channels

CODEC = 2
HEADER = struct.Struct("<BBBBBBB")
MAX_SAMPLES = 1 << 20
MAX_WINDOW = 64
MAX_CORNER_BYTES = 7
TURNS = 6
CONTEXT = 6
"""In place of a turn: normals and colours are guessed from the context."""
TOP_BITS = 16
MAX_SHIFT = 32
ORIGIN_LIMIT = 1 << 52
"""Lattice coordinates stay below this, so float64 holds them exactly."""

RAW_BITS = np.array([0, 0] + [(token >> 1) - 1 for token in range(2, 256)], np.uint8)
"""Raw bits that follow a token."""


def may_flip(corner: list[int], shift: int) -> bool:
    """Whether a writer may flip axes: it moves the corner back by less than 2**16, which must not leave the lattice."""
    return shift == 0 and min(corner) > (1 << TOP_BITS) - ORIGIN_LIMIT


class Placed(NamedTuple):
    """The samples of a cloud in the order of the file.

    Parameters
    ----------
    rotation, flips, nbits, shift : int
    corner : ndarray, (3,) int64
    order : ndarray, (k,) of integers
        Sample numbers.
    code : ndarray, (k,) uint64
    position : ndarray, (k, 3) uint16
    """

    rotation: int
    flips: int
    nbits: int
    shift: int
    corner: NDArray[np.int64]
    order: NDArray[Any]
    code: NDArray[np.uint64]
    position: NDArray[np.uint16]


class Packed(NamedTuple):
    """What an encoder gives: the parts of a payload.

    `raw` are the padded bit streams, `tokens` is (1 + c, k) uint8: position, then the channels.
    """

    placed: Placed
    turn: int
    window: int
    raw: NDArray[np.uint8]
    tokens: NDArray[np.uint8]


class Unpacked(NamedTuple):
    """What a decoder gives.

    `largest` is the largest Morton code met, `position` (k, 3) uint16, `low` (k, 3) uint32 or None,
    `rows` (c, k) uint32, normals still turned.
    """

    largest: int
    position: NDArray[np.uint16]
    low: NDArray[np.uint32] | None
    rows: NDArray[np.uint32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """A payload header that was found true, and where the streams lie.

    Parameters
    ----------
    samples, rotation, flips, turn, nbits, shift, origin, window
        As in docs/format.md.
    starts : ndarray, (2 + c,) int64
        Byte offsets of the raw streams in the payload: low bits, position, channels.
    tokens : int
        Byte offset of the first token.
    """

    samples: int
    rotation: int
    flips: int
    turn: int
    nbits: int
    shift: int
    origin: tuple[int, int, int]
    window: int
    starts: NDArray[np.int64]
    tokens: int


def pack_header(packed: Packed) -> bytes:
    """Return the bytes before the raw streams."""
    placed = packed.placed
    corners = placed.corner.tolist()
    corner_bytes = max((corner ^ (corner >> 63)).bit_length() // 8 + 1 for corner in corners)
    axes = placed.rotation | placed.flips << 2
    head = HEADER.pack(CODEC, axes, placed.nbits, placed.shift, packed.window, packed.turn, corner_bytes)
    return head + b"".join(corner.to_bytes(corner_bytes, "little", signed=True) for corner in corners)


def largest_payload(samples: int, channels: Channels) -> int:
    """Bytes that no payload of so many samples can exceed."""
    raw = 3 * MAX_SHIFT + 3 * TOP_BITS - 2 + int(np.maximum(channels.bits - 2, 0).sum())
    return (
        HEADER.size
        + 3 * MAX_CORNER_BYTES
        + 2
        + len(channels)
        + (samples * raw + 7) // 8
        + samples * (1 + len(channels))
    )


def parse_layout(payload: bytes, *, samples: int, channels: Channels) -> Layout:
    """Prove that a payload can be decoded without looking.

    Parameters
    ----------
    payload : bytes
    samples : int
        As the node's record says.
    channels : Channels

    Returns
    -------
    Layout
        Every stream it names lies inside the payload, and no token asks for more bits than its channel has.

    Raises
    ------
    Corrupt
    """
    streams = 1 + len(channels)
    if len(payload) < HEADER.size + streams * samples:
        raise Corrupt(f"cloud: {len(payload)} bytes cannot hold {samples} samples")
    codec, axes, nbits, shift, window, turn, corner_bytes = HEADER.unpack_from(payload)
    if codec != CODEC:
        raise Corrupt(f"cloud: codec {codec} is unknown")
    rotation, flips = axes & 3, axes >> 2
    if rotation > 2 or flips > 7 or turn > CONTEXT or window > MAX_WINDOW or corner_bytes > MAX_CORNER_BYTES:
        raise Corrupt(f"cloud: its header {payload[: HEADER.size].hex()} is out of range")
    if nbits > TOP_BITS or shift > MAX_SHIFT or (shift and nbits < TOP_BITS):
        raise Corrupt(f"cloud: {nbits} + {shift} bits a coordinate are not allowed")
    head = HEADER.size + 3 * corner_bytes
    if len(payload) < head + streams * samples:
        raise Corrupt(f"cloud: {len(payload)} bytes cannot hold {samples} samples")
    x, y, z = (
        int.from_bytes(payload[at : at + corner_bytes], "little", signed=True)
        for at in (HEADER.size, HEADER.size + corner_bytes, HEADER.size + 2 * corner_bytes)
    )
    extent = 1 << (nbits + shift)
    if not all(corner > -ORIGIN_LIMIT and corner + extent < ORIGIN_LIMIT for corner in (x, y, z)):
        raise Corrupt("cloud: its corner is outside the lattice")

    tokens = np.frombuffer(payload, np.uint8, offset=len(payload) - streams * samples).reshape(streams, samples)
    bits = np.concatenate(([3 * nbits], channels.bits))
    if (tokens.max(axis=1) > np.maximum(2 * bits - 1, 0)).any():
        raise Corrupt("cloud: a token asks for more bits than its channel has")
    raw_bits = np.concatenate(([3 * shift * samples], RAW_BITS[tokens].sum(axis=1, dtype=np.int64)))
    ends = head + np.cumsum((raw_bits + 7) >> 3)
    if ends[-1] + streams * samples != len(payload):
        raise Corrupt(f"cloud: {len(payload)} bytes, its tokens ask for {ends[-1] + streams * samples}")
    starts = np.concatenate(([head], ends[:-1]))
    return Layout(
        samples=samples, rotation=rotation, flips=flips, turn=turn, nbits=nbits, shift=shift, origin=(x, y, z),
        window=window, starts=starts, tokens=int(ends[-1]),
    )  # fmt: skip
