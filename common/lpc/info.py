"""What ``pointstream info --json`` prints and `Model.info` holds; the keys are a promise to other programs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .header import Header

FORMAT = "lpc 1.0"
BITS = ("position", "normal", "color", "other", "index", "total")


def info_dict(header: Header, *, length: int | None = None) -> dict[str, Any]:
    """Describe a model by its header.

    Parameters
    ----------
    header : Header
    length : int, optional
        Bytes of the file that are there, if it may have been cut short.
    """
    low, high = list(header.bounds[:3]), list(header.bounds[3:])
    return {
        "format": FORMAT,
        "complete": length is None or length >= header.bytes,
        "samples": header.samples,
        "clouds": header.nodes,
        "levels": header.levels,
        "cloud_size": header.cloud_size,
        "bytes": header.bytes,
        "bytes_here": header.bytes if length is None else min(length, header.bytes),
        "bits_per_sample": {name: header.bits_per_sample.get(name, 0.0) for name in BITS},
        "spacing": header.spacing,
        "spacing_ratio": list(header.spacing_ratio),
        "position_error": header.position_error,
        "bounds": [low, high],
        "attributes": [attribute.name for attribute in header.attributes] + sorted(header.constants),
        "constants": {name: constant.to_json()["value"] for name, constant in sorted(header.constants.items())},
        "crs": header.crs,
        "left_out": dict(header.left_out),
        "rejected": dict(header.rejected),
        "generator": header.generator,
        "digest": header.digest,
    }
