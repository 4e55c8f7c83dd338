"""Where the bytes of a model come from: a local file, an HTTP host, memory. All answer byte ranges in the same way."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .base import Sink, Store
from .local import LocalStore
from .memory import MemoryStore

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["LocalStore", "MemoryStore", "Sink", "Store", "is_address", "open_store"]


def is_address(target: str) -> bool:
    """Whether a target is an http(s) address; anything else is a path."""
    return target.lower().startswith(("http://", "https://"))


def open_store(target: str, *, clock: Callable[[], float]) -> Store:
    """Return the store of a path or an http(s) address; nothing is asked of a host yet.

    Raises
    ------
    StoreError
        If the file cannot be opened or the address cannot be one.
    """
    if not is_address(target):
        return LocalStore(Path(target))
    from .http import HttpStore  # a local file needs no httpx

    return HttpStore(target, clock=clock)
