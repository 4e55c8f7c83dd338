"""Which order of requests reaches a small error sooner: `python benchmarks/priorities.py MODEL.lpc...`.

Each model is streamed over ADSL on the virtual clock, seen whole and from near, once with each priority. The error is
the root mean square difference to the same view with everything resident, over the covered pixels; the initial one is
that of the first picture of either run. The table says when it first falls to 90%, 50% and 10% and stays there,
interpolated between the moments of the curve, and the mean error until the slower run is settled.
"""

from __future__ import annotations

import contextlib
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import asked
import numpy as np

from pointlink.profiles import parse_profile
from pointview.stream.experiment import Experiment, run_experiment
from pointview.stream.path import ViewPath

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

SHARES = (0.9, 0.5, 0.1)
SIZE = (320, 240)
SECONDS = 14.0
PRIORITIES = ("index", "error")


def main() -> None:
    models = [str(model) for model in asked.models(__doc__)]
    tasks = [(path, near, priority) for path in models for near in (False, True) for priority in PRIORITIES]
    with ProcessPoolExecutor(2) as pool:
        curves = dict(zip(tasks, pool.map(_curve, *zip(*tasks, strict=True)), strict=True))
    print(
        f"{'model':28} {'priority':9}" + "".join(f"{f'{share:.0%} s':>8}" for share in SHARES) + f"{'mean error':>12}"
    )
    for path in models:
        for near in (False, True):
            both = [curves[path, near, priority] for priority in PRIORITIES]
            initial = max(curve[0][1] for curve in both)
            for priority, curve in zip(PRIORITIES, both, strict=True):
                times = "".join(f"{_reached(curve, share * initial):>8}" for share in SHARES)
                mean = np.interp(np.arange(0.5, SECONDS, 0.05), *np.array(curve).T).mean()
                print(f"{Path(path).stem + (', near' if near else ''):28} {priority:9}{times}{mean:12.2f}")


def _curve(path: str, near: bool, priority: str) -> list[tuple[float, float]]:
    """Times in seconds and errors in levels, from the first picture on."""
    views = ViewPath.still(_near(path)) if near else None
    experiment = Experiment(
        model=path,
        link="adsl",
        profile=parse_profile("adsl"),
        clock="virtual",
        seconds=SECONDS,
        size=SIZE,
        tolerance=1.0,
        priority="error" if priority == "error" else "index",
        occlusion="off",
        views=views,
    )
    report, _ = run_experiment(experiment, say=lambda _: None, progress=_silent)
    return [
        (entry["t"], 0.0 if entry["psnr_db"] is None else 255 * 10 ** (-entry["psnr_db"] / 20))
        for entry in report.curve
        if entry["splats"]
    ]


def _near(path: str) -> dict[str, object]:
    """A view of a part of the model, from a third of the distance and to the side of the middle."""
    import pointstream
    from pointview.camera import Camera

    with pointstream.open(path) as model:
        whole = Camera.frame_model(model.header, width=SIZE[0], height=SIZE[1])
        low, high = np.array(model.header.bounds).reshape(2, 3)
    target = np.array(whole.target) + 0.2 * (high - low)
    eye = target + (np.array(whole.eye) - np.array(whole.target)) / 3
    return {"eye": eye.tolist(), "target": target.tolist(), "up": list(whole.up), "fov_y": whole.fov_y}


def _reached(curve: Sequence[tuple[float, float]], error: float) -> str:
    """Seconds after which the error stays at or below a value."""
    above = [number for number, (_, value) in enumerate(curve) if value > error]
    if not above:
        return f"{curve[0][0]:.2f}"
    last = above[-1]
    if last + 1 == len(curve):
        return "-"
    (before, high), (after, low) = curve[last], curve[last + 1]
    return f"{before + (after - before) * (high - error) / (high - low):.2f}"


@contextlib.contextmanager
def _silent(_label: str, _total: int) -> Iterator[object]:
    yield lambda _steps: None


if __name__ == "__main__":
    main()
