"""Files that a server takes for models: a true header, and noise where pages and clouds would be."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import TYPE_CHECKING

from lpc.attributes import Attribute
from lpc.header import Header

if TYPE_CHECKING:
    from pathlib import Path

HEADER = Header(
    bytes=10_000,
    samples=1_234_567,
    nodes=3,
    levels=2,
    cloud_size=2048,
    page_nodes=64,
    origin=(0.0, 0.0, 0.0),
    step=0.001,
    side=4.0,
    bounds=(0.0, 0.5, 1.0, 2.0, 3.0, 4.0),
    spacing=0.01,
    position_error=0.001,
    attributes=(Attribute(name="color", kind="color", dtype="|u1", bits=8),),
    crs='PROJCRS["OSGB36 / <British> National Grid",BASEGEOGCRS[]]',
    bits_per_sample={"total": 21.5},
)


def make_model(path: Path, size: int = 10_000, seed: int = 0) -> bytes:
    """Write a file with a true header and noise behind it: all that a server looks at. Returns its bytes."""
    digest = hashlib.blake2b(f"{size} {seed}".encode(), digest_size=16).hexdigest()
    head = replace(HEADER, bytes=size, digest=digest).to_bytes()
    noise = hashlib.shake_128(digest.encode()).digest(size - len(head))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(head + noise)
    return head + noise
