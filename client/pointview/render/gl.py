"""The OpenGL backend: clouds stay quantised in GPU memory, and a frame is one draw.

Memory is an arena of equal slots, fixed when the backend is opened. A cut that is larger than the arena is drawn in
several passes over the same depth buffer, each of which is one call of OpenGL (`gl_memory`).

A GL context belongs to the thread that made it: open, draw and close on one thread.
"""

from __future__ import annotations

import math
import re
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np

from lpc.errors import Unavailable
from pointview import splats

from . import shading
from .arena import Arena
from .backend import Frame, Style, Take
from .blending import LEAST
from .gl_memory import COMMANDS_FROM, PLACEMENT, Buffers, Memory, Textures
from .pack import SAMPLE_BYTES, Packer
from .seen import look_ups
from .tables import STEPS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.header import Header
    from pointview.camera import Camera
    from pointview.refine import Cut

ARENA_BYTES = 512 << 20
EMPTY = float(np.finfo(np.float32).max)
"""Depth of a pixel without sample on the GPU, which need not know infinity."""

PLACES_UNIT = 7
"""Texture unit; the passes over the picture use the first ones."""

STARVED = 1 << 30
"""Added to the row of a node that is starved everywhere."""

PLACES_WIDTH = 1024
"""Texels in a row of the texture of places: first one for each level, then one for each of its rows."""


class GlBackend:
    """Draws on the GPU, off screen.

    Parameters
    ----------
    arena_bytes : int
        GPU memory for clouds.
    indirect : bool or None
        Use the indirect multi-draw; None: where OpenGL has it.

    Raises
    ------
    Unavailable
        If no OpenGL 3.3 context can be made.
    """

    def __init__(self, header: Header, *, arena_bytes: int = ARENA_BYTES, indirect: bool | None = None) -> None:
        self._packer = Packer(header)
        self._samples = min(int(header.cloud_size), int(header.samples))
        self._context = _context()
        self.renderer = str(self._context.info["GL_RENDERER"])
        has_commands = self._context.version_code >= COMMANDS_FROM
        self._indirect = has_commands and indirect is not False
        slots = max(1, min(header.nodes, arena_bytes // (self._samples * SAMPLE_BYTES)))
        try:
            self._build(slots)
        except moderngl.Error as error:
            self._context.release()
            raise Unavailable(f"OpenGL ({self.renderer}) failed: {_one_line(error)}; use --backend cpu") from error
        self._arena = Arena(header.nodes, self._memory.slots)
        self._largest = min(splats.LARGEST, float(self._context.info["GL_POINT_SIZE_RANGE"][1]) / 1.5)
        self._margin = math.ceil(self._largest)

    @property
    def name(self) -> str:
        """What the report calls this backend."""
        return f"gl ({self.renderer})"

    def draw(self, cut: Cut, take: Take, camera: Camera, style: Style) -> Frame:
        """Draw a cut."""
        with self._context:  # another backend's may be current on this thread
            return self._draw(cut, take, camera, style)

    def _draw(self, cut: Cut, take: Take, camera: Camera, style: Style) -> Frame:
        self._resize(camera.width, camera.height)
        self._clear(style)
        self._write_places(cut)
        self._splatted.target.use()
        self._context.enable_only(moderngl.DEPTH_TEST | moderngl.PROGRAM_POINT_SIZE)
        self._context.depth_func = "<"
        uploads = self._draw_samples(self._splats, self._splatted.target, cut, take, camera, style)
        layers = self._splatted
        if style.close_holes:
            layers = self._close_holes(layers, camera)
        picture, image = layers.target, layers.images["picture"]
        if style.splat == "blended":
            uploads += self._blend(layers, cut, take, camera, style)
            picture, image = self._blended.picture, self._blended.image
        if not self._packer.has_normals and style.edl_strength > 0:
            picture = self._eye_dome(image, layers, camera, style)
        return self._read(picture, layers, camera, cut, uploads)

    def close(self) -> None:
        """Release the context and all that it holds."""
        self._context.release()

    def _build(self, slots: int) -> None:
        context = self._context
        kind = Buffers if self._indirect else Textures
        self._memory: Memory = kind(context, slots, self._samples)
        self._placements = np.zeros(slots, dtype=PLACEMENT)
        self._splats, self._kernels = (
            _Samples(context, self._memory, name, define)
            for name, define in (("splat.frag.glsl", ""), ("blend.frag.glsl", "#define BLENDED\n"))
        )
        self._closer, self._dimmer, self._mean = (
            context.program(vertex_shader=_shader("picture.vert.glsl"), fragment_shader=_shader(name))
            for name in ("close_holes.frag.glsl", "eye_dome.frag.glsl", "mean.frag.glsl")
        )
        self._closing = context.vertex_array(self._closer, [])
        self._dimming = context.vertex_array(self._dimmer, [])
        self._averaging = context.vertex_array(self._mean, [])
        self._size = (0, 0)
        self._places = context.texture((PLACES_WIDTH, 1), 4, dtype="f4")

    def _resize(self, width: int, height: int) -> None:
        if self._size == (width, height):
            return
        context, size = self._context, (width, height)
        try:
            depth_buffer = context.depth_texture(size)
            self._splatted = _Layers(context, size, depth_buffer)
            self._closed = _Layers(context, size)
            self._blended = _Sums(context, size)
            self._dimmed = context.framebuffer([context.texture(size, 4)])
        except moderngl.Error as error:
            raise Unavailable(f"OpenGL cannot draw {width}x{height} pixels: {_one_line(error)}") from error
        self._size = size

    def _clear(self, style: Style) -> None:
        red, green, blue = (channel / 255 for channel in style.background)
        self._splatted.target.clear(red, green, blue, 1.0, depth=1.0)
        self._splatted.only_depth.clear(EMPTY, 0.0)  # moderngl clears all attachments of a target to one colour

    def _draw_samples(self, samples: _Samples, target: Any, cut: Cut, take: Take, camera: Camera, style: Style) -> int:
        """Draw a cut into the target in use; return how many clouds had to be written."""
        margin = self._margin
        # OpenGL drops a point whose centre is outside the viewport, even if its splat reaches in.
        target.viewport = (-margin, -margin, camera.width + 2 * margin, camera.height + 2 * margin)
        samples.tell(self._told(cut, camera, style))
        uploads = 0
        for start in range(0, len(cut.nodes), self._arena.slots):
            part = slice(start, start + self._arena.slots)
            uploads += self._upload(cut.nodes[part], take)
            self._submit(samples, cut, part, camera)
        return uploads

    def _told(self, cut: Cut, camera: Camera, style: Style) -> dict[str, Any]:
        """Return the uniforms of the shaders of samples."""
        near, far = cut.depth_range
        surface = (255, 255, 255) if self._packer.has_colors else style.surface
        return {
            "rotation": tuple(camera.rotation().T.ravel()),  # column by column
            "size": (camera.width, camera.height),
            "margin": self._margin,
            "focal": camera.focal,
            "range": (near, (1 + 2 * splats.BULGE) * far),  # the rim of a disc is behind its centre
            "largest": self._largest,
            "round_from": self._largest if style.splat == "square" else splats.ROUND_FROM,
            "round_factor": splats.ROUND,
            "bulge": splats.BULGE,
            "steepest": splats.STEEPEST,
            "reach": splats.REACH,
            "closing": splats.CLOSING * camera.focal,
            "oriented": style.splat in ("disc", "blended"),
            "albedo": tuple(channel / 255 for channel in surface),
            "lamp": tuple(shading.lamp().tolist()),
            "lit": self._packer.has_normals,
            "two_sided": style.two_sided,
            "places": PLACES_UNIT,
            "levels": 0 if cut.places is None else len(cut.places.axis),
            "spreads": 0 if cut.places is None else len(cut.places.axis) + len(cut.places.link),
        }

    def _upload(self, nodes: NDArray[np.int64], take: Take) -> int:
        absent, slots = self._arena.place(nodes)
        for done, (node, slot) in enumerate(zip(absent.tolist(), slots.tolist(), strict=True)):
            try:
                packed = self._packer.pack(take(node), self._samples)
            except BaseException:
                self._arena.forget(absent[done:])
                raise
            self._memory.write(slot, packed)
            self._arena.put(slot, packed)
        return len(absent)

    def _write_places(self, cut: Cut) -> None:
        """Give the vertex shader the places of a cut: halvings (axis, half), nodes (links, spacings), spreads."""
        if cut.places is None:
            return
        levels, count = len(cut.places.axis), len(cut.places.link)
        rows = -(-(levels + count + -(-count // 4)) // PLACES_WIDTH)
        if self._places.height < rows:
            self._places.release()
            self._places = self._context.texture((PLACES_WIDTH, 1 << (rows - 1).bit_length()), 4, dtype="f4")
        texels = np.zeros((rows * PLACES_WIDTH, 4), dtype="<f4")
        texels[:levels, 0], texels[:levels, 1] = cut.places.axis, cut.places.half
        texels[levels : levels + count, :2] = cut.places.link
        texels[levels : levels + count, 2:] = cut.places.spacing
        texels.reshape(-1)[4 * (levels + count) :][:count] = cut.places.spread
        self._places.write(texels, viewport=(0, 0, PLACES_WIDTH, rows))
        self._places.use(PLACES_UNIT)

    def _submit(self, samples: _Samples, cut: Cut, part: slice, camera: Camera) -> None:
        """Draw nodes that are in the arena."""
        nodes = cut.nodes[part]
        slots = self._arena.slots_of(nodes)
        placement = self._placements[: len(nodes)]
        placement["offset"] = self._arena.origin[slots] - np.array(camera.eye)
        placement["scale"] = self._arena.scale[slots]
        placement["side"] = cut.spacing[part] * (splats.CLOSING * camera.focal)
        placement["node"], placement["count"] = nodes, self._arena.count[slots]
        placement["row"] = np.arange(part.start, part.start + len(nodes)) + cut.starved[part] * STARVED
        placement["level"] = look_ups(cut, part, self._arena.thin[slots])
        if cut.places is not None:
            placement["corner"] = self._arena.origin[slots] - cut.places.corner[part]
            alone = self._arena.scale[slots] * cut.places.alone[part]
            placement["side"] = np.where(placement["level"] < 0, placement["side"], alone)
        self._memory.draw(samples.points, slots, placement)

    def _close_holes(self, layers: _Layers, camera: Camera) -> _Layers:
        self._closed.target.use()
        self._context.enable_only(moderngl.NOTHING)
        for unit, (name, image) in enumerate(layers.images.items()):
            image.use(unit)
            self._closer[name].value = unit
        self._closer["focal"].value = camera.focal
        self._closing.render(moderngl.TRIANGLES, vertices=3)
        return self._closed

    def _blend(self, layers: _Layers, cut: Cut, take: Take, camera: Camera, style: Style) -> int:
        """Show the mean of the samples in the picture of discs; see `blending`."""
        blended = self._blended
        blended.target.use()
        blended.target.clear()
        self._context.enable_only(moderngl.BLEND | moderngl.PROGRAM_POINT_SIZE)
        self._context.blend_func = moderngl.ONE, moderngl.ONE
        layers.images["depths"].use(0)
        self._kernels.program["depths"].value = 0
        uploads = self._draw_samples(self._kernels, blended.target, cut, take, camera, style)
        blended.picture.use()
        self._context.enable_only(moderngl.NOTHING)
        for unit, (name, image) in enumerate((("picture", layers.images["picture"]), ("sums", blended.sums))):
            image.use(unit)
            self._mean[name].value = unit
        self._averaging.render(moderngl.TRIANGLES, vertices=3)
        return uploads

    def _eye_dome(self, picture: Any, layers: _Layers, camera: Camera, style: Style) -> Any:
        self._dimmed.use()
        self._context.enable_only(moderngl.NOTHING)
        for unit, (name, image) in enumerate((("picture", picture), ("depths", layers.images["depths"]))):
            image.use(unit)
            self._dimmer[name].value = unit
        self._dimmer["strength"].value = style.edl_strength * camera.focal
        self._dimming.render(moderngl.TRIANGLES, vertices=3)
        return self._dimmed

    def _read(self, picture: Any, layers: _Layers, camera: Camera, cut: Cut, uploads: int) -> Frame:
        shape, viewport = (camera.height, camera.width), (0, 0, camera.width, camera.height)
        rgba = np.frombuffer(picture.read(viewport, components=4), dtype=np.uint8).reshape(*shape, 4)
        read = layers.target.read
        depths = np.frombuffer(read(viewport, components=2, attachment=1, dtype="f4"), dtype="<f4")
        depth, side = np.moveaxis(depths.reshape(*shape, 2)[::-1], 2, 0)
        node = np.frombuffer(read(viewport, components=1, attachment=2, dtype="i4"), dtype="<i4").reshape(shape)[::-1]
        empty = depth >= EMPTY
        node = np.where(empty, np.int32(-1), node)
        return Frame(
            rgb=np.ascontiguousarray(rgba[::-1, :, :3]),
            depth=np.where(empty, np.float32(np.inf), depth),
            node=node,
            starved=(side < 0) & ~empty,
            splats=cut.splats,
            clouds=len(cut.nodes),
            uploads=uploads,
        )


class _Layers:
    """What a frame consists of before it is a picture: images of colour, of depth and side, of nodes."""

    def __init__(self, context: Any, size: tuple[int, int], depth_buffer: Any = None) -> None:
        self.images = {
            "picture": context.texture(size, 4),
            "depths": context.texture(size, 2, dtype="f4"),
            "nodes": context.texture(size, 1, dtype="i4"),
        }
        for image in self.images.values():
            image.filter = (moderngl.NEAREST, moderngl.NEAREST)  # others make an integer texture unreadable
        self.target = context.framebuffer(list(self.images.values()), depth_buffer)
        self.only_depth = context.framebuffer([self.images["depths"]])


class _Sums:
    """The sums of blended samples, and the picture that is made of them."""

    def __init__(self, context: Any, size: tuple[int, int]) -> None:
        self.sums, self.image = context.texture(size, 4, dtype="f4"), context.texture(size, 4)
        self.target, self.picture = (context.framebuffer([texture]) for texture in (self.sums, self.image))


class _Samples:
    """A pass over the samples of a cut."""

    def __init__(self, context: Any, memory: Memory, fragment: str, defines: str) -> None:
        shaders = _shader("splat.vert.glsl", memory.defines + defines), _shader(fragment, defines)
        self.program = context.program(vertex_shader=shaders[0], fragment_shader=shaders[1])
        self.points = memory.points(self.program)

    def tell(self, values: dict[str, Any]) -> None:
        """Set the uniforms that this pass has."""
        for name, value in values.items():
            if name in self.program:
                self.program[name].value = value


def _context() -> Any:
    """Make an off-screen context: through EGL where there is one, else as moderngl does on this system."""
    problems = []
    choices: list[dict[str, Any]] = [{"backend": "egl"}, {}]
    for options in choices:
        try:
            return moderngl.create_context(standalone=True, require=330, **options)
        except Exception as error:  # moderngl and glcontext raise bare Exception, ImportError and more
            problems.append(_one_line(error))
    raise Unavailable(f"no OpenGL 3.3 here ({'; '.join(problems)}): use --backend cpu")


def _shader(name: str, defines: str = "") -> str:
    """Text of a shader: GLSL with the constants of `splats` and `shading` for @NAME@."""
    text = (files(__package__) / "shaders" / name).read_text(encoding="utf-8")
    kinds = "".join(f"#define {kind} {number}\n" for number, kind in enumerate(("POINT", "SQUARE", "BALL", "DISC")))
    constants = {**vars(splats), **vars(shading), "EMPTY": EMPTY, "LEAST": LEAST, "STEPS": STEPS}

    def constant(match: re.Match[str]) -> str:
        value = constants[match[1]]
        return str(value) if match[1] in ("WALLS", "FACES", "LARGEST_HOLE") else f"{float(value):.9e}"

    return f"#version 330\n{defines}{kinds}{re.sub('@([A-Z_]+)@', constant, text)}"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]
