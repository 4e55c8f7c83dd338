"""Which order of requests reaches a small error sooner: `python benchmarks/priorities.py MODEL.lpc...`.

Each model is streamed over a line on the virtual clock in four views, once with each priority: whole; near, a part of
it from a third of the distance; oblique, from close to the side, where near and far are in one picture; far. Two errors
are of the same view with everything resident, over the covered pixels: the root mean square difference in levels, which
decides, and one minus the structural similarity. The initial one is that of the first picture of either run. A row says
when they first fall to 90%, 50% and 10% and stay there, interpolated between the moments of the curve, and the mean of
the first one from 0.5 s (or the first picture) until the slower run is settled. Where the first picture is the last but
for a round trip, there is no row.
"""

from __future__ import annotations

import contextlib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import asked
import numpy as np

import pointstream
from pointlink.profiles import parse_profile
from pointview.camera import Camera
from pointview.stream.experiment import Experiment, run_experiment
from pointview.stream.path import ViewPath

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

SHARES = (0.9, 0.5, 0.1)
SIZE = (320, 240)
PRIORITIES = ("index", "error")
VIEWS = ("whole", "near", "oblique", "far")


@dataclass(frozen=True, slots=True)
class Run:
    """One curve: times in seconds, and both errors at them, from the first picture on; seconds until it is settled."""

    levels: list[tuple[float, float]]
    dissimilarity: list[tuple[float, float]]
    settled: float


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("models", nargs="+", metavar="MODEL.lpc")
    parser.add_argument("--link", default="adsl", help="the line, as of pointstream stream (default: adsl)")
    parser.add_argument("--seconds", type=float, default=14.0, help="length of a run (default: 14)")
    options = parser.parse_args()
    tasks = [
        (path, view, priority, options.link, options.seconds)
        for path in options.models
        for view in VIEWS
        for priority in PRIORITIES
    ]
    with ProcessPoolExecutor(2) as pool:
        runs = dict(zip(tasks, pool.map(_run, *zip(*tasks, strict=True)), strict=True))
    shares = "".join(f"{f'{share:.0%}, s':>16}" for share in SHARES)
    print(f"{'model, view: index / error':26}{shares}{'levels':>16}{'settled, s':>16}{shares}  (1 - SSIM)")
    ratios = []
    for path in options.models:
        for view in VIEWS:
            both = [runs[path, view, priority, options.link, options.seconds] for priority in PRIORITIES]
            if min(len([error for _, error in run.levels if error > 0]) for run in both) < 2:
                continue
            cells = [
                *_reached([run.levels for run in both]),
                [_mean(run, both) for run in both],
                [run.settled for run in both],
                *_reached([run.dissimilarity for run in both]),
            ]
            ratios.append([error / index if index > 0 else np.nan for index, error in cells])
            print(f"{Path(path).stem + ', ' + view:26}" + "".join(f"{a:>8.2f} /{b:>6.2f}" for a, b in cells))
    means = np.exp(np.nanmean(np.log(ratios), axis=0))
    print(f"{'error over index, mean':26}" + "".join(f"{ratio:>16.3f}" for ratio in means))


def _run(path: str, view: str, priority: str, link: str, seconds: float) -> Run:
    experiment = Experiment(
        model=path,
        link=link,
        profile=parse_profile(link),
        clock="virtual",
        seconds=seconds,
        size=SIZE,
        tolerance=1.0,
        priority="error" if priority == "error" else "index",
        occlusion="off",
        views=ViewPath.still(_view(path, view)),
    )
    report, _ = run_experiment(experiment, say=lambda _: None, progress=_silent)
    curve = [entry for entry in report.curve if entry["splats"]]
    return Run(
        [(e["t"], 0.0 if e["psnr_db"] is None else 255 * 10 ** (-e["psnr_db"] / 20)) for e in curve],
        [(e["t"], 1.0 - e["ssim"]) for e in curve],
        seconds if report.settled_s is None else report.settled_s,
    )


def _view(path: str, name: str) -> dict[str, object]:
    with pointstream.open(path) as model:
        whole = Camera.frame_model(model.header, width=SIZE[0], height=SIZE[1])
        low, high = np.array(model.header.bounds).reshape(2, 3)
    target, up = np.array(whole.target), np.array(whole.up)
    back = np.array(whole.eye) - target
    if name == "near":
        target, back = target + 0.2 * (high - low), back / 3
    elif name == "oblique":
        reach, side = np.linalg.norm(back), np.cross(up, back)
        target = target - 0.1 * (high - low) * (np.abs(up) < 0.5)
        back = 0.45 * reach * (0.7 * side / np.linalg.norm(side) + 0.3 * back / reach + 0.25 * up)
    elif name == "far":
        back = 2.5 * back
    return {"eye": (target + back).tolist(), "target": target.tolist(), "up": up.tolist(), "fov_y": whole.fov_y}


def _mean(run: Run, both: Sequence[Run]) -> float:
    start = max(0.5, *(other.levels[0][0] for other in both))
    stop = max(start + 0.1, *(other.settled for other in both))
    return float(np.interp(np.arange(start, stop, 0.02), *np.array(run.levels).T).mean())


def _reached(curves: Sequence[Sequence[tuple[float, float]]]) -> list[list[float]]:
    """Seconds after which each curve stays at or below the shares of the larger initial value; NaN if it does not."""
    initial = max(curve[0][1] for curve in curves)
    return [[_fell(curve, share * initial) for curve in curves] for share in SHARES]


def _fell(curve: Sequence[tuple[float, float]], value: float) -> float:
    above = [number for number, (_, here) in enumerate(curve) if here > value]
    if not above:
        return curve[0][0]
    last = above[-1]
    if last + 1 == len(curve):
        return float("nan")
    (before, high), (after, low) = curve[last], curve[last + 1]
    return before + (after - before) * (high - value) / (high - low)


@contextlib.contextmanager
def _silent(_label: str, _total: int) -> Iterator[object]:
    yield lambda _steps: None


if __name__ == "__main__":
    main()
