"""What a build may be asked for."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from lpc.errors import BuildError

from .survey import Precision

if TYPE_CHECKING:
    from pathlib import Path

    from lpc.codec import Effort

MAX_CLOUD_SIZE = 65535


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildOptions:
    """Parameters of `build_model`; the bytes of the model depend on those marked with a star and on nothing else.

    Parameters
    ----------
    cloud_size : int *
        M, samples of a cloud, 1 to 65,535 (LPC 3; 512 to 8,192 are sensible).
    position_error : float or None *
        Largest distance between a sample and its decoded position, model units; None: half the spacing.
    step : float or None *
        Edge of a lattice cell, model units, in place of what follows from `position_error`.
    seed : int *
        Of the hash that picks the samples of a node.
    normals : {"auto", "keep", "estimate", "drop"} *
        ``auto``: those of the scan, from faces where it is a mesh; ``keep``: those of the scan only; ``estimate``: fit
        them to the neighbours; ``drop``: none.
    attributes : tuple of str, or None *
        Names to keep; ``("all",)`` for everything; None: normal, color, intensity and classification.
    normal_bits : int *
        Bits of an octahedral axis, 2 to 16.
    color_bits : int or None *
        Bits of a colour channel at most, 1 to 16; None: as many as it takes to keep all values.
    effort : {"default", "best", "fast"} *
        What the codec spends on size.
    page_nodes : int *
        Records of an index page.
    memory_bytes : int
        Ceiling on the peak resident size of the process.
    threads : int
        Worker threads; 0: as many as the process may use.
    block_samples : int
        Samples read, hashed and scattered at a time by one thread; 0: as the memory allows.
    bucket_samples : int
        Samples that are sorted together in memory; 0: as the memory allows.
    scratch : Path or None
        Where the temporary directory is made; None: beside the output.
    """

    cloud_size: int = 2048
    position_error: float | None = None
    step: float | None = None
    seed: int = 0
    normals: Literal["auto", "keep", "estimate", "drop"] = "auto"
    attributes: tuple[str, ...] | None = None
    normal_bits: int = 8
    color_bits: int | None = None
    effort: Effort = "default"
    page_nodes: int = 128
    memory_bytes: int = 2 << 30
    threads: int = 0
    block_samples: int = 0
    bucket_samples: int = 0
    scratch: Path | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.cloud_size <= MAX_CLOUD_SIZE:
            raise BuildError(f"a cloud size of {self.cloud_size} is not possible: choose 1 to {MAX_CLOUD_SIZE}")
        error = self.position_error
        if error is not None and not (math.isfinite(error) and error > 0):
            raise BuildError(f"a position error of {error} is not a length above 0")
        if not -(2**63) <= self.seed < 2**64:
            raise BuildError(f"the seed {self.seed} has more than 64 bits")
        if not 2 <= self.normal_bits <= 16:
            raise BuildError(f"normals of {self.normal_bits} bits an axis are not possible: choose 2 to 16")
        if self.color_bits is not None and not 1 <= self.color_bits <= 16:
            raise BuildError(f"colours of {self.color_bits} bits a channel are not possible: choose 1 to 16")
        if not 1 <= self.page_nodes <= 4096:
            raise BuildError(f"{self.page_nodes} records a page are not possible: choose 1 to 4096")
        if min(self.threads, self.block_samples, self.bucket_samples) < 0 or self.memory_bytes <= 0:
            raise BuildError("memory, threads and sizes must not be negative")

    @property
    def precision(self) -> Precision:
        """How exactly attributes are kept."""
        return Precision(normal_bits=self.normal_bits, color_bits=self.color_bits)

    @property
    def workers(self) -> int:
        """Worker threads to start."""
        if self.threads:
            return self.threads
        if hasattr(os, "sched_getaffinity"):
            return len(os.sched_getaffinity(0))
        return os.cpu_count() or 1
