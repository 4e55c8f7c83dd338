"""An access layer to test, closed whatever happens: on any store, or at the end of a simulated line."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from support.hosts import origin_of, virtual_store

from pointlink import virtual
from pointlink.profiles import ADSL
from pointstream.layer import AccessLayer, LayerOptions

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from pointlink.origin import Origin
    from pointlink.profiles import Profile
    from pointstream.stores import Store


@asynccontextmanager
async def opened(store: Store, **options: Any) -> AsyncIterator[AccessLayer]:
    layer = await AccessLayer.open(store, options=LayerOptions(**options))
    try:
        yield layer
    finally:
        await layer.close()


def over_line(
    data: bytes,
    check: Callable[[AccessLayer, Origin], Any],
    profile: Profile = ADSL,
    fault: Any = None,
    **options: Any,
) -> None:
    """Run a check on a layer at the end of a simulated line."""

    async def run() -> None:
        origin = origin_of(data, fault)
        async with virtual_store(origin, profile) as store, opened(store, **options) as layer:
            await check(layer, origin)

    virtual.run(run())
