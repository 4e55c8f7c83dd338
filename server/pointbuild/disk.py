"""Where a build may write, and how much it will need."""

from __future__ import annotations

import errno
import os
import shutil
from contextlib import contextmanager
from typing import TYPE_CHECKING

from lpc.errors import BuildError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
FIXED = 64 << 20
"""Buckets that are being written back, journals and pages of a small model."""


def check_target(out: Path) -> None:
    """Raise BuildError if no file can be made at `out`."""
    if out.is_dir():
        raise BuildError(f"{out} is a directory; name the model file in it")
    if not out.parent.is_dir():
        raise BuildError(f"there is no directory {out.parent}; make it first")
    if not os.access(out.parent, os.W_OK):
        raise BuildError(f"the directory {out.parent} cannot be written to")


def needed_bytes(samples: int, spool_bytes: int, row_bytes: int) -> tuple[int, int]:
    """Predict the temporary bytes at the worst moment, and those of the model.

    The spool gives way to the rows, and the rows to the model: never are two of them whole. A cloud has less than
    4 bytes a sample for a position at half the spacing, and attributes take no more than they came with.
    """
    model = samples * (4 + max(spool_bytes - 24, 0)) + FIXED
    return max(samples * row_bytes + model, 2 * model), model


def check_space(samples: int, folder: Path, used: int, out: Path, spool_bytes: int, row_bytes: int) -> None:
    """Raise BuildError if the disks are too full for so many samples; `used` bytes of the folder can be had again."""
    temporary, model = needed_bytes(samples, spool_bytes, row_bytes)
    needs = {folder: temporary - used}
    if folder.stat().st_dev != out.parent.stat().st_dev:
        needs[out.parent] = model
    for place, need in needs.items():
        free = free_bytes(place)
        if need > free:
            raise BuildError(
                f"the build needs about {_size(need)} in {place.parent if place == folder else place}, which has "
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
