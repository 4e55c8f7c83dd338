"""From the options of ``pointstream stream`` to the figures of its report."""

from __future__ import annotations

import asyncio
import os
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pointstream.layer import AccessLayer, LayerOptions
from pointstream.stores import open_store
from pointview.camera import Camera
from pointview.occlusion import Occlusion
from pointview.refine import Priority, SplatRule, refine
from pointview.render import Frame, Style, open_backend
from pointview.settle import settle
from pointview.still import CAPACITY
from pointview.urgency import Contrast

from . import network
from .metrics import psnr_db, ssim
from .report import Report
from .session import Moment, Recording, SessionOptions, record

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import AbstractContextManager

    from lpc.header import Header
    from pointlink.profiles import Profile
    from pointstream.stats import ErrorReport

    from .path import ViewPath

    Progress = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
    """`pointstream.progress.progress`, or what stands in for it."""

MOST_THREADS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """One streaming experiment.

    Parameters
    ----------
    model : str
        Path or http(s) address of a .lpc file.
    link : str
        The link as it was asked for.
    profile : Profile
        The link.
    clock : {"real", "virtual"}
    seconds : float
    size : (int, int)
        Width and height, pixels.
    tolerance : float
        Pixels.
    priority : {"index", "error"}
    splat_rule : {"place", "paper"}
    occlusion : {"auto", "off"}
    prefetch : {"auto", "off"}
    views : ViewPath, optional
        Where the camera is; the whole model without.
    """

    model: str
    link: str
    profile: Profile
    clock: network.ClockKind
    seconds: float
    size: tuple[int, int]
    tolerance: float
    priority: Priority
    splat_rule: SplatRule = "place"
    occlusion: Literal["auto", "off"] = "off"
    prefetch: Literal["auto", "off"] = "auto"
    views: ViewPath | None = None

    def camera_at(self, header: Header, t: float) -> Camera:
        """Return the camera at a time in seconds."""
        width, height = self.size
        if self.views is None:
            return Camera.frame_model(header, width=width, height=height)
        return Camera.from_view(self.views.at(t), width=width, height=height)

    @property
    def session(self) -> SessionOptions:
        """What the frame loop needs to know."""
        return SessionOptions(
            seconds=self.seconds,
            tolerance=self.tolerance,
            priority=self.priority,
            splat_rule=self.splat_rule,
            occlusion=self.occlusion == "auto",
            prefetch=self.prefetch == "auto",
            threads=min(os.cpu_count() or 1, MOST_THREADS),
        )


def run_experiment(
    experiment: Experiment, *, say: Callable[[str], None], progress: Progress
) -> tuple[Report, list[Moment]]:
    """Run an experiment and compare its pictures with the same views fully resident.

    Parameters
    ----------
    say : callable
        Told what is going on, a line at a time.
    progress : callable
        Shows how far a stage with so many steps is.

    Raises
    ------
    StoreError, FormatError
        If the model cannot be opened, over the link or without it.
    """
    # The first reference comes first: it loads the compiled kernels, which would hold a real clock's first frames up.
    say("drawing the whole view for comparison")
    references, lacks = asyncio.run(_references(experiment, [0.0]))
    say(f"streaming for {experiment.seconds:g} s ({experiment.clock} clock) over {experiment.profile}")
    with progress("streaming, seconds", max(1, int(experiment.seconds))) as advance:
        recording = network.run(experiment.clock, _stream(experiment, _whole_seconds(advance)))
    if experiment.views is not None and experiment.views.moves:
        say("drawing the path for comparison")
        references, lacks = asyncio.run(_references(experiment, [moment.t for moment in recording.moments]))
    else:
        references = references * len(recording.moments)
    with progress("comparing pictures", len(recording.moments)) as advance:
        curve = []
        for moment, reference in zip(recording.moments, references, strict=True):
            curve.append(_entry(moment, reference))
            advance(1)
    return _report(experiment, recording, curve, lacks), recording.moments


def _whole_seconds(advance: Callable[[int], None]) -> Callable[[float], None]:
    """Turn times into steps of a second."""
    told = 0

    def tell(t: float) -> None:
        nonlocal told
        if (whole := int(t)) > told:
            advance(whole - told)
            told = whole

    return tell


async def _stream(experiment: Experiment, tell: Callable[[float], None]) -> Recording:
    clock = asyncio.get_running_loop().time
    async with network.open_link(experiment.model, experiment.profile, experiment.clock) as connect:
        opening = AccessLayer.open(connect(), options=LayerOptions(capacity=CAPACITY), clock=clock)
        return await record(opening, experiment.camera_at, experiment.session, clock, tell=tell)


async def _references(experiment: Experiment, times: Sequence[float]) -> tuple[list[Frame], list[str]]:
    """Draw the views at these times with everything resident, straight from the model; and say what they lack."""
    style, threads = Style(), experiment.session.threads
    store = open_store(experiment.model, clock=time.monotonic)
    layer = await AccessLayer.open(store, options=LayerOptions(capacity=CAPACITY), clock=time.monotonic)
    try:
        backend = open_backend(experiment.session.backend, layer.header, threads=threads)
        try:
            frames = []
            for t in times:
                camera = experiment.camera_at(layer.header, t)
                look = partial(_look, camera=camera, tolerance=experiment.tolerance)
                cut = await settle(layer, look, clock=time.monotonic)
                frames.append(backend.draw(cut, layer.take, camera, style))
                # A session looks at its pictures: the kernels of that are to be loaded as well.
                Contrast(layer.header.nodes).look(layer.index, cut, camera, frames[-1])
                Occlusion(layer.header.nodes).look(layer.index, cut, camera, frames[-1])
            return frames, [_line(error) for error in layer.stats.errors]
        finally:
            backend.close()
    finally:
        await layer.close()


def _look(layer: AccessLayer, *, camera: Camera, tolerance: float) -> Any:
    return refine(layer.index, camera, tolerance, layer.resident)


def _line(error: ErrorReport) -> str:
    return f"{error.text} ({error.count} times)"


def _report(
    experiment: Experiment, recording: Recording, curve: Sequence[dict[str, Any]], lacks: Sequence[str]
) -> Report:
    assert recording.stats is not None
    assert recording.header is not None
    stats, rate = recording.stats, experiment.profile.down_rate
    could_carry = None if rate is None else rate / 8.0 * stats.wanted_seconds
    carried = max(0, stats.payload_bytes - stats.idle_bytes)  # what came while nothing was wanted is not to its credit
    return Report(
        model=experiment.model,
        link=experiment.link,
        clock=experiment.clock,
        priority=experiment.priority,
        splat_rule=experiment.splat_rule,
        occlusion=experiment.occlusion,
        prefetch=experiment.prefetch,
        occluded=recording.occluded,
        left_out=recording.left_out,
        size=experiment.size,
        seconds=experiment.seconds,
        samples=recording.samples,
        bytes=stats.bytes_received,
        requests=stats.requests,
        link_utilisation=None if not could_carry else min(1.0, carried / could_carry),
        first_picture_s=recording.first_picture_s,
        settled_s=recording.settled_s,
        tolerance=experiment.tolerance,
        model_samples=recording.header.samples,
        model_bytes=recording.header.bytes,
        payload_bytes=stats.payload_bytes,
        speculative_bytes=stats.speculative_bytes,
        idle_bytes=stats.idle_bytes,
        wasted_bytes=stats.wasted_bytes,
        wanted_s=stats.wanted_seconds,
        frames=recording.frames,
        errors=(
            *map(_line, stats.errors),
            *(f"the pictures that the curve compares with lack data too: {text}" for text in lacks),
        ),
        curve=tuple(curve),
    )


def _entry(moment: Moment, reference: Frame) -> dict[str, Any]:
    """One entry of the curve, by the contract's names."""
    picture = moment.picture()
    covered = picture.covered | (reference.node >= 0)
    same = bool(np.array_equal(picture.rgb, reference.rgb))
    return {
        "t": round(moment.t, 6),
        "bytes": moment.stats.bytes_received,
        "requests": moment.stats.requests,
        "resident_clouds": moment.stats.resident_clouds,
        "splats": moment.splats,
        "starved_fraction": picture.starved_fraction,
        "max_spacing_px": moment.max_spacing_px,
        "psnr_db": None if same else psnr_db(picture.rgb, reference.rgb, covered),
        "ssim": 1.0 if same else ssim(picture.rgb, reference.rgb, covered),
    }
