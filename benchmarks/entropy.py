"""How far the codec is from the entropy of its own streams: ``python benchmarks/entropy.py FOLDER [NAME...]``.

Clouds are made as ``codec.py`` makes them. Numbers are stored as tokens and raw bits; raw bits are taken for noise, and
tokens for draws from one distribution a stream (order 0): that of the cloud itself, whose table would have to be known
for nothing, or that of all clouds of the scan, which one table in the header could tell. Bits a sample.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

import asked
import numpy as np
import zstandard
from codec import OBJECTS, Scan, stream_bits

from lpc.channels import channels_of
from lpc.payload import RAW_BITS, parse_layout

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.attributes import Schema
    from lpc.codec import Effort

NAMES = ("position", "normal", "color")


def streams(frame: bytes, samples: int, schema: Schema) -> dict[str, list[NDArray[np.uint8]]]:
    """Tokens of each stream that has statistics of its own, by what they are of."""
    channels = channels_of(schema)
    payload = zstandard.ZstdDecompressor().decompress(frame)
    layout = parse_layout(payload, samples=samples, channels=channels)
    tokens = np.frombuffer(payload, np.uint8, offset=layout.tokens).reshape(-1, samples)
    found = {"position": [tokens[0]]}
    for first, stop in channels.groups:
        found.setdefault("normal" if first == 0 else "color", []).append(tokens[1 + first : 1 + stop].ravel())
    return found


def entropy(counts: NDArray[np.int64]) -> float:
    """Bits of all draws together, if each takes what its frequency allows."""
    some = counts[counts > 0]
    return float(-(some * np.log2(some / some.sum())).sum())


def measure(path: Path, size: int, effort: Effort, with_color: bool) -> None:
    scan = Scan.of(path, size, with_color)
    schema, samples = scan.schema, len(scan.lattice)
    stored, own, raw = defaultdict(float), defaultdict(float), defaultdict(float)
    pooled: dict[tuple[str, int], NDArray[np.int64]] = defaultdict(lambda: np.zeros(256, np.int64))
    for frame, count in zip(scan.encode(effort), np.diff(scan.bounds).tolist(), strict=True):
        for name, bits in stream_bits(frame, count, schema).items():
            stored[name] += bits
        for name, parts in streams(frame, count, schema).items():
            for number, tokens in enumerate(parts):
                counts = np.bincount(tokens, minlength=256)
                own[name] += entropy(counts)
                raw[name] += float(RAW_BITS[tokens].sum(dtype=np.int64))
                pooled[name, number] += counts
    shared = {name: sum(entropy(counts) for (kind, _), counts in pooled.items() if kind == name) for name in NAMES}
    total = sum(stored.values())
    for kind, values in (
        ("stored", stored),
        ("cloud", {name: own[name] + raw[name] for name in NAMES}),
        ("scan", {name: shared[name] + raw[name] for name in NAMES}),
        ("raw", raw),
    ):
        parts = [values.get(name, 0.0) / samples for name in NAMES]
        most = sum(values.values())
        print(
            f"{path.name if kind == 'stored' else '':24} {kind:>8} "
            + " ".join(f"{part:8.2f}" for part in parts)
            + f" {most / samples:8.2f}"
            + (f" {100 * (total / most - 1):7.1f} %" if kind in ("cloud", "scan") else "")
        )


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", default=OBJECTS)
    parser.add_argument("--cloud-size", type=int, default=2048)
    parser.add_argument("--effort", default="default", choices=["default", "best", "fast"])
    parser.add_argument("--color", action="store_true", help="colours, too, where the scan has them")
    options = parser.parse_args()
    print(f"{'scan':24} {'':>8} " + " ".join(f"{name:>8}" for name in (*NAMES, "total")) + "  stored above")
    for name in options.names:
        measure(options.folder / name, options.cloud_size, options.effort, options.color)


if __name__ == "__main__":
    main()
