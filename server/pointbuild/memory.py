"""How large blocks and buckets may be under a ceiling on resident memory."""

from __future__ import annotations

import resource
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lpc.context import ANCESTORS
from lpc.errors import BuildError

from .bucket import MAX_BUCKET
from .encode import RUN_SAMPLES

if TYPE_CHECKING:
    from .options import BuildOptions

RESERVE = 48 << 20
"""Kept free for what allocators hold back."""

NODE_BYTES = 400  # a node's arrays, and their copies while the trees are joined
READ_BYTES = 320  # a sample in a reader's batch, decoded and as it was stored, and on its way to a row
ATTRIBUTE_BYTES = 5  # times its attributes
BEST_BLOCK = 1 << 18
BEST_BUCKET = 1 << 19  # larger ones cost a fifth more, and keep threads from sharing the work evenly
MANY_BUCKETS = 1 << 10  # of more samples buckets grow, for what the nodes above them hold in memory
MOST_BUCKET = 1 << 20
LEAST_BLOCK = 1 << 13


@dataclass(frozen=True, slots=True)
class Sizes:
    """What a build may hold at a time: samples of a block and of a bucket, bytes of ancestors, and threads."""

    block: int
    bucket: int
    ancestors: int
    threads: int


def choose_sizes(options: BuildOptions, samples: int, row_bytes: int, resident: int) -> Sizes:
    """Sizes that fit under the ceiling.

    Parameters
    ----------
    options : BuildOptions
    samples : int
        Of the input, at most.
    row_bytes : int
        Of a sample in the bucket files.
    resident : int
        Resident bytes of the process before the build.

    Raises
    ------
    BuildError
        If the ceiling is too low for any.
    """
    held = resident + RESERVE + NODE_BYTES * 2 * (samples // options.cloud_size)
    room = options.memory_bytes - held
    least_bucket = max(4 * options.cloud_size, 1 << 16)
    per_sample = bucket_bytes(row_bytes)
    threads, read = options.workers, read_bytes(row_bytes)
    encode = encode_bytes(row_bytes, options.cloud_size)
    while threads > 1 and (
        room < threads * least_bucket * per_sample + (threads + 2) * LEAST_BLOCK * read or room < threads * encode
    ):
        threads -= 1
    block = min(room // ((threads + 2) * read), BEST_BLOCK)
    fair = max(samples // (4 * (threads + 2)), least_bucket)  # buckets that move are on disk twice: a quarter in all
    best = min(max(samples // MANY_BUCKETS, BEST_BUCKET), MOST_BUCKET)
    bucket = min(room // (threads * per_sample), best, fair)
    if block < LEAST_BLOCK or bucket < least_bucket or room < encode:
        need = held + max(least_bucket * per_sample + 3 * LEAST_BLOCK * read, encode)
        raise BuildError(
            f"{options.memory_bytes >> 20} MiB of memory are too few for clouds of {options.cloud_size}: "
            f"allow at least {(need >> 20) + 1} MiB (--memory)"
        )
    return Sizes(
        block=options.block_samples or block,
        bucket=min(options.bucket_samples or bucket, MAX_BUCKET),
        ancestors=(room - threads * encode) // 2,
        threads=threads,
    )


def bucket_bytes(row_bytes: int) -> int:
    """Resident bytes per sample while a bucket is sorted: rows twice, keys, places and owners."""
    return 2 * row_bytes + 72


def read_bytes(row_bytes: int) -> int:
    """Resident bytes per sample while blocks are read and scattered."""
    return READ_BYTES + ATTRIBUTE_BYTES * max(row_bytes - 32, 0)


def encode_bytes(row_bytes: int, cloud_size: int) -> int:
    """Resident bytes while a run of nodes is encoded: itself, its ancestors, and their codes in three forms."""
    return (RUN_SAMPLES + (1 + ANCESTORS) * cloud_size) * (48 + 3 * row_bytes)


def resident_bytes() -> int:
    """Resident size of this process now; its peak where the system does not say."""
    return _status("VmRSS") or peak_bytes()


def peak_bytes() -> int:
    """Peak resident size of this process."""
    # Linux lets a process inherit the ru_maxrss of whoever started it; VmHWM is its own.
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return _status("VmHWM") or (peak if sys.platform == "darwin" else peak * 1024)


def _status(field: str) -> int:
    """Read a field of /proc/self/status in bytes; 0 where there is none."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{field}:")), 0)
