"""The data access layer: open a model anywhere, read what is wanted of it, and know what the link costs.

>>> import pointstream
>>> model = pointstream.open("https://host/david.lpc")  # or a path              # doctest: +SKIP
>>> samples = model.read(spacing=0.01)                                           # doctest: +SKIP
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .cache import Cache
    from .model import Model

__version__ = "0.1.0"
__all__ = ["__version__", "open"]


def open(target: str, *, cache: Cache | None = None) -> Model:  # noqa: A001  (gzip.open, zarr.open: the name that people try first)
    """Open a model; see `pointstream.model.open_model`."""
    from .model import open_model

    return open_model(target, cache=cache)
