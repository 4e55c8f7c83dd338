"""Where a build may write, and how much it will need."""

from __future__ import annotations

import errno
import os
import shutil
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lpc.errors import BuildError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
FIXED = 1 << 20
"""Journals and the pages of a small model."""


@dataclass(frozen=True, slots=True)
class Need:
    """Bytes that a build takes.

    Parameters
    ----------
    temporary : int
        Of all temporary files, the unfinished model included, at the worst moment.
    model : int
        Of the model.
    """

    temporary: int
    model: int


def check_target(out: Path) -> None:
    """Raise BuildError if no file can be made at `out`."""
    if out.is_dir():
        raise BuildError(f"{out} is a directory; name the model file in it")
    if not out.parent.is_dir():
        raise BuildError(f"there is no directory {out.parent}; make it first")
    if not os.access(out.parent, os.W_OK):
        raise BuildError(f"the directory {out.parent} cannot be written to")


def predict(samples: int, row_bytes: int, attribute_bytes: int, moving: int) -> Need:
    """Predict what a build takes of the disk.

    The spool gives way to the rows, and the rows to the model: never are two of them whole. `moving` rows of buckets
    that are written back are there twice. A position at half the spacing takes less than 4 bytes of a cloud, and
    attributes take no more than they came with.
    """
    model = samples * (4 + attribute_bytes) + FIXED
    rows = samples * row_bytes
    spool = samples * (24 + attribute_bytes)
    return Need(max(spool, rows + min(moving, samples) * row_bytes, rows + model, 2 * model) + FIXED, model)


def check_space(need: Need, folder: Path, used: int, out: Path) -> None:
    """Raise BuildError if the disks are too full; `used` bytes of the temporary folder can be had again."""
    needs = {folder: need.temporary - used}
    if folder.stat().st_dev != out.parent.stat().st_dev:
        needs[out.parent] = need.model
    for place, wanted in needs.items():
        free = free_bytes(place)
        if wanted > free:
            raise BuildError(
                f"the build needs about {_size(wanted)} in {place.parent if place == folder else place}, which has "
                f"{_size(free)} free: make room, or choose another place for temporary files (--scratch)"
            )


def free_bytes(folder: Path) -> int:
    """Bytes that may still be written in a directory."""
    return shutil.disk_usage(folder).free


@contextmanager
def translated(out: Path) -> Iterator[None]:
    """Turn a full disk, or less memory than was allowed, into a BuildError."""
    try:
        yield
    except MemoryError as error:
        raise BuildError(
            f"the system gave less memory than the build of {out} may use: lower --memory, or raise the system's limit"
        ) from error
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise BuildError(f"the disk is full while building {out}: make room, or use --scratch") from error
        raise


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 10**9 else f"{count / 1e6:.0f} MB"
