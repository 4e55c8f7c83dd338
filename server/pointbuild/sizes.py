"""Sizes of memory as people write them."""

from __future__ import annotations

import re

from lpc.errors import BuildError

LARGEST = 1 << 60
_UNITS = {"": 1, "k": 1 << 10, "m": 1 << 20, "g": 1 << 30, "t": 1 << 40}


def parse_size(text: str) -> int:
    """Bytes of ``2G``, ``600M``, ``1.5GiB`` or a plain number; units are powers of 1,024.

    Raises
    ------
    BuildError
        If it is none of these.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kmgt]?)(?:i?b)?\s*", text, re.IGNORECASE)
    size = 0.0 if match is None else float(match[1]) * _UNITS[match[2].lower()]
    if not 1 <= size <= LARGEST:
        raise BuildError(f"{text!r} is not a size: write 2G, 600M or a number of bytes")
    return int(size)
