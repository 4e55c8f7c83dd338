"""Fetching one view until there is nothing left to fetch: what a still picture waits for and a window never does."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from lpc.errors import Unavailable

if TYPE_CHECKING:
    from collections.abc import Callable

    from pointstream.layer import AccessLayer

    from .refine import Cut

PAUSE = 0.02
"""Seconds between two looks at a host that does not answer."""

LOOK = 0.25
"""Seconds between two looks while data comes."""


async def settle(
    layer: AccessLayer,
    look: Callable[[AccessLayer], Cut],
    *,
    clock: Callable[[], float],
    patience: float = 60.0,
    progress: Callable[[Cut], None] | None = None,
) -> Cut:
    """Refine and fetch in turn until the cut misses nothing that can be had.

    Parameters
    ----------
    look : callable
        Computes the cut from what the layer holds now.
    clock : callable
        Seconds, monotonic.
    patience : float
        Seconds without anything new after which what is here has to do.
    progress : callable, optional
        Told every cut on the way.

    Raises
    ------
    Unavailable
        If nothing at all could be had.
    """
    seen, since = -1, clock()
    while True:
        cut = look(layer)
        layer.end_frame(cut.asks, pinned=cut.nodes)
        if progress is not None:
            progress(cut)
        stats = layer.stats
        arrived = stats.resident_clouds + stats.evicted + int(layer.index.page_loaded.sum())
        if arrived != seen:
            seen, since = arrived, clock()
        if not layer.wanting or clock() - since > patience:
            break
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(layer.idle(), LOOK)
        if layer.wanting:
            await asyncio.sleep(PAUSE)
    if not len(cut.nodes) and stats.errors:
        raise Unavailable(stats.errors[0].text)
    return cut
