"""What `info` and `build` print of a model: the one mapping from a header to the contract's keys; and its words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .header import MAJOR
from .octahedral import max_error_degrees

if TYPE_CHECKING:
    from .attributes import Attribute
    from .header import Header


def info_dict(header: Header) -> dict[str, Any]:
    """Describe a whole model in plain values, ready for JSON.

    Parameters
    ----------
    header : Header

    Returns
    -------
    dict
        Lengths in model units; ``bounds`` is [min xyz, max xyz], ``attributes`` the names that `export` writes,
        ``here`` what is there of a file that may be cut short.
    """
    return {
        "format": f"lpc {MAJOR}",
        "complete": True,
        "samples": header.samples,
        "clouds": header.nodes,
        "levels": header.levels,
        "cloud_size": header.cloud_size,
        "here": {"samples": header.samples, "clouds": header.nodes},
        "bytes": header.bytes,
        "bits_per_sample": dict(header.bits_per_sample),
        "attribute_bits": dict(header.attribute_bits),
        "attribute_errors": {attribute.name: largest_error(attribute) for attribute in header.attributes},
        "spacing": header.spacing,
        "position_error": header.position_error,
        "bounds": [list(header.bounds[:3]), list(header.bounds[3:])],
        "attributes": [attribute.name for attribute in header.attributes] + list(header.constants),
        "constants": {name: constant.to_json()["value"] for name, constant in header.constants.items()},
        "crs": header.crs,
        "left_out": dict(header.left_out),
        "rejected": dict(header.rejected),
        "spacing_ratio": list(header.spacing_ratio),
        "seed": header.seed,
        "generator": header.generator,
        "digest": header.digest,
    }


def counted(number: int, noun: str) -> str:
    """Write a number of things: ``1 cloud``, ``2,328 clouds``."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def largest_error(attribute: Attribute) -> float:
    """How far a decoded value may be from what the scan said: normals in degrees, others in units of the value."""
    return max_error_degrees(attribute.bits) if attribute.kind == "normal" else attribute.max_error
