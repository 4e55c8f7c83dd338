"""One picture of one model: open, settle the view, draw."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from pointstream.layer import AccessLayer, LayerOptions
from pointstream.stores import open_store

from .budget import allowance, refine_within
from .camera import Camera
from .occlusion import Occlusion
from .refine import Cut, refine
from .render import Backend, Frame, Kind, Style, antialias, open_backend
from .settle import settle
from .unveil import unveil

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from pointstream.cache import Cache

CAPACITY = 4 << 30
"""Bytes of decoded clouds: a still picture holds its whole cut, however fine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StillOptions:
    """What to draw, and how.

    Parameters
    ----------
    width, height : int
        Pixels.
    view : mapping, optional
        A VIEW.json object; the whole model if not given.
    tolerance : float
        Projected spacing at which refinement stops, pixels.
    budget : int, optional
        Most splats; raises the tolerance where it is exceeded.
    backend : {"auto", "gl", "cpu"}
    threads : int
        Threads of the CPU backend.
    style : Style
    antialias : int
        Samples a pixel, along each side of it.
    occlusion : bool
        Leave out what is hidden, where that pays; not with a budget, which counts what is in view.
    patience : float
        Seconds to wait for a host that sends nothing.
    """

    width: int = 1024
    height: int = 768
    view: Mapping[str, Any] | None = None
    tolerance: float = 1.0
    budget: int | None = None
    backend: Kind = "auto"
    threads: int = 1
    style: Style = field(default_factory=Style)
    antialias: int = 1
    occlusion: bool = True
    patience: float = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Still:
    """A picture and its figures.

    Parameters
    ----------
    frame : Frame
    cut : Cut
    report : dict
        The contract's keys of ``render --json``.
    problems : tuple of str
        What kept data from coming, a line each.
    """

    frame: Frame
    cut: Cut
    report: dict[str, Any]
    problems: tuple[str, ...]


async def draw_still(
    target: str,
    options: StillOptions,
    *,
    cache: Cache | None = None,
    progress: Callable[[Cut], None] | None = None,
) -> Still:
    """Draw one picture of the model at a path or address; `cache` keeps what comes from an address.

    Raises
    ------
    StoreError, FormatError
        If the model cannot be opened, or the view is none.
    """
    if options.view is not None:  # a wrong view costs no connection
        Camera.from_view(options.view, width=options.width, height=options.height)
    store = open_store(target, clock=time.monotonic, cache=cache)
    layer = await AccessLayer.open(store, options=LayerOptions(capacity=CAPACITY), clock=time.monotonic)
    try:
        backend = open_backend(options.backend, layer.header, threads=options.threads)
        try:
            occlusion = Occlusion(layer.header.nodes, kept=1)
            look, cut = await _settle(layer, options, backend, occlusion, progress)
            camera = camera_of(layer, options)
            draw = partial(antialias.draw, backend, cut, layer.take, camera, options.style, finer=options.antialias)
            draw()  # uploads, and compiles at the first use
            start = time.perf_counter()
            look(layer)
            frame = draw()
            frame_ms = 1e3 * (time.perf_counter() - start)
        finally:
            backend.close()
        report = {
            "backend": backend.name,
            "splats": frame.splats,
            "clouds": frame.clouds,
            "starved_clouds": int(cut.starved.sum()),
            "culled": asdict(cut.culled),
            "frame_ms": round(frame_ms, 3),
            "bytes_read": layer.stats.bytes_received,
            "left_out": occlusion.left_out,
        }
        problems = tuple(f"{error.text} ({error.count} times)" for error in layer.stats.errors)
        return Still(frame=frame, cut=cut, report=report, problems=problems)
    finally:
        await layer.close()


def camera_of(layer: AccessLayer, options: StillOptions) -> Camera:
    """Return the camera of a still, once the model is open."""
    if options.view is None:
        return Camera.frame_model(layer.header, width=options.width, height=options.height)
    return Camera.from_view(options.view, width=options.width, height=options.height)


async def _settle(
    layer: AccessLayer,
    options: StillOptions,
    backend: Backend,
    occlusion: Occlusion,
    progress: Callable[[Cut], None] | None,
) -> tuple[Callable[[AccessLayer], Cut], Cut]:
    """Fetch the view; return how to look at it again, and what it shows."""
    wait = partial(settle, clock=time.monotonic, patience=options.patience, progress=progress)
    if not options.occlusion or options.budget is not None:
        look = partial(cut_of, options=options)
        return look, await wait(layer, look)

    def coarser(layer: AccessLayer, factor: float, hidden: NDArray[np.bool_] | None) -> Cut:
        return cut_of(layer, replace(options, tolerance=options.tolerance * factor), hidden)

    looking = options.style
    if looking.splat == "blended":
        looking = replace(looking, splat="disc")  # which shows the same nodes, sooner

    def draw(cut: Cut) -> tuple[Camera, Frame]:
        camera = camera_of(layer, options)
        return camera, backend.draw(cut, layer.take, camera, looking)

    return await unveil(layer, occlusion, coarser, wait, draw)


def cut_of(layer: AccessLayer, options: StillOptions, hidden: NDArray[np.bool_] | None = None) -> Cut:
    """Compute the cut of what is here; a budget counts what is known, so that it settles on what will be here."""
    camera, tolerance, index = camera_of(layer, options), options.tolerance, layer.index
    one_sided = not options.style.two_sided
    if options.budget is None:
        return refine(index, camera, tolerance, layer.resident, cull_backfaces=one_sided, hidden=hidden)
    within = allowance(
        index, camera, options.budget, index.known, at_least=tolerance, cull_backfaces=one_sided, hidden=hidden
    )
    return refine_within(index, camera, within, layer.resident, cull_backfaces=one_sided, hidden=hidden)
