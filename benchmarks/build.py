"""Stage by stage, what a build costs: ``python benchmarks/build.py [--samples 10M] [--memory 2G] [--threads 2]``.

The input is a LAS file (point format 2, 26 bytes a sample, millimetre scale at survey coordinates): half of it a bumpy
sphere in strips as a scanner takes it, half a turbulent isosurface in slabs, both coloured. It is made once and kept in
--folder. Costs are CPU time of the whole process, user and system, with kernels compiled before (a small build
goes first), and wall time. The floor is one read of the input, one write of the output and one zstd pass.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import asked
import laspy
import numpy as np
import zstandard

from pointbuild import BuildOptions, build_model
from pointbuild.sizes import parse_size

if TYPE_CHECKING:
    from numpy.typing import NDArray

CHUNK = 500_000


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("--samples", type=asked.samples, default=10_000_000)
    parser.add_argument("--memory", default="2G")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--cloud-size", type=int, default=2048)
    parser.add_argument("--effort", default="default", choices=["default", "best", "fast"])
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--make", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.make:
        make_scan(arguments.make, arguments.samples)
        return
    scan = arguments.folder / f"benchmark-{arguments.samples}.las"
    small = arguments.folder / "benchmark-20000.las"
    for path, samples in ((scan, arguments.samples), (small, 20_000)):
        if not path.exists():  # in a process of its own, whose memory is not ours
            subprocess.run([sys.executable, __file__, "--make", path, "--samples", str(samples)], check=True)
    options = BuildOptions(
        memory_bytes=parse_size(arguments.memory),
        threads=arguments.threads,
        cloud_size=arguments.cloud_size,
        effort=arguments.effort,
    )
    out = arguments.folder / "benchmark.lpc"
    build_model([small], out, replace(options, bucket_samples=8192), clock=time.monotonic)
    stages = Stages()
    report = build_model([scan], out, options, stages, clock=time.monotonic)
    stages.stage("", None)
    header = report.header
    print(f"{header.samples:,} samples, {header.nodes:,} clouds, {header.bytes:,} bytes, r = {header.spacing:.4g}")
    print(f"bits per sample: {dict(header.bits_per_sample)}")
    print(f"\n{'stage':<12}{'CPU ns/sample':>14}{'wall s':>9}{'cores':>7}")
    for name, cpu, wall in [*stages.rows, ("all", stages.cpu, stages.wall)]:
        print(f"{name:<12}{cpu / header.samples * 1e9:>14.0f}{wall:>9.2f}{cpu / max(wall, 1e-9):>7.2f}")
    print(f"{'floor':<12}{floor(scan, out) / header.samples * 1e9:>14.0f}")
    print(f"\npeak resident memory {report.peak_rss_bytes / 2**20:.0f} MiB of {options.memory_bytes / 2**20:.0f} MiB")


class Stages:
    """Progress that keeps what each stage cost."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, float, float]] = []
        self._name, self._cpu, self._wall = "", time.process_time(), time.monotonic()

    @property
    def cpu(self) -> float:
        return sum(row[1] for row in self.rows)

    @property
    def wall(self) -> float:
        return sum(row[2] for row in self.rows)

    def stage(self, name: str, _total: int | None) -> None:
        cpu, wall = time.process_time(), time.monotonic()
        self.rows.append((self._name or "open", cpu - self._cpu, wall - self._wall))
        self._name, self._cpu, self._wall = name, cpu, wall

    def advance(self, samples: int) -> None:
        pass


def floor(scan: Path, out: Path) -> float:
    """CPU seconds to read the input, compress as many bytes as the output holds, and write the output."""
    began = time.process_time()
    with scan.open("rb") as file:
        while file.read(1 << 20):
            pass
    stored = out.read_bytes()
    context = zstandard.ZstdCompressor(level=1)
    for begin in range(0, len(stored), 1 << 14):
        context.compress(stored[begin : begin + (1 << 14)])
    out.with_suffix(".copy").write_bytes(stored)
    out.with_suffix(".copy").unlink()
    return time.process_time() - began


def make_scan(path: Path, samples: int) -> None:
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales, header.offsets = np.full(3, 0.001), np.array([500_000.0, 4_900_000.0, 0.0])
    rng = np.random.default_rng(7)
    with laspy.open(path, "w", header=header) as writer:
        half = samples // 2
        for kind, count in ((sphere, half), (isosurface, samples - half)):
            for begin in range(0, count, CHUNK):
                end = min(begin + CHUNK, count)
                xyz, shade = kind(rng, end - begin, begin / count, end / count)
                record = laspy.ScaleAwarePointRecord.zeros(end - begin, header=header)
                record["x"], record["y"], record["z"] = xyz.T + header.offsets[:, None]
                color = 40 + 180 * shade[:, None] * np.array([1.0, 0.8, 0.6]) + rng.normal(0, 5, (end - begin, 3))
                for channel, name in enumerate(("red", "green", "blue")):
                    record[name] = np.clip(color[:, channel], 0, 255).astype(np.uint16) * 256
                record["intensity"] = (4000 * shade + rng.normal(0, 50, end - begin)).clip(0, 65535).astype(np.uint16)
                writer.write_points(record)


def sphere(
    rng: np.random.Generator, count: int, begin: float, end: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Strips of a bumpy sphere of 40 m radius, one after another."""
    around = 2 * np.pi * np.sort(rng.uniform(begin, end, count))
    height = rng.uniform(-1, 1, count)
    radius = 40 + 0.8 * np.sin(23 * around) * np.cos(19 * height) + 0.1 * np.sin(140 * around + 90 * height)
    flat = np.sqrt(1 - height**2)
    xyz = np.stack([flat * np.cos(around), flat * np.sin(around), height], axis=1) * radius[:, None]
    return xyz, (radius - 39) / 2.2


def isosurface(
    rng: np.random.Generator, count: int, begin: float, end: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slabs of the zero set of a few waves, 80 m wide, beside the sphere: samples pulled to it by Newton steps."""
    waves = np.random.default_rng(3).normal(0, 0.12, (12, 3))
    phases = np.arange(12.0)
    xyz = np.stack([rng.uniform(80 * begin, 80 * end, count), *rng.uniform(0, 80, (2, count))], axis=1)
    for _ in range(6):
        angle = xyz @ waves.T + phases
        value, slope = np.sin(angle).sum(axis=1), np.cos(angle) @ waves
        size = np.maximum((slope**2).sum(axis=1), 0.01)
        xyz -= np.clip(value / size, -4, 4)[:, None] * slope
    shade = 0.5 + 0.5 * np.sin(0.9 * xyz[:, 0]) * np.cos(0.7 * xyz[:, 1])
    return xyz + np.array([60.0, 0.0, 0.0]), shade


if __name__ == "__main__":
    main()
