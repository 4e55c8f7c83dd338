"""Where a build may write, how much it will need, and what is left behind: nothing."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lpc.errors import BuildError

if TYPE_CHECKING:
    from collections.abc import Iterator

CLOUD_BYTES = 16  # per sample, at most: colour scans need about 5


def check_target(out: Path) -> None:
    """Raise BuildError if no file can be made at `out`."""
    if out.is_dir():
        raise BuildError(f"{out} is a directory; name the model file in it")
    if not out.parent.is_dir():
        raise BuildError(f"there is no directory {out.parent}; make it first")
    if not os.access(out.parent, os.W_OK):
        raise BuildError(f"the directory {out.parent} cannot be written to")


def needed_bytes(samples: int, spool_bytes: int, row_bytes: int) -> tuple[int, int]:
    """Temporary bytes at the worst moment, and bytes of the model at most."""
    model = samples * CLOUD_BYTES + 65536
    return max(samples * (spool_bytes + row_bytes), samples * row_bytes + model), model


def check_space(samples: int, scratch: Path, out: Path, spool_bytes: int, row_bytes: int) -> None:
    """Raise BuildError if the disks are too full for so many samples."""
    temporary, model = needed_bytes(samples, spool_bytes, row_bytes)
    needs = {scratch: temporary, out.parent: model}
    if scratch.stat().st_dev == out.parent.stat().st_dev:
        needs = {scratch: max(temporary, samples * row_bytes + 2 * model)}
    for folder, need in needs.items():
        free = free_bytes(folder)
        if need > free:
            raise BuildError(
                f"the build needs about {_size(need)} in {folder.parent if folder == scratch else folder}, which has "
                f"{_size(free)} free: make room, or choose another place for temporary files (--scratch)"
            )


def free_bytes(folder: Path) -> int:
    """Bytes that may still be written in a directory."""
    return shutil.disk_usage(folder).free


@contextmanager
def scratch_folder(parent: Path, name: str) -> Iterator[Path]:
    """Make a directory for temporary files; it is removed however the block ends."""
    if not parent.is_dir():
        raise BuildError(f"there is no directory {parent} for temporary files; make it first")
    folder = Path(tempfile.mkdtemp(prefix=f".{name}.", suffix=".build", dir=parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def translated(out: Path) -> Iterator[None]:
    """Turn a full disk into a BuildError."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise BuildError(f"the disk is full while building {out}: make room, or use --scratch") from error
        raise


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 10**9 else f"{count / 1e6:.0f} MB"
