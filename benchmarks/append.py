"""What adding one per cent costs: ``python benchmarks/append.py [--samples 10M] [--threads 1] [--folder FOLDER]``.

The scan is that of `build.py`. A model of 99 % of it gets the rest: samples from all over it, or a patch of it; and for
comparison all of it is built at once on the same lattice, which must give the same bytes. CPU time of the whole
process, with kernels compiled before, and how many of the clouds were copied.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import asked
import laspy
import numpy as np

from pointbuild import BuildOptions, build_model
from pointbuild.extend import read_header


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("--samples", type=asked.samples, default=10_000_000)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--split", choices=["spread", "patch"], help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    folder, samples = arguments.folder, arguments.samples
    if arguments.split:
        split(folder, samples, arguments.split)
        return
    maker = Path(__file__).with_name("build.py")
    for count in (samples, 20_000):
        if not (folder / f"benchmark-{count}.las").exists():
            made = folder / f"benchmark-{count}.las"
            subprocess.run([sys.executable, maker, "--make", made, "--samples", str(count)], check=True)
    options = BuildOptions(threads=arguments.threads)
    build_model([folder / "benchmark-20000.las"], folder / "old.lpc", options, clock=time.monotonic)
    build_model([folder / "benchmark-20000.las"], folder / "new.lpc", options, clock=time.monotonic,
                append=folder / "old.lpc")  # fmt: skip
    print(f"{'':<28}{'CPU s':>8}{'wall s':>8}{'clouds kept':>14}")
    for way in ("spread", "patch"):
        subprocess.run([sys.executable, __file__, "--samples", str(samples), "--folder", folder, "--split", way],
                       check=True)  # fmt: skip
        old, rest = folder / "append-old.las", folder / "append-rest.las"
        build_model([old], folder / "old.lpc", options, clock=time.monotonic)
        step = read_header(folder / "old.lpc").step
        rows = {}
        for name, scans, more in (
            ("append 1 %, " + way, [rest], {"append": folder / "old.lpc"}),
            ("build of everything", [old, rest], {"options": BuildOptions(threads=arguments.threads, step=step)}),
        ):
            cpu, wall = time.process_time(), time.monotonic()
            chosen = more.pop("options", options)
            report = build_model(scans, folder / "new.lpc", chosen, clock=time.monotonic, **more)
            kept = f"{report.clouds_kept:,} of {report.header.nodes:,}" if more else ""
            print(f"{name:<28}{time.process_time() - cpu:>8.2f}{time.monotonic() - wall:>8.2f}{kept:>14}", flush=True)
            rows[name] = report.header.digest
        assert len(set(rows.values())) == 1, rows


def split(folder: Path, samples: int, way: str) -> None:
    """Write the two parts; samples on the box stay in the first, which so has the box of all."""
    scan = laspy.read(folder / f"benchmark-{samples}.las")
    xyz = np.stack([scan.X, scan.Y, scan.Z], axis=1)
    if way == "spread":
        chosen = np.random.default_rng(0).random(samples) < 0.01
    else:
        away = ((xyz - xyz[samples // 5]).astype(float) ** 2).sum(axis=1)
        chosen = away <= np.partition(away, samples // 100)[samples // 100]
    chosen &= ~((xyz == xyz.min(axis=0)) | (xyz == xyz.max(axis=0))).any(axis=1)
    for name, which in (("old", ~chosen), ("rest", chosen)):
        part = laspy.LasData(scan.header)
        part.points = scan.points[which]
        part.write(folder / f"append-{name}.las")


if __name__ == "__main__":
    main()
