"""Blended splatting on the CPU: the second pass over a picture, which shows the mean of its samples.

The first pass is the picture of discs: of each pixel it says how far the surface is that is seen. The second adds up
the samples of that surface, each weighed by a Gaussian in its plane and the pixel's filter (`splats`, `blend_kernels`),
and shows the mean, in linear light. So colours pass smoothly from sample to sample where samples are far apart, and
where they are closer than pixels, a pixel shows all of them: the texture is filtered, not sampled. Samples are lit
before: what aliases are small bumps, and the mean of their normals is lit unlike them.

A pixel that no sample reaches keeps the colour of the first pass, and depth, node and starvation remain those of the
sample that is seen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pointview import splats

from . import blend_kernels, tables

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    InParallel = Callable[[Callable[[int], None]], object]

CHUNK = 1 << 20
"""Samples at a time, 40 bytes each."""

LEAST = 1e-30
"""Weight of a pixel below which its mean means nothing: near the least number of float32."""


def linear_light() -> NDArray[np.float32]:
    """Return the light of each of 256 levels of sRGB (IEC 61966-2-1), 0 to 1."""
    level = np.arange(256) / 255
    return np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4).astype(np.float32)


def kernel(*, focal: float) -> Any:
    """Return what all kernels of a picture share, a `blend_kernels.KERNEL`."""
    shared = np.zeros(1, dtype=blend_kernels.KERNEL)[0]
    shared["focal"], shared["width"], shared["pixel"] = focal, splats.KERNEL, splats.PIXEL
    shared["ends"], shared["behind"], shared["slanted"] = splats.KERNEL_ENDS, splats.BEHIND, splats.SLANTED
    return shared


def blend(
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    clouds: NDArray[Any],
    see: Callable[[NDArray[Any], NDArray[Any]], int],
    *,
    focal: float,
    threads: int,
    in_parallel: InParallel,
) -> None:
    """Write the mean of the samples into a picture.

    Parameters
    ----------
    rgb : (h, w, 3) uint8
        The picture of discs; changed in place.
    depth : (h, w) float32
        Its depth.
    clouds : (k,) kernels.CLOUD
    see : callable
        Writes the samples of some clouds as `kernels.seen` does.
    focal : float
        Pixels.
    in_parallel : callable
        Calls what it is given once for each of so many threads.

    Notes
    -----
    Threads share the rows, and every row gets its samples in the order of the clouds: sums of float32 depend on it, and
    the picture must not depend on the number of threads.
    """
    sums = np.zeros((*depth.shape, 4), dtype=np.float32)
    every = kernel(focal=focal)
    bounds = [len(depth) * worker // threads for worker in range(threads + 1)]
    room = np.empty(0, dtype=tables.SAMPLE)
    for part in _chunks(clouds):
        # Each thread takes clouds that follow each other, so that all samples stay in order.
        shares = np.array_split(part, threads)
        starts = np.cumsum([0, *(share["count"].sum() for share in shares)])
        if len(room) < starts[-1]:
            room = np.empty(starts[-1], dtype=tables.SAMPLE)
        found = [room[:0]] * threads

        def look(worker: int, shares: Any = shares, starts: Any = starts, found: Any = found, room: Any = room) -> None:
            samples = room[starts[worker] : starts[worker + 1]]
            found[worker] = samples[: see(samples, shares[worker])]

        def gather(worker: int, found: Any = found) -> None:
            for samples in found:
                blend_kernels.gather(sums, samples, depth, bounds[worker], bounds[worker + 1], every)

        in_parallel(look)
        in_parallel(gather)
    in_parallel(lambda worker: blend_kernels.mean(rgb, sums, bounds[worker], bounds[worker + 1], LEAST))


def _chunks(clouds: NDArray[Any]) -> list[NDArray[Any]]:
    """Split clouds where they would be more than CHUNK samples."""
    number = np.cumsum(clouds["count"]) // CHUNK
    return np.split(clouds, np.flatnonzero(np.diff(number)) + 1) if len(clouds) else []
