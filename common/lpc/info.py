"""What `info` and `build` print of a model: the one mapping from a header to the contract's keys."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .header import Header

FORMAT = "lpc 1"


def info_dict(header: Header, *, length: int | None = None) -> dict[str, Any]:
    """Describe a model in plain values, ready for JSON.

    Parameters
    ----------
    header : Header
    length : int, optional
        Bytes of the file that are there; None: all of them.

    Returns
    -------
    dict
        Lengths in model units; ``bounds`` is [min xyz, max xyz], ``attributes`` the names that `export` writes.
    """
    return {
        "format": FORMAT,
        "complete": length is None or length >= header.bytes,
        "samples": header.samples,
        "clouds": header.nodes,
        "levels": header.levels,
        "cloud_size": header.cloud_size,
        "bytes": header.bytes,
        "bits_per_sample": dict(header.bits_per_sample),
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
