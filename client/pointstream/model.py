"""A model for people: open it wherever it is, ask what it holds, read a region as arrays. Everything blocks."""

from __future__ import annotations

import asyncio
import threading
import time
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np

from lpc.codec import cloud_to_points
from lpc.errors import Corrupt, LpcError, StoreError
from lpc.info import info_dict
from lpc.points import PointBatch

from .opening import naming
from .reading import Reader, Region
from .stores import open_store

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Coroutine, Iterator, Sequence
    from types import TracebackType

    from numpy.typing import NDArray

    from lpc.header import Header
    from lpc.index import IndexTree

    from .cache import Cache
    from .stores import Store

T = TypeVar("T")


def open_model(target: str, *, cache: Cache | None = None) -> Model:
    """Open a model with one read of 64 KiB.

    Parameters
    ----------
    target : str
        Path of a .lpc file or http(s) address of one; any start of a file will do.
    cache : Cache, optional
        Where to keep what comes from an address.

    Raises
    ------
    StoreError
        If it cannot be reached.
    FormatError
        If it is no model, or a damaged or newer one.
    """
    loop = _BackgroundLoop()
    try:
        return Model(loop, loop.wait(_open(target, cache)))
    except BaseException:
        loop.stop()
        raise


async def _open(target: str, cache: Cache | None) -> Reader:
    store: Store = open_store(target, clock=time.monotonic, cache=cache)
    try:
        return await Reader.open(store)
    except BaseException:
        await store.close()
        raise


class Model:
    """One model; close it, or use it in a ``with`` block. Made by `open_model`.

    Attributes
    ----------
    index : IndexTree
        The nodes known so far as arrays.
    """

    def __init__(self, loop: _BackgroundLoop, reader: Reader) -> None:
        self._loop, self._reader = loop, reader

    def __repr__(self) -> str:
        return f"<Model {self._reader.store.name}, {self.header.samples} samples in {self.header.nodes} clouds>"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def header(self) -> Header:
        """What the file says about itself."""
        return self._reader.index.header

    @property
    def index(self) -> IndexTree:
        """The index tree, as far as its pages were needed."""
        return self._reader.index

    @property
    def complete(self) -> bool:
        """Whether all of the file is there."""
        return self._reader.complete

    @property
    def info(self) -> dict[str, Any]:
        """What ``pointstream info --json`` prints; reads the index of a file that is cut short."""
        facts = info_dict(self.header)
        if not self._reader.complete:
            nodes = self._loop.wait(self._reader.present())
            facts |= {
                "complete": False,
                "here": {"samples": int(self.index.samples[nodes].sum()), "clouds": len(nodes)},
            }
        return facts

    @property
    def attributes(self) -> dict[str, np.dtype[Any]]:
        """Names of what every sample carries and the dtypes of the values, constants included."""
        stored = {item.name: np.dtype(item.dtype) for item in self.header.attributes}
        return stored | {name: constant.fill(0).dtype for name, constant in self.header.constants.items()}

    @property
    def reach(self) -> tuple[float, float, float, float, float, float]:
        """Box x0, y0, z0, x1, y1, z1 that no decoded sample leaves: the bounds and the position error around them."""
        x0, y0, z0, x1, y1, z1 = self.header.bounds
        error = self.header.position_error
        return x0 - error, y0 - error, z0 - error, x1 + error, y1 + error, z1 + error

    def read(
        self, *, bounds: Sequence[float] | None = None, spacing: float | None = None, level: int | None = None
    ) -> PointBatch:
        """Read samples into memory; without arguments all of them.

        Parameters
        ----------
        bounds : sequence of 6 floats, optional
            x0, y0, z0, x1, y1, z1, model units, both ends included.
        spacing : float, optional
            Detail that is enough, model units.
        level : int, optional
            Deepest level of the tree, 0 for the root alone.

        Returns
        -------
        PointBatch
            In the order of the file, coarse to fine.

        Raises
        ------
        StoreError
            If the host fails or the model is replaced meanwhile.
        Corrupt
            If a page or cloud stays damaged at every try.
        """
        return PointBatch.concatenate(self.batches(bounds=bounds, spacing=spacing, level=level))

    def batches(
        self, *, bounds: Sequence[float] | None = None, spacing: float | None = None, level: int | None = None
    ) -> Iterator[PointBatch]:
        """Read samples cloud by cloud, as `read` does but with a few clouds in memory at a time."""
        return self._loop.iterate(_points(self._reader, _region(bounds, spacing, level)))

    def count(
        self, *, bounds: Sequence[float] | None = None, spacing: float | None = None, level: int | None = None
    ) -> int:
        """Count the samples that `read` would give at most: those of all clouds that it looks into."""
        region = _region(bounds, spacing, level)
        return int(self.index.samples[self._loop.wait(_select(self._reader, region))].sum())

    def close(self) -> None:
        """Close the file or the connections."""
        if self._loop.running:
            self._loop.wait(self._reader.store.close())
            self._loop.stop()


def _region(bounds: Sequence[float] | None, spacing: float | None, level: int | None) -> Region:
    if bounds is None:
        return Region(spacing=spacing, level=level)
    if len(bounds) != 6:
        raise ValueError(f"bounds are six numbers x0,y0,z0,x1,y1,z1, not {len(bounds)}")
    x0, y0, z0, x1, y1, z1 = map(float, bounds)
    return Region(bounds=(x0, y0, z0, x1, y1, z1), spacing=spacing, level=level)


async def _select(reader: Reader, region: Region) -> NDArray[np.int64]:
    try:
        return await reader.select(region)
    except LpcError as error:
        naming(reader.store.name, error)
        raise


async def _points(reader: Reader, region: Region) -> AsyncIterator[PointBatch]:
    nodes = await _select(reader, region)
    if not len(nodes):
        yield _nothing(reader.index.header)
    async for _, cloud in reader.clouds(nodes):
        if isinstance(cloud, Corrupt):
            raise naming(reader.store.name, cloud)
        points = cloud_to_points(cloud, reader.index.header)
        yield points if region.bounds is None else points.take(region.inside(points.xyz))


def _nothing(header: Header) -> PointBatch:
    """No samples, with the model's attributes."""
    shapes = {"normal": (0, 3), "color": (0, 3)}
    values = {item.name: np.empty(shapes.get(item.kind, (0,)), np.dtype(item.dtype)) for item in header.attributes}
    values |= {name: constant.fill(0) for name, constant in header.constants.items()}
    return PointBatch(np.empty((0, 3)), values)


class _BackgroundLoop:
    """An event loop in a thread of its own, for callers without one."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="pointstream", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        return not self._loop.is_closed()

    def wait(self, work: Coroutine[Any, Any, T]) -> T:
        if not self.running:
            work.close()
            raise StoreError("the model is closed: open it again")
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()  # an interrupt of the caller must not leave the work behind
            raise

    def iterate(self, items: AsyncIterator[T]) -> Iterator[T]:
        end = object()

        async def step() -> Any:
            return await anext(items, end)

        try:
            while (item := self.wait(step())) is not end:
                yield item
        finally:
            if self.running:
                self.wait(items.aclose())  # type: ignore[attr-defined]

    def stop(self) -> None:
        async def settle() -> None:
            loop = asyncio.get_running_loop()
            await loop.shutdown_asyncgens()
            await loop.shutdown_default_executor()

        asyncio.run_coroutine_threadsafe(settle(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
