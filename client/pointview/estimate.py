"""What a view will cost before it is fetched: bytes and seconds to reach a tolerance (`pointstream estimate`).

The refinement of a frame only asks which clouds are here. Told that all known ones are, it walks the index down to the
tolerance and wants nothing but pages; once these have come, its cut is the one that a streaming run ends with. Their
sizes stand in the index, so no cloud is read for it.

Seconds follow the scheduler's own rules (`pointstream.scheduler`): a request is `request_seconds` of the link long, and
costs `overhead` bytes of heads besides its body. Opening costs a round trip for the connection and one for the probe.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.header import HEADER_PROBE
from lpc.page import page_bytes
from pointstream.layer import AccessLayer
from pointstream.options import LayerOptions
from pointstream.stores import open_store

from .camera import Camera
from .refine import Cut, refine
from .settle import settle

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from lpc.index import IndexTree
    from pointlink.profiles import Profile
    from pointstream.cache import Cache
    from pointstream.scheduler import SchedulerOptions


LEFT_OUT = {"occlusion": "only pictures tell what is hidden: counted as seen, a stream with --occlusion may need less"}
"""What an estimate does not know, and why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """The cost of a view.

    Parameters
    ----------
    tolerance : float
        Pixels.
    bytes : int
        Body bytes, from opening the model to the last cloud of the view.
    cloud_bytes, page_bytes : int
        What of them is clouds and pages of the view; the rest is the header, and what else the first request brings.
    clouds, pages, splats : int
    seconds : float or None
        None where nothing is known of the link.
    rate, rtt : float or None
        Bytes per second and seconds that `seconds` was reckoned with.
    bytes_read : int
        What the estimate itself read.
    max_spacing_px : float
        What the view ends at: above the tolerance only where the model has no finer clouds.
    left_out : dict of str to str
        What was not reckoned with, and why.
    """

    tolerance: float
    bytes: int
    cloud_bytes: int
    page_bytes: int
    clouds: int
    pages: int
    splats: int
    seconds: float | None
    rate: float | None
    rtt: float | None
    bytes_read: int
    max_spacing_px: float
    left_out: Mapping[str, str] = field(default_factory=LEFT_OUT.copy)


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimateOptions:
    """Which view to estimate.

    Parameters
    ----------
    width, height : int
        Pixels.
    view : mapping, optional
        A VIEW.json object; the whole model if not given.
    tolerance : float
        Pixels.
    two_sided : bool
        Count clouds that face away too.
    profile : Profile, optional
        The link to reckon with; what was measured while reading pages if not given.
    patience : float
        Seconds to wait for a host that sends nothing.
    """

    width: int = 1024
    height: int = 768
    view: Mapping[str, Any] | None = None
    tolerance: float = 1.0
    two_sided: bool = False
    profile: Profile | None = None
    patience: float = 60.0


def view_bytes(index: IndexTree, nodes: NDArray[np.int64], options: SchedulerOptions) -> int:
    """Bytes of a run that ends with these clouds.

    The first request, and what of the clouds and their pages is behind it; gaps that cost less than another request are
    read with their neighbours.

    Parameters
    ----------
    nodes : (n,) int64
        Known nodes.
    """
    probe = min(HEADER_PROBE, index.header.bytes)
    pages = [index.page_range(page) for page in _pages_read(index)]
    starts = np.concatenate([[0], index.offset[nodes], [page.start for page in pages]])
    stops = np.concatenate([[probe], index.offset[nodes] + index.size[nodes], [page.stop for page in pages]])
    order = np.argsort(starts, kind="stable")
    starts, reached = starts[order], np.maximum.accumulate(stops[order])
    gaps = np.maximum(starts[1:] - reached[:-1], 0)
    return int(reached[-1] - gaps[gaps > options.overhead].sum())


def link_seconds(size: int, rate: float, rtt: float, options: SchedulerOptions) -> float:
    """Seconds in which a link carries so many bytes of a model, from opening the connection.

    Parameters
    ----------
    size : int
        Body bytes.
    rate : float
        Bytes per second.
    rtt : float
        Seconds.
    """
    request = min(max(rate * options.request_seconds, options.smallest_request), options.largest_request)
    heads = (1 + max(0, size - HEADER_PROBE) / request) * options.overhead
    return 2 * rtt + (size + heads) / rate


async def estimate(
    target: str,
    options: EstimateOptions,
    *,
    cache: Cache | None = None,
    progress: Callable[[Cut], None] | None = None,
) -> Estimate:
    """Estimate a view of the model at a path or address; reads the pages of its index that the view needs.

    Raises
    ------
    StoreError, FormatError
        If the model cannot be opened, or the view is none.
    """
    if options.view is not None:
        Camera.from_view(options.view, width=options.width, height=options.height)
    layer = await AccessLayer.open(open_store(target, clock=time.monotonic, cache=cache), clock=time.monotonic)
    try:
        look = partial(_pages_wanted, options=options)
        await settle(layer, look, clock=time.monotonic, patience=options.patience, progress=progress)
        cut, index, stats = _ideal_cut(layer, options), layer.index, layer.stats
        rate, rtt = (stats.goodput, stats.rtt) if stats.measured else (None, None)
        if options.profile is not None:
            rate, rtt = options.profile.down_rate, options.profile.rtt
            rate = None if rate is None else rate / 8
        scheduler = LayerOptions().scheduler
        size = view_bytes(index, cut.nodes, scheduler)
        seconds = None
        if rate is not None and rtt is not None:
            # A view within the first request is there as soon as its last cloud is.
            last = int(np.max(index.offset[cut.nodes] + index.size[cut.nodes], initial=index.header.page0))
            seconds = round(link_seconds(min(size, last), rate, rtt, scheduler), 3)
        return Estimate(
            tolerance=options.tolerance,
            bytes=size,
            cloud_bytes=int(index.size[cut.nodes].sum()),
            page_bytes=sum(page_bytes(index.header, page) for page in _pages_read(index)),
            clouds=len(cut.nodes),
            pages=len(_pages_read(index)),
            splats=cut.splats,
            seconds=seconds,
            rate=rate,
            rtt=rtt,
            bytes_read=stats.bytes_received,
            max_spacing_px=cut.max_spacing_px,
        )
    finally:
        await layer.close()


def _ideal_cut(layer: AccessLayer, options: EstimateOptions) -> Cut:
    """Compute the cut with everything here that is known and can be had."""
    if options.view is None:
        camera = Camera.frame_model(layer.header, width=options.width, height=options.height)
    else:
        camera = Camera.from_view(options.view, width=options.width, height=options.height)
    here = layer.index.known & ~layer.absent
    return refine(layer.index, camera, options.tolerance, here, cull_backfaces=not options.two_sided)


def _pages_wanted(layer: AccessLayer, options: EstimateOptions) -> Cut:
    """Compute what a frame would want if clouds were free: unknown nodes, which stand for their pages."""
    cut = _ideal_cut(layer, options)
    unknown = cut.wants[~layer.index.known[cut.wants]]
    return replace(cut, wants=unknown, nodes=np.empty(0, dtype=np.int64))


def _pages_read(index: IndexTree) -> list[int]:
    return np.flatnonzero(index.page_loaded).tolist()
