"""The CPU backend: compiled splatting into a key image per thread, shading once per pixel.

The default where there is no graphics hardware, the renderer of batch pictures, and the oracle of OpenGL's tests.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pointview import splats

from . import kernels, picture_kernels, rules, shading, splat_kernels, tables
from .arena import Arena
from .backend import Frame, Style, Take
from .blending import blend, linear_light
from .canvas import Canvas
from .pack import Packer
from .seen import look_ups, place_table

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from lpc.header import Header
    from pointview.camera import Camera
    from pointview.refine import Cut

Result = TypeVar("Result")

FIRST_SAMPLES = 1 << 21
"""Room at the start, samples."""


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
        self._canvas: Canvas | None = None

    @property
    def name(self) -> str:
        """What the report calls this backend."""
        return "cpu"

    def draw(self, cut: Cut, take: Take, camera: Camera, style: Style) -> Frame:
        """Draw a cut."""
        uploads = self._upload(cut.nodes, take)
        shape = (camera.height, camera.width)
        if self._canvas is None or self._canvas.shape != shape:
            self._canvas = Canvas(*shape, self._threads, splat_kernels.padded(*shape))
        canvas = self._canvas
        words, colors = self._vertex.view(np.uint64).ravel(), self._color.view(np.uint32).ravel()
        clouds, cloud_of_block, row_of_block = self._clouds(cut, camera)
        places, halvings = place_table(cut)
        view = self._view(cut, camera, style)
        light = self._light(camera, style)
        rotation = camera.rotation().astype(np.float32)
        rgb, depth = canvas.empty(np.uint8, 3), canvas.empty(np.float32)
        node, starved = canvas.empty(np.int32), canvas.empty(bool)
        side, holes, sources = canvas.side, canvas.holes, canvas.sources
        surface = (255, 255, 255) if self._packer.has_colors else style.surface
        albedo = np.array(surface, dtype=np.float32) / np.float32(255)
        background = np.array(style.background, dtype=np.uint8)

        def splat(worker: int) -> None:
            canvas.keys[worker] = rules.EMPTY  # which brings it into the cache, too
            # Every `threads`-th cloud: neighbours in the array are neighbours in space, and cost alike.
            mine = np.ascontiguousarray(clouds[worker :: self._threads])
            splat_kernels.splat(canvas.keys[worker], words, colors, mine, places, halvings, rotation, view)

        def rows(worker: int) -> tuple[int, int]:
            return camera.height * worker // self._threads, camera.height * (worker + 1) // self._threads

        def resolve(worker: int) -> np.float32:
            return kernels.resolve(
                canvas.keys, *rows(worker), rgb, depth, node, side, starved, words, colors, clouds,
                cloud_of_block, row_of_block, places, halvings, rotation, view, light, albedo, background,
            )  # fmt: skip

        def dim(worker: int) -> None:
            strength = style.edl_strength * camera.focal
            picture_kernels.eye_dome(rgb, depth, side, *rows(worker), strength, shading.NEIGHBOUR, shading.DARKEST)

        def find(worker: int) -> slice:
            largest = min(splats.LARGEST_HOLE, math.ceil(splats.HOLE * widest))
            top, bottom = rows(worker)
            found = picture_kernels.close_holes(
                depth, side, holes, sources, top, bottom, camera.focal,
                splats.HOLE, largest, splats.WALLS, splats.FACES, splats.FACE,
            )  # fmt: skip
            return slice(top * camera.width, top * camera.width + found)

        self._in_parallel(splat)
        widest = max(self._in_parallel(resolve))
        if style.close_holes:
            found = self._in_parallel(find)
            into, out_of = (np.concatenate([pixels[part] for part in found]) for pixels in (holes, sources))
            for image in (rgb.reshape(-1, 3), depth.ravel(), node.ravel(), side.ravel(), starved.ravel()):
                image[into] = image[out_of]
        if style.splat == "blended":
            linear = linear_light()

            def see(samples: NDArray[Any], some: NDArray[Any]) -> int:
                return kernels.seen(
                    samples, self._vertex, self._color, some, places, halvings, rotation, view, light, albedo, linear
                )

            blend(rgb, depth, clouds, see, focal=camera.focal, threads=self._threads, in_parallel=self._in_parallel)
        if not self._packer.has_normals and style.edl_strength > 0:
            self._in_parallel(dim)
        return Frame(
            rgb=rgb,
            depth=depth,
            node=node,
            starved=starved,
            splats=cut.splats,
            clouds=len(cut.nodes),
            uploads=uploads,
        )

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

    def _clouds(self, cut: Cut, camera: Camera) -> tuple[NDArray[Any], NDArray[np.int32], NDArray[np.int64]]:
        """Return the clouds of the frame; the cloud of each block of places, and what to add there for a row."""
        slots = self._arena.slots_of(cut.nodes)
        blocks = (self._arena.count[slots] >> kernels.BLOCK_BITS) + 1
        clouds = np.empty(len(slots), dtype=tables.CLOUD)
        clouds["node"] = cut.nodes
        clouds["first"] = slots * self._samples
        clouds["count"] = self._arena.count[slots]
        clouds["place"] = (np.cumsum(blocks) - blocks) << kernels.BLOCK_BITS
        offset = self._arena.origin[slots] - np.array(camera.eye)
        clouds["x"], clouds["y"], clouds["z"] = offset.T
        clouds["scale"] = self._arena.scale[slots]
        clouds["spacing"], clouds["starved"] = cut.spacing, cut.starved
        clouds["row"], clouds["thin"] = np.arange(len(slots)), self._arena.thin[slots]
        clouds["level"] = look_ups(cut, slice(None), self._arena.thin[slots])
        if cut.places is not None:
            clouds["alone"] = self._arena.scale[slots] * cut.places.alone
            corner = self._arena.origin[slots] - cut.places.corner
            clouds["corner_x"], clouds["corner_y"], clouds["corner_z"] = corner.T
        cloud_of_block = np.repeat(np.arange(len(slots), dtype=np.int32), blocks)
        return clouds, cloud_of_block, (clouds["first"] - clouds["place"])[cloud_of_block]

    def _view(self, cut: Cut, camera: Camera, style: Style) -> Any:
        view = np.zeros(1, dtype=tables.VIEW)[0]
        view["width"], view["height"], view["focal"] = camera.width, camera.height, camera.focal
        view["near"] = cut.depth_range[0]
        view["largest"], view["round"] = splats.LARGEST, splats.ROUND
        view["round_from"] = math.inf if style.splat == "square" else splats.ROUND_FROM
        view["bulge"], view["steepest"] = splats.BULGE, splats.STEEPEST
        view["closing"], view["reach"] = splats.CLOSING * camera.focal, splats.REACH
        view["cull"] = self._packer.has_normals and not style.two_sided
        view["oriented"] = style.splat in ("disc", "blended")
        return view

    def _light(self, camera: Camera, style: Style) -> Any:
        light = np.zeros(1, dtype=tables.LIGHT)[0]
        for name in ("ambient", "diffuse", "specular", "unlit"):
            light[name] = getattr(shading, name.upper())
        light["squarings"] = round(math.log2(shading.SHININESS))
        light["lamp_x"], light["lamp_y"], light["lamp_z"] = shading.lamp() @ camera.rotation()
        light["lit"], light["two_sided"] = self._packer.has_normals, style.two_sided
        return light

    def _in_parallel(self, work: Callable[[int], Result]) -> list[Result]:
        """Call `work(worker)` once for every worker; the first on this thread."""
        others = [] if self._pool is None else [self._pool.submit(work, worker) for worker in range(1, self._threads)]
        return [work(0), *(other.result() for other in others)]


def _grown(array: NDArray[Any], rows: int) -> NDArray[Any]:
    grown = np.empty((rows, *array.shape[1:]), dtype=array.dtype)
    grown[: len(array)] = array
    return grown
