"""What each kind of number costs in a model: the header's `bits_per_sample`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import zstandard

from lpc.channels import channels_of
from lpc.header import seal
from lpc.payload import parse_layout

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from lpc.attributes import Schema
    from lpc.header import Header

KINDS = ("position", "normal", "color", "other")

DIGITS = (4, 5, 6, 7, 8, 9, 10, 3, 2)
"""Decimals of the parts, in the order in which they are tried."""
ROUNDS = 8
"""In which a length settles, or never."""

_BLOCK_HEADER = 3
_LARGEST_BLOCK = 1 << 17


def cloud_costs(frame: bytes, samples: int, schema: Schema) -> dict[str, float]:
    """Bytes of one cloud by `KINDS`; what no stream owns counts as position.

    The codec ends a zstd block after all raw bits, after the tokens of positions and after those of each group of
    channels: sizes of blocks (RFC 8878, 3.1.1.2) say what tokens cost, and lengths of raw streams what raw bits do.
    """
    channels = channels_of(schema)
    layout = parse_layout(zstandard.ZstdDecompressor().decompress(frame), samples=samples, channels=channels)
    raw = np.diff(np.append(layout.starts, layout.tokens)).astype(float)
    pieces = [layout.tokens, samples, *(samples * (stop - first) for first, stop in channels.groups)]
    stored = _stored(frame, pieces)
    owners = [
        attribute.kind if attribute.kind in KINDS else "other"
        for attribute in schema
        for _ in range(len(channels_of((attribute,))))
    ]
    costs = dict.fromkeys(KINDS, 0.0)
    for owner, size in zip(owners, raw[2:], strict=True):
        costs[owner] += size * stored[0] / pieces[0]
    for (first, _), size in zip(channels.groups, stored[2:], strict=True):
        costs[owners[first]] += size
    costs["position"] = len(frame) - sum(costs.values())
    return costs


def bits_per_sample(
    parts: Mapping[str, float], cloud_bytes: int, file_bytes: int, samples: int, *, digits: int = DIGITS[0]
) -> dict[str, float]:
    """Scale the costs of some clouds to the whole file; what is no cloud is ``index``: the pages and the header.

    Parameters
    ----------
    parts : mapping
        Summed `cloud_costs` of some clouds.
    cloud_bytes, file_bytes : int
        Of all clouds and of the file.
    samples : int
    digits : int
        Decimals of the parts; the total has all.
    """
    scale = 8 * cloud_bytes / samples / sum(parts.values())
    bits = {name: float(parts[name]) * scale for name in KINDS}
    bits["index"] = 8 * (file_bytes - cloud_bytes) / samples
    return {name: round(value, digits) for name, value in bits.items()} | {"total": 8 * file_bytes / samples}


def seal_with_costs(header: Header, records: NDArray[Any], parts: Mapping[str, float], cloud_bytes: int) -> Header:
    """Seal a header that states what its own file costs a sample, itself included.

    Digits of the numbers lengthen the header, which changes the numbers. Where no length states itself, some more
    decimals of the parts find one.
    """
    for digits in DIGITS:
        sealed = seal(header, records)
        for _ in range(ROUNDS):
            bits = bits_per_sample(parts, cloud_bytes, sealed.bytes, header.samples, digits=digits)
            if bits == sealed.bits_per_sample:
                return sealed
            sealed = seal(replace(header, bits_per_sample=bits), records)
    return sealed


def _stored(frame: bytes, pieces: list[int]) -> list[float]:
    """Find the stored bytes of pieces that were compressed one after another, each ending a block."""
    sizes = _blocks(frame)
    counts = [-(-int(piece) // _LARGEST_BLOCK) for piece in pieces]
    if len(sizes) - sum(counts) not in (0, 1):  # zstd split blocks further: share alike
        return [piece * sum(sizes) / sum(pieces) for piece in pieces]
    ends = np.cumsum(counts)
    return [float(sum(sizes[end - count : end])) for end, count in zip(ends, counts, strict=True)]


def _blocks(frame: bytes) -> list[int]:
    """Sizes of the blocks of a zstd frame, their headers included."""
    at, sizes, last = zstandard.frame_header_size(frame), [], False
    while not last:
        word = int.from_bytes(frame[at : at + _BLOCK_HEADER], "little")
        last, repeated = bool(word & 1), (word >> 1 & 3) == 1
        sizes.append(_BLOCK_HEADER + (1 if repeated else word >> 3))
        at += sizes[-1]
    return sizes
