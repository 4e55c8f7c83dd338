"""Where the bytes of a model come from: a local file, an HTTP host, memory. All answer byte ranges in the same way."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from lpc.errors import StoreError

from .base import KeepsNothing, Sink, Store
from .local import LocalStore
from .memory import MemoryStore
from .sparse import map_path

if TYPE_CHECKING:
    from collections.abc import Callable

    from pointstream.cache import Cache

__all__ = ["KeepsNothing", "LocalStore", "MemoryStore", "Sink", "Store", "is_address", "open_store"]


_SCHEME = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)


def is_address(target: str) -> bool:
    """Whether a target is an http(s) address; anything else is a path."""
    return target.lower().startswith(("http://", "https://"))


def open_store(target: str, *, clock: Callable[[], float], cache: Cache | None = None) -> Store:
    """Return the store of a path or an http(s) address; nothing is asked of a host yet.

    Parameters
    ----------
    target : str
    clock : callable
        Seconds, monotonic.
    cache : Cache, optional
        Where to keep what comes from an address.

    Raises
    ------
    StoreError
        If the file cannot be opened or the address cannot be one.
    FormatError
        If the file has the map of a partial copy beside it and is no model.
    """
    if not is_address(target):
        if _SCHEME.match(target):
            raise StoreError(f"{target}: only http and https addresses and paths of files work")
        path = Path(target)
        if map_path(path).is_file():
            from .partial import PartialStore

            return PartialStore(path)
        return LocalStore(path)
    from .http import HttpStore  # a local file needs no httpx

    store = HttpStore(target, clock=clock)
    if cache is None:
        return store
    from .cached import CachedStore

    return CachedStore(store, cache)
