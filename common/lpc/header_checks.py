"""What the values of a header may be; every function raises `Corrupt` naming the key (docs/format.md, Header)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .attributes import MAX_ATTRIBUTES, MAX_NAME
from .constants import is_number
from .errors import Corrupt
from .payload import MAX_SAMPLES

if TYPE_CHECKING:
    from .header import Header

MAX_NODES = 2**31 - 1  # numbers of nodes are int32 in memory
MAX_COUNT = 2**53  # counts beyond it are no longer exact in the JSON of other languages
MAX_LEVELS = 256


def check_counts(header: Header) -> None:
    """Whole numbers and the digest."""
    for name, low, high in (
        ("bytes", 1, MAX_COUNT),
        ("samples", 1, MAX_COUNT),
        ("nodes", 1, MAX_NODES),
        ("levels", 1, MAX_LEVELS),
        ("cloud_size", 1, MAX_SAMPLES),
        ("page_nodes", 1, 4096),
        ("seed", -(2**63), 2**64 - 1),
    ):
        value = getattr(header, name)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise Corrupt(f"header: {name} is {str(value)[:40]} (a whole number from {low} to {high} is expected)")
    if header.samples < header.nodes:
        raise Corrupt(f"header: {header.samples} samples are too few for {header.nodes} nodes")
    if header.levels > header.nodes:
        raise Corrupt(f"header: {header.levels} levels are too many for {header.nodes} nodes")
    digest = header.digest
    if not isinstance(digest, str) or len(digest) != 32 or digest.strip("0123456789abcdef"):
        raise Corrupt("header: digest is not 32 hexadecimal digits")


def check_geometry(header: Header) -> None:
    """Lengths and boxes."""
    for name, length in (("origin", 3), ("bounds", 6), ("spacing_ratio", 3)):
        values = getattr(header, name)
        if not isinstance(values, tuple) or len(values) != length or not all(is_number(value) for value in values):
            raise Corrupt(f"header: {name} is not {length} finite numbers")
    for name in ("step", "side", "spacing", "position_error"):
        value = getattr(header, name)
        if not is_number(value) or value < 0:
            raise Corrupt(f"header: {name} is {str(value)[:40]} (a finite length is expected)")
    if not (header.step > 0 and header.side > 0):
        raise Corrupt("header: step and side must be above 0")
    slack = header.position_error + header.side * 2.0**-31 + 1e-9 * max(map(abs, header.bounds))
    for axis in range(3):
        low, high = header.bounds[axis], header.bounds[axis + 3]
        if not low <= high:
            raise Corrupt(f"header: bounds {low} to {high} are empty")
        if low < header.origin[axis] - slack or high > header.origin[axis] + header.side + slack:
            raise Corrupt("header: bounds reach out of the box of origin and side")


def check_attributes(header: Header) -> None:
    """Attributes, constants and everything that is told to people."""
    names = [attribute.name for attribute in header.attributes] + list(header.constants)
    if len(names) > MAX_ATTRIBUTES:
        raise Corrupt(f"header: more than {MAX_ATTRIBUTES} attributes")
    if len(set(names)) != len(names):
        raise Corrupt("header: an attribute is named twice")
    if not all(0 < len(name) <= MAX_NAME for name in names):
        raise Corrupt(f"header: names of attributes have 1 to {MAX_NAME} characters")
    if not (header.crs is None or isinstance(header.crs, str)) or not isinstance(header.generator, str):
        raise Corrupt("header: crs and generator must be text")
    for name, kind in (("left_out", str), ("rejected", int)):
        for key, value in getattr(header, name).items():
            if not isinstance(value, kind) or isinstance(value, bool):
                raise Corrupt(f"header: {name} of {key[:40]} is not a {'text' if kind is str else 'count'}")
    for name in ("bits_per_sample", "attribute_bits"):
        if not all(is_number(value) for value in getattr(header, name).values()):
            raise Corrupt(f"header: {name} are not numbers")
