"""What each kind of number costs in a model: the header's `bits_per_sample`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import zstandard

from lpc.channels import channels_of
from lpc.payload import parse_layout

if TYPE_CHECKING:
    from collections.abc import Mapping

    from lpc.attributes import Schema

KINDS = ("position", "normal", "color", "other")

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


def bits_per_sample(parts: Mapping[str, float], cloud_bytes: int, index_bytes: int, samples: int) -> dict[str, float]:
    """Scale the costs of some clouds to the whole file.

    Parameters
    ----------
    parts : mapping
        Summed `cloud_costs` of some clouds.
    cloud_bytes, index_bytes : int
        Of all clouds and of all pages.
    samples : int
    """
    scale = 8 * cloud_bytes / samples / sum(parts.values())
    bits = {name: parts[name] * scale for name in KINDS}
    bits["index"] = 8 * index_bytes / samples
    bits["total"] = sum(bits.values())
    return {name: round(float(value), 4) for name, value in bits.items()}


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
