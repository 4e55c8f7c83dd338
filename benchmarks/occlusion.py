"""What occlusion culling saves on a folded surface: `python benchmarks/occlusion.py MODEL.lpc`.

MODEL is the mixing interface of `scripts/make_mixing_interface`, built. It is seen from four sides in 335 x 335 pixels
at a tolerance of one, as in LPC figure 3: splats drawn with and without culling, and the share of the covered pixels
that differ. Then it is streamed over ADSL both ways, with both priorities, and the table says when the error (root mean
square difference to everything resident) falls to shares of the first picture's.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import TYPE_CHECKING, Any

import asked
import numpy as np

import pointstream
from pointlink.profiles import parse_profile
from pointview.still import StillOptions, draw_still
from pointview.stream.experiment import Experiment, run_experiment
from pointview.stream.path import ViewPath

if TYPE_CHECKING:
    from collections.abc import Iterator

SIDE = 335
TURNS = (20, 110, 200, 290)
SHARES = (0.9, 0.5, 0.3, 0.1)
SECONDS = 60.0


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("model", metavar="MODEL.lpc")
    path = parser.parse_args().model
    views = [_view(path, turn) for turn in TURNS]
    print(f"{'from':>6} {'splats':>10} {'culled':>10} {'fewer':>6} {'pixels that differ':>19}")
    for turn, view in zip(TURNS, views, strict=True):
        whole, seen = (_still(path, view, occlusion) for occlusion in (False, True))
        covered = (whole.frame.node >= 0) | (seen.frame.node >= 0)
        differ = (whole.frame.rgb != seen.frame.rgb).any(axis=2)[covered].mean()
        ratio = whole.frame.splats / seen.frame.splats
        print(f"{turn:6d} {whole.frame.splats:10,} {seen.frame.splats:10,} {ratio:6.1f} {100 * differ:18.3f}%")
    shares = "".join(f"{f'{share:.0%} s':>8}" for share in SHARES)
    print(f"{'ADSL':>6} {'priority':>9} {'settled s':>10} {'bytes':>11}{shares}")
    for priority in ("index", "error"):
        for occlusion in ("off", "auto"):
            report = _stream(path, views[0], occlusion, priority)
            errors = [(e["t"], 255 * 10 ** (-(e["psnr_db"] or math.inf) / 20)) for e in report.curve if e["splats"]]
            times = "".join(f"{_reached(errors, share * errors[0][1]):>8}" for share in SHARES)
            settled = "-" if report.settled_s is None else f"{report.settled_s:.1f}"
            print(f"{occlusion:>6} {priority:>9} {settled:>10} {report.bytes:11,}{times}")


def _view(path: str, turn: float) -> dict[str, Any]:
    """A close view of the middle, from a side."""
    with pointstream.open(path) as model:
        low, high = np.array(model.header.bounds).reshape(2, 3)
    angle, reach = math.radians(turn), float(np.max(high - low))
    eye = (low + high) / 2 + reach * np.array([1.4 * math.cos(angle), 1.4 * math.sin(angle), 0.6])
    return {"eye": eye.tolist(), "target": ((low + high) / 2).tolist(), "up": [0, 0, 1], "fov_y": 25}


def _still(path: str, view: dict[str, Any], occlusion: bool) -> Any:
    return asyncio.run(draw_still(path, StillOptions(width=SIDE, height=SIDE, view=view, occlusion=occlusion)))


def _stream(path: str, view: dict[str, Any], occlusion: Any, priority: Any) -> Any:
    experiment = Experiment(
        model=path,
        link="adsl",
        profile=parse_profile("adsl"),
        clock="virtual",
        seconds=SECONDS,
        size=(SIDE, SIDE),
        tolerance=1.0,
        priority=priority,
        occlusion=occlusion,
        views=ViewPath.still(view),
    )
    return run_experiment(experiment, say=lambda _: None, progress=_silent)[0]


def _reached(errors: list[tuple[float, float]], error: float) -> str:
    """Seconds after which the error stays at or below a value."""
    above = [number for number, (_, value) in enumerate(errors) if value > error]
    if not above:
        return f"{errors[0][0]:.1f}"
    return "-" if above[-1] + 1 == len(errors) else f"{errors[above[-1] + 1][0]:.1f}"


@contextlib.contextmanager
def _silent(_label: str, _total: int) -> Iterator[object]:
    yield lambda _steps: None


if __name__ == "__main__":
    main()
