"""What each number of a sample costs in a model: the header's `bits_per_sample` and `attribute_bits`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import zstandard

from lpc.channels import channels_of
from lpc.header import seal
from lpc.payload import parse_layout

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.attributes import Schema
    from lpc.header import Header

DIGITS = (4, 5, 6, 7, 8, 9, 10, 3, 2)
"""Decimals of the parts, in the order in which they are tried."""
EXACT = 9
"""Decimals of what is stated to the end."""
ROUNDS = 8
"""In which a length settles, or never."""

_BLOCK_HEADER = 3
_LARGEST_BLOCK = 1 << 17


def cloud_costs(frame: bytes, samples: int, schema: Schema) -> NDArray[np.float64]:
    """Bytes of one cloud: of the positions, then of each attribute; what no stream owns counts as position.

    The codec ends a zstd block after all raw bits, after the tokens of positions and after those of each group of
    channels: sizes of blocks (RFC 8878, 3.1.1.2) say what tokens cost, and lengths of raw streams what raw bits do.
    """
    channels = channels_of(schema)
    layout = parse_layout(zstandard.ZstdDecompressor().decompress(frame), samples=samples, channels=channels)
    raw = np.diff(np.append(layout.starts, layout.tokens)).astype(float)
    pieces = [layout.tokens, samples, *(samples * (stop - first) for first, stop in channels.groups)]
    stored = _stored(frame, pieces)
    owners = np.repeat(np.arange(len(schema)), [len(channels_of((attribute,))) for attribute in schema])
    costs = np.zeros(1 + len(schema))
    for owner, size in zip(owners, raw[2:], strict=True):
        costs[1 + owner] += size * stored[0] / pieces[0]
    for (first, _), size in zip(channels.groups, stored[2:], strict=True):
        costs[1 + owners[first]] += size
    costs[0] = len(frame) - costs.sum()
    return costs


def bits_of(
    header: Header, parts: NDArray[np.float64], cloud_bytes: int, *, digits: int = DIGITS[0]
) -> tuple[dict[str, float], dict[str, float]]:
    """Scale the costs of some clouds to the whole file: bits a sample by kind, and by attribute.

    What is no cloud is ``index``: the pages and the header. Positions take what the rounding of the others leaves, so
    that the parts add up to the total.

    Parameters
    ----------
    header : Header
    parts : ndarray
        Summed `cloud_costs` of some clouds.
    cloud_bytes : int
        Of all clouds.
    digits : int
        Decimals of the parts; position and total have more.
    """
    scale = 8 * cloud_bytes / header.samples / float(parts.sum())
    costs = zip(header.attributes, parts[1:].tolist(), strict=True)
    attributes = {attribute.name: round(part * scale, digits) for attribute, part in costs}
    index = round(8 * (header.bytes - cloud_bytes) / header.samples, digits)
    kinds = dict.fromkeys(("position", "normal", "color", "other"), 0.0)
    for attribute in header.attributes:
        kind = "other" if attribute.kind == "scalar" else attribute.kind
        kinds[kind] = round(kinds[kind] + attributes[attribute.name], digits)
    total = 8 * header.bytes / header.samples
    kinds["position"] = round(total - index - sum(kinds.values()), EXACT)
    return kinds | {"index": index, "total": total}, attributes


def seal_with_costs(header: Header, records: NDArray[Any], parts: NDArray[np.float64], cloud_bytes: int) -> Header:
    """Seal a header that states what its own file costs a sample, itself included.

    Digits of the numbers lengthen the header, which changes the numbers. Where no length states itself, some more
    decimals of the parts find one.
    """
    for digits in DIGITS:
        sealed = seal(header, records)
        for _ in range(ROUNDS):
            bits, attributes = bits_of(sealed, parts, cloud_bytes, digits=digits)
            if bits == sealed.bits_per_sample:
                return sealed
            sealed = seal(replace(header, bits_per_sample=bits, attribute_bits=attributes), records)
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
