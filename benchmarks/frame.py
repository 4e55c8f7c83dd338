"""CPU time of Python per frame for a cut of 2,000 clouds: `python benchmarks/frame.py`, with `tests` in PYTHONPATH too.

The clouds have 12 samples each and the picture is small, so what is measured is the work per cloud: traversal, memory
management and submission, and not the splats. OpenGL is measured until all commands are submitted, with the indirect
multi-draw of 4.3 and with the draw from textures of 3.3. A driver in software does the work of the vertices inside
the one call that draws, so what that takes is shown apart, and the frame with and without it. Times are medians over
frames of a turning camera, of the calling thread's CPU.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

import asked
import numpy as np
from support import models

from lpc.errors import Unavailable
from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style

if TYPE_CHECKING:
    from collections.abc import Callable

CLOUDS = 2000
ROUNDS = 60
STYLE = Style(two_sided=True, close_holes=False)


def main() -> None:
    asked.nothing(__doc__)
    model = models.sphere(21_500, cloud_size=12)
    cuts = [_cut(model, turn) for turn in range(ROUNDS)]
    nodes = int(np.median([len(cut.nodes) for cut, _ in cuts]))
    print(f"{nodes} clouds of {nodes and cuts[0][0].splats // nodes} samples")
    print(f"{'what':44} {'ms a frame':>10}")
    traversal = _median(lambda turn: _cut(model, turn))
    print(f"{'traversal':44} {traversal:10.2f}")
    for label, indirect in (("indirect multi-draw (4.3)", True), ("draw from textures (3.3)", False)):
        try:
            cache, submission, driver = _gl(model, cuts, indirect)
        except Unavailable as error:
            print(error)
            return
        print(f"{'cache, ' + label:44} {cache:10.2f}")
        print(f"{'submission, ' + label:44} {submission:10.2f}")
        print(f"{'Python, ' + label:44} {traversal + cache + submission:10.2f}")
        print(f"{'the call itself: driver and vertices':44} {driver:10.2f}")
        print(f"{'frame, ' + label:44} {traversal + cache + submission + driver:10.2f}")


def _cut(model: models.Model, turn: int) -> Any:
    angle = 2 * math.pi * turn / ROUNDS
    camera = Camera(
        eye=(3.2 * math.cos(angle), 3.2 * math.sin(angle), 0.5), target=(0, 0, 0), up=(0, 0, 1), width=64, height=64
    )
    return refine(model.index, camera, 1e-3, model.everything, cull_backfaces=False), camera


def _gl(model: models.Model, cuts: list[Any], indirect: bool) -> tuple[float, float, float]:
    """Milliseconds of finding the clouds in memory, of submitting them, and of the call that draws them."""
    from pointview.render.gl import GlBackend

    backend = GlBackend(model.header, indirect=indirect)
    try:
        for cut, camera in cuts[:3]:
            backend.draw(cut, model.take, camera, STYLE)

        def cache(turn: int) -> None:
            backend._upload(cuts[turn][0].nodes, model.take)  # noqa: SLF001

        def submit(turn: int) -> None:
            cut, camera = cuts[turn]
            backend._write_places(cut)  # noqa: SLF001
            samples.tell(backend._told(cut, camera, STYLE))  # noqa: SLF001
            backend._submit(samples, cut, slice(0, len(cut.nodes)), camera)  # noqa: SLF001

        def draw(_turn: int) -> None:
            render(samples.points, clouds)

        samples, memory = backend._splats, backend._memory  # noqa: SLF001
        finish, clouds = backend._context.finish, len(cuts[-1][0].nodes)  # noqa: SLF001
        with backend._context:  # noqa: SLF001
            backend._splatted.target.use()  # noqa: SLF001
            render, memory.render = memory.render, lambda _points, _clouds: None
            submission = _median(submit, after=finish)
            return _median(cache), submission, _median(draw, after=finish)
    finally:
        backend.close()


def _median(work: Callable[[int], Any], after: Callable[[], Any] = lambda: None) -> float:
    """Median CPU time of this thread, milliseconds."""
    times = []
    for turn in range(ROUNDS):
        start = time.thread_time()
        work(turn)
        times.append(time.thread_time() - start)
        after()
    return 1e3 * float(np.median(times))


if __name__ == "__main__":
    main()
