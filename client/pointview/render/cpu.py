"""The CPU backend: compiled splatting into a key image per thread, shading once per pixel.

The default where there is no graphics hardware, the renderer of batch pictures, and the oracle of OpenGL's tests.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from pointview.splats import CLOSING, LARGEST, ROUND, ROUND_FROM

from . import kernels
from .arena import Arena
from .backend import Frame, Style, Take, starved_pixels
from .pack import Packer
from .shading import RADIUS, lamp

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from lpc.header import Header
    from pointview.camera import Camera
    from pointview.refine import Cut

FIRST_SAMPLES = 1 << 21
"""Room at the start, samples."""


@dataclass(frozen=True, slots=True)
class _Draw:
    """The arrays of one frame, a row for each cloud."""

    nodes: NDArray[np.int64]
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    place: NDArray[np.int64]
    offset: NDArray[np.float32]
    scale: NDArray[np.float32]
    size: NDArray[np.float32]

    def every(self, step: int, first: int) -> _Draw:
        """Every `step`-th cloud: neighbours in the array are neighbours in space and cost alike."""
        return _Draw(*(np.ascontiguousarray(getattr(self, item.name)[first::step]) for item in fields(self)))


class CpuBackend:
    """Draws on `threads` threads; the picture is the same for any number of them.

    Memory grows with the largest cut drawn so far: 12 bytes a sample.
    """

    def __init__(self, header: Header, *, threads: int = 1) -> None:
        self._packer = Packer(header)
        self._samples = min(int(header.cloud_size), int(header.samples))
        self._threads = max(1, threads)
        self._pool = ThreadPoolExecutor(self._threads - 1, thread_name_prefix="splat") if threads > 1 else None
        self._arena = Arena(header.nodes, max(1, min(header.nodes, FIRST_SAMPLES // self._samples)))
        self._vertex = np.empty((self._arena.slots * self._samples, 4), dtype=np.uint16)
        self._color = np.empty((self._arena.slots * self._samples, 4), dtype=np.uint8)
        self._layers = np.empty((self._threads, 0, 0), dtype=np.uint64)

    @property
    def name(self) -> str:
        """What the report calls this backend."""
        return "cpu"

    def draw(self, cut: Cut, take: Take, camera: Camera, style: Style) -> Frame:
        """Draw a cut."""
        uploads = self._upload(cut.nodes, take)
        draw = self._arrays(cut, camera)
        shape = (camera.height, camera.width)
        if self._layers.shape[1:] != shape:
            self._layers = np.empty((self._threads, *shape), dtype=np.uint64)
        rotation = camera.rotation().astype(np.float32)
        near, _ = cut.depth_range

        def splat(worker: int) -> None:
            mine = draw.every(self._threads, worker)
            self._layers[worker] = kernels.EMPTY
            kernels.splat(
                self._layers[worker], self._vertex, mine.first, mine.count, mine.place, mine.offset, mine.scale,
                mine.size, rotation, camera.focal, near, LARGEST, ROUND_FROM, ROUND,
                self._packer.has_normals and not style.two_sided,
            )  # fmt: skip

        self._in_parallel(splat)
        return self._resolve(draw, cut, camera, style, rotation, uploads)

    def close(self) -> None:
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def _upload(self, nodes: NDArray[np.int64], take: Take) -> int:
        if len(nodes) > self._arena.slots:
            self._arena.grow(1 << (len(nodes) - 1).bit_length())
            self._vertex = _grown(self._vertex, self._arena.slots * self._samples)
            self._color = _grown(self._color, self._arena.slots * self._samples)
        absent, slots = self._arena.place(nodes)
        for done, (node, slot) in enumerate(zip(absent.tolist(), slots.tolist(), strict=True)):
            try:
                packed = self._packer.pack(take(node), self._samples)
            except BaseException:
                self._arena.forget(absent[done:])
                raise
            start = slot * self._samples
            self._vertex[start : start + len(packed.vertex)] = packed.vertex
            self._color[start : start + len(packed.color)] = packed.color
            self._arena.put(slot, packed)
        return len(absent)

    def _arrays(self, cut: Cut, camera: Camera) -> _Draw:
        slots = self._arena.slots_of(cut.nodes)
        count = self._arena.count[slots]
        blocks = np.cumsum((count >> kernels.BLOCK_BITS) + 1)
        return _Draw(
            nodes=cut.nodes,
            first=slots * self._samples,
            count=count,
            place=np.concatenate([[0], blocks[:-1]]).astype(np.int64) << kernels.BLOCK_BITS,
            offset=(self._arena.origin[slots] - np.array(camera.eye)).astype(np.float32),
            scale=self._arena.scale[slots].astype(np.float32),
            size=(cut.spacing * (CLOSING * camera.focal)).astype(np.float32),
        )

    def _resolve(
        self, draw: _Draw, cut: Cut, camera: Camera, style: Style, rotation: NDArray[np.float32], uploads: int
    ) -> Frame:
        shape = (camera.height, camera.width)
        rgb = np.empty((*shape, 3), dtype=np.uint8)
        depth = np.empty(shape, dtype=np.float32)
        node = np.empty(shape, dtype=np.int32)
        lit = self._packer.has_normals
        surface = (255, 255, 255) if self._packer.has_colors else style.surface
        albedo = np.array(surface, dtype=np.float32) / np.float32(255)
        background = np.array(style.background, dtype=np.uint8)
        cloud_of_block = np.repeat(np.arange(len(draw.nodes), dtype=np.int32), (draw.count >> kernels.BLOCK_BITS) + 1)

        dims = not lit and style.edl_strength > 0
        factor = style.edl_strength * camera.focal / (8 * RADIUS)

        def rows(worker: int) -> tuple[int, int]:
            return camera.height * worker // self._threads, camera.height * (worker + 1) // self._threads

        def resolve(worker: int) -> None:
            kernels.resolve(
                self._layers, *rows(worker), rgb, depth, node, self._vertex, self._color, cloud_of_block, draw.place,
                draw.first, draw.nodes, draw.offset, draw.scale, rotation, albedo, background, lamp(), lit,
                style.two_sided,
            )  # fmt: skip

        self._in_parallel(resolve)
        if dims:
            self._in_parallel(lambda worker: kernels.eye_dome(rgb, depth, *rows(worker), factor))
        return Frame(
            rgb=rgb,
            depth=depth,
            node=node,
            starved=starved_pixels(node, cut),
            splats=cut.splats,
            clouds=len(cut.nodes),
            uploads=uploads,
        )

    def _in_parallel(self, work: Callable[[int], None]) -> None:
        """Call `work(worker)` once for every worker; the first on this thread."""
        others = [] if self._pool is None else [self._pool.submit(work, worker) for worker in range(1, self._threads)]
        work(0)
        for other in others:
            other.result()


def _grown(array: NDArray[Any], rows: int) -> NDArray[Any]:
    grown = np.empty((rows, *array.shape[1:]), dtype=array.dtype)
    grown[: len(array)] = array
    return grown
