"""Write the mixing interface as a PLY file: ``scripts/make_mixing_interface OUT.ply --samples 2M``.

Binary, little-endian, positions and normals as float32, colours on request. The file depends on the number of samples,
the seed and the depth, and not on the number of threads. ``--rays`` counts how often rays cross the surface.
"""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import asked
import numpy as np
from mixing import BRICKS, SIZE, Interface

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("out", type=Path, metavar="OUT.ply")
    parser.add_argument("--samples", type=asked.samples, default=2_000_000, help="about so many: 200k, 2M, 234717830")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--depth", type=float, default=55.0, help="mean crossings of rays from the worst viewpoint")
    parser.add_argument("--color", action="store_true", help="with colours")
    parser.add_argument("--threads", type=int, default=0, help="default: as many as there are cores")
    parser.add_argument("--rays", type=int, default=0, help="also count the crossings of so many rays a viewpoint")
    arguments = parser.parse_args()
    interface = Interface.of(arguments.seed, arguments.depth)
    began = time.monotonic()
    samples = write_ply(arguments.out, interface, arguments.samples, color=arguments.color, threads=arguments.threads)
    print(
        f"{arguments.out}: {samples:,} samples, {arguments.out.stat().st_size:,} bytes, "
        f"{time.monotonic() - began:.1f} s, {time.process_time():.1f} s CPU"
    )
    if arguments.rays:
        print_depths(interface, arguments.rays)


def print_depths(interface: Interface, rays: int) -> None:
    """Mean crossings from the faces, edges and corners of a cube around the box."""
    sides = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)])
    found = interface.depths(SIZE / 2 + 3 * sides, rays)
    for side, count in zip(sides, found, strict=True):
        low, middle, high = np.percentile(count, [10, 50, 90])
        print(f"from {side}: {count.mean():.1f} crossings a ray ({low:.0f}, {middle:.0f}, {high:.0f} at 10, 50, 90%)")
    print(f"least: {min(count.mean() for count in found):.1f}, all: {np.mean(found):.1f}")


def write_ply(path: Path, interface: Interface, samples: int, *, color: bool = False, threads: int = 0) -> int:
    """Write about `samples` samples as binary PLY, brick by brick; how many there were.

    The file is the same for any number of threads.
    """
    row = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), *([("color", "u1", 3)] if color else [])])
    lines = interface.lines_for(samples)
    threads = threads or len(os.sched_getaffinity(0))
    total = 0

    def rows(number: int) -> NDArray[Any]:
        xyz, normal = interface.brick(number, lines)
        out = np.empty(len(xyz), row)
        out["xyz"], out["normal"] = xyz, normal
        if color:
            out["color"] = shade(xyz)
        return out

    with path.open("wb") as file:
        file.write(_header(0, color))
        for block in _ahead(rows, BRICKS, threads):
            file.write(block.data)
            total += len(block)
        file.seek(0)
        file.write(_header(total, color))
    return total


def shade(xyz: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colours (n, 3): from blue gas below to orange gas above, in bands."""
    up = xyz[:, 2:]
    band = 0.85 + 0.15 * np.cos(40 * np.pi * up)
    ends = np.array([[60, 110, 220], [240, 150, 60]], np.float32)
    return np.clip((ends[0] + (ends[1] - ends[0]) * up) * band, 0, 255).astype(np.uint8)


def _header(samples: int, color: bool) -> bytes:
    """PLY header whose length does not depend on the number."""
    names = [f"float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    names += [f"uchar {name}" for name in ("red", "green", "blue")] if color else []
    count = f"element vertex {samples}"
    lines = ["ply", "format binary_little_endian 1.0", "comment mixing interface" + " " * (40 - len(count)), count]
    return "\n".join([*lines, *(f"property {name}" for name in names), "end_header", ""]).encode()


def _ahead(function: Any, count: int, threads: int) -> Iterator[Any]:
    """Results for 0, 1, ... in order, a few calls under way."""
    with ThreadPoolExecutor(threads) as pool:
        flying: deque[Future[Any]] = deque()
        for number in range(count):
            flying.append(pool.submit(function, number))
            if len(flying) > 2 * threads:
                yield flying.popleft().result()
        while flying:
            yield flying.popleft().result()


if __name__ == "__main__":
    sys.exit(main())
