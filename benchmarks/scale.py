"""The paper's largest model, and what larger ones need: ``python benchmarks/scale.py [--samples 234717830]``.

Makes the mixing interface (`mixing.py`), builds it, opens it through HTTP, and lets it and a small sampling of the
same surface arrive over the ADSL line of LPC, figure 5. Prints the figures beside LPC, table 1, and what 1, 10 and 100
billion samples would take at these costs a sample. Everything is made in --folder and removed again: 70 bytes of disk
a sample.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import asked
import numpy as np
from build import Stages
from estimates import Costs, Prices, print_estimates
from PIL import Image

from pointbuild import BuildOptions, build_model
from pointbuild.cli import report_dict
from pointbuild.sizes import parse_size

HERE = Path(__file__).resolve().parent
COMMAND = [sys.executable, "-c", "from pointstream.command import main; main()"]
PAPER = {"samples": 234_717_830, "seconds": 13_357, "bytes": 925 << 20, "bits": 33.0}


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("--samples", type=asked.samples, default=PAPER["samples"])
    parser.add_argument("--small", type=asked.samples, default=2_000_000, help="samples of the small sampling")
    parser.add_argument("--depth", type=float, default=55.0, help="of the surface; see make_mixing.py")
    parser.add_argument("--memory", default="2G")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--core-hour", type=float, default=0.04, help="price")
    parser.add_argument("--gb-month", type=float, default=0.02, help="price of what is published")
    parser.add_argument("--scratch-gb-month", type=float, default=0.10, help="price of what a build needs meanwhile")
    parser.add_argument("--build", nargs=2, type=Path, metavar=("SCAN", "MODEL"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.build:
        print(json.dumps(measured_build(*arguments.build, arguments.memory)))
        return
    folder = Path(tempfile.mkdtemp(prefix="scale-", dir=arguments.folder))
    try:
        large, built = make(folder, arguments.samples, arguments)
        print_row(built)
        print_stages(built)
        print(f"opening it takes {requests_to_open(large)} request")
        small, _ = make(folder, arguments.small, arguments)
        whole = picture(large, folder / "whole.png")
        for name, model in (("large", large), ("small", small)):
            print_stream(name, stream(model, folder / name), whole, last_frame(folder / name))
    finally:
        shutil.rmtree(folder)
    prices = Prices(arguments.core_hour, arguments.gb_month, arguments.scratch_gb_month)
    print_estimates(Costs.of(built), prices)


def make(folder: Path, samples: int, arguments: argparse.Namespace) -> tuple[Path, dict[str, Any]]:
    """Generate and build, each in a process of its own; the model, and what `measured_build` found."""
    scan, model = folder / "scan.ply", folder / f"{samples}.lpc"
    depth = ["--depth", str(arguments.depth)]
    run([sys.executable, HERE / "make_mixing.py", scan, "--samples", str(samples), *depth], capture=False)
    raw = scan.stat().st_size
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = json.loads(run([sys.executable, __file__, "--memory", arguments.memory, "--build", scan, model]))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    found["cpu"] = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    found["raw_bytes"] = raw
    scan.unlink()
    return model, found


def measured_build(scan: Path, model: Path, memory: str) -> dict[str, Any]:
    """Build, and say what it took by stage."""
    stages = Watching(model.parent)
    report = build_model([scan], model, BuildOptions(memory_bytes=parse_size(memory)), stages, clock=time.monotonic)
    stages.stage("", None)
    return {**report_dict(report), "stages": stages.rows, "disk": stages.disk}


class Watching(Stages):
    """Stages, and the most disk that was taken beside the scan."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder, self.disk = folder, 0

    def advance(self, samples: int) -> None:
        files = [path.stat() for path in self._folder.rglob("*") if path.is_file() and path.suffix != ".ply"]
        self.disk = max(self.disk, sum(file.st_blocks * 512 for file in files))
        super().advance(samples)


def requests_to_open(model: Path) -> int:
    """Requests that `pointstream info` makes, as the server logs them."""
    with tempfile.TemporaryFile("w+") as log:
        server = subprocess.Popen(
            [*COMMAND, "serve", model.parent, "--port", "0"],
            stdout=subprocess.PIPE, stderr=log, text=True, env=environment(),
        )  # fmt: skip
        try:
            assert server.stdout is not None
            address = server.stdout.readline().split()[-1]
            run([*COMMAND, "info", f"{address}{model.name}", "--json"])
        finally:
            server.terminate()
            server.communicate()
        log.seek(0)
        return sum(f"/{model.name}" in line for line in log)


def stream(model: Path, report: Path) -> dict[str, Any]:
    options = ["--link", "adsl", "--clock", "virtual", "--seconds", "30", "--occlusion", "auto", "--json"]
    found: dict[str, Any] = json.loads(run([*COMMAND, "stream", model, *options, "--report", report]))
    return found


def picture(model: Path, out: Path) -> Image.Image:
    """Render the whole model as `stream` sees it."""
    run([*COMMAND, "render", model, out, "--size", "1024x768", "--splat", "disc", "--json"])
    return Image.open(out).convert("RGB")


def last_frame(report: Path) -> Image.Image:
    frames = [path for path in report.glob("frame-*.png") if "starved" not in path.name]
    return Image.open(max(frames)).convert("RGB")


def psnr(one: Image.Image, other: Image.Image) -> float:
    """Decibels over the pixels that are not of the background, the first pixel, in both."""
    first, second = (np.asarray(each).astype(float) for each in (one, other))
    covered = (first != first[0, 0]).any(axis=2) | (second != second[0, 0]).any(axis=2)
    return float(10 * np.log10(255**2 / ((first - second)[covered] ** 2).mean()))


def run(command: list[Any], *, capture: bool = True) -> str:
    done = subprocess.run(
        [str(part) for part in command], check=True, stdout=subprocess.PIPE if capture else None, text=True,
        env=environment(),
    )  # fmt: skip
    return done.stdout or ""


def environment() -> dict[str, str]:
    rooms = [str(HERE.parent / room) for room in ("common", "server", "client")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(rooms)}


def print_row(built: dict[str, Any]) -> None:
    bits = built["bits_per_sample"]["total"]
    print(f"{'':10}{'samples':>14}{'seconds':>9}{'CPU s':>8}{'MB':>7}{'bits':>7}{'RSS MiB':>9}{'disk GB':>9}")
    print(
        f"{'here':10}{built['samples']:>14,}{built['seconds']:>9.0f}{built['cpu']:>8.0f}{built['bytes'] / 2**20:>7.0f}"
        f"{bits:>7.1f}{built['peak_rss_bytes'] / 2**20:>9.0f}{built['disk'] / 1e9:>9.1f}"
    )
    print(
        f"{'LPC':10}{PAPER['samples']:>14,}{PAPER['seconds']:>9,}{'':8}{PAPER['bytes'] / 2**20:>7.0f}{PAPER['bits']:>7}"
    )


def print_stages(built: dict[str, Any]) -> None:
    print(f"\n{'stage':<12}{'CPU ns/sample':>14}{'wall s':>9}")
    for name, cpu, wall in built["stages"]:
        print(f"{name:<12}{cpu / built['samples'] * 1e9:>14.0f}{wall:>9.1f}")


def print_stream(name: str, report: dict[str, Any], whole: Image.Image, frame: Image.Image) -> None:
    end = report["curve"][-1]
    print(
        f"{name}: first picture {report['first_picture_s']:.3f} s; after 30 s {report['samples']:,} samples, "
        f"{report['bytes'] / 1e6:.2f} MB, PSNR {end['psnr_db'] or float('inf'):.1f} dB to its own whole picture and "
        f"{psnr(frame, whole):.1f} dB to the large one's"
    )


if __name__ == "__main__":
    main()
