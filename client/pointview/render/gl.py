"""The OpenGL backend: clouds stay quantised in GPU memory, and a frame is one indirect multi-draw.

Memory is an arena of equal slots, fixed when the backend is opened. A cut that is larger than the arena is drawn in
several passes over the same depth buffer. From OpenGL 4.3 on all clouds of a pass are one
`glMultiDrawArraysIndirect`: each command picks its cloud's parameters by its base instance. Below that, each cloud is
a draw with uniforms of its own; same shader, same picture.

A GL context belongs to the thread that made it: open, draw and close on one thread.
"""

from __future__ import annotations

import math
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np

from lpc.errors import Unavailable
from pointview.splats import CLOSING, LARGEST, ROUND, ROUND_FROM

from . import shading
from .arena import Arena
from .backend import Frame, Style, Take, starved_pixels
from .pack import SAMPLE_BYTES, Packer

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.header import Header
    from pointview.camera import Camera
    from pointview.refine import Cut

ARENA_BYTES = 512 << 20
COMMANDS_FROM = 430
"""First version with multi-draw-indirect, 100 * major + 10 * minor."""

EMPTY = float(np.finfo(np.float32).max)
"""Depth of a pixel without sample on the GPU, which need not know infinity."""

COMMAND = np.dtype([(name, "<u4") for name in ("count", "instances", "first", "base_instance", "padding")])
"""glMultiDrawArraysIndirect's command, padded: moderngl steps 20 bytes from one to the next."""

PLACEMENT = np.dtype([("offset", "<f4", 3), ("placement", "<f4", 2), ("node", "<i4")])


class GlBackend:
    """Draws on the GPU, off screen.

    Parameters
    ----------
    arena_bytes : int
        GPU memory for clouds.
    one_draw : bool or None
        Use the indirect multi-draw; None: where OpenGL has it.

    Raises
    ------
    Unavailable
        If no OpenGL 3.3 context can be made.
    """

    def __init__(self, header: Header, *, arena_bytes: int = ARENA_BYTES, one_draw: bool | None = None) -> None:
        self._packer = Packer(header)
        self._samples = min(int(header.cloud_size), int(header.samples))
        self._context = _context()
        self.renderer = str(self._context.info["GL_RENDERER"])
        has_commands = self._context.version_code >= COMMANDS_FROM
        self._one_draw = has_commands if one_draw is None else one_draw and has_commands
        slots = max(1, min(header.nodes, arena_bytes // (self._samples * SAMPLE_BYTES)))
        self._arena = Arena(header.nodes, slots)
        try:
            self._build(slots)
        except moderngl.Error as error:
            self._context.release()
            raise Unavailable(f"OpenGL ({self.renderer}) failed: {_one_line(error)}; use --backend cpu") from error
        self._largest = min(LARGEST, (float(self._context.info["GL_POINT_SIZE_RANGE"][1]) - 2.0) / ROUND)
        self._margin = math.ceil(self._largest * ROUND / 2) + 1

    @property
    def name(self) -> str:
        """What the report calls this backend."""
        return f"gl ({self.renderer})"

    def draw(self, cut: Cut, take: Take, camera: Camera, style: Style) -> Frame:
        """Draw a cut."""
        context = self._context
        self._resize(camera.width, camera.height)
        self._target.use()
        self._clear(style)
        # OpenGL drops a point whose centre is outside the viewport, even if its splat reaches in.
        margin = self._margin
        self._target.viewport = (-margin, -margin, camera.width + 2 * margin, camera.height + 2 * margin)
        context.enable_only(moderngl.DEPTH_TEST | moderngl.PROGRAM_POINT_SIZE)
        context.depth_func = "<"
        self._set_uniforms(camera, style, cut.depth_range)
        uploads = 0
        for start in range(0, len(cut.nodes), self._arena.slots):
            part = slice(start, start + self._arena.slots)
            uploads += self._upload(cut.nodes[part], take)
            self._submit(cut.nodes[part], cut.spacing[part], camera)
        source = self._target
        if not self._packer.has_normals and style.edl_strength > 0:
            self._eye_dome(camera, style)
            source = self._dimmed
        return self._read(source, camera, cut, uploads)

    def close(self) -> None:
        """Release the context and all that it holds."""
        self._context.release()

    def _build(self, slots: int) -> None:
        context = self._context
        defines = "#define COMMANDS\n" if self._one_draw else ""
        self._program = context.program(
            vertex_shader=_shader("splat.vert.glsl", defines), fragment_shader=_shader("splat.frag.glsl", defines)
        )
        self._vertex = context.buffer(reserve=slots * self._samples * 8)
        self._color = context.buffer(reserve=slots * self._samples * 4)
        content: list[Any] = [(self._vertex, "4u2", "vertex"), (self._color, "4f1", "color")]
        if self._one_draw:
            self._placements = context.buffer(reserve=slots * PLACEMENT.itemsize)
            self._commands = context.buffer(reserve=slots * COMMAND.itemsize)
            content.append((self._placements, "3f 2f 1i /i", "offset", "placement", "node"))
        self._points = context.vertex_array(self._program, content)
        self._dimmer = context.program(
            vertex_shader=_shader("eye_dome.vert.glsl"), fragment_shader=_shader("eye_dome.frag.glsl")
        )
        self._triangle = context.vertex_array(self._dimmer, [])
        self._size = (0, 0)

    def _resize(self, width: int, height: int) -> None:
        if self._size == (width, height):
            return
        context, size = self._context, (width, height)
        try:
            self._color_image = context.texture(size, 4)
            self._depth_image = context.texture(size, 1, dtype="f4")
            self._node_image = context.texture(size, 1, dtype="i4")
            self._target = context.framebuffer(
                [self._color_image, self._depth_image, self._node_image], context.depth_texture(size)
            )
            self._dimmed = context.framebuffer([context.texture(size, 4)])
        except moderngl.Error as error:
            raise Unavailable(f"OpenGL cannot draw {width}x{height} pixels: {_one_line(error)}") from error
        self._size = size

    def _clear(self, style: Style) -> None:
        red, green, blue = (channel / 255 for channel in style.background)
        self._target.clear(red, green, blue, 1.0, depth=1.0)
        # moderngl clears all attachments to one colour.
        height, width = self._size[1], self._size[0]
        self._depth_image.write(np.full((height, width), EMPTY, dtype="<f4"))
        self._node_image.write(np.full((height, width), -1, dtype="<i4"))

    def _upload(self, nodes: NDArray[np.int64], take: Take) -> int:
        absent, slots = self._arena.place(nodes)
        for done, (node, slot) in enumerate(zip(absent.tolist(), slots.tolist(), strict=True)):
            try:
                packed = self._packer.pack(take(node), self._samples)
            except BaseException:
                self._arena.forget(absent[done:])
                raise
            self._vertex.write(packed.vertex, offset=slot * self._samples * 8)
            self._color.write(packed.color, offset=slot * self._samples * 4)
            self._arena.put(slot, packed)
        return len(absent)

    def _submit(self, nodes: NDArray[np.int64], spacing: NDArray[np.float32], camera: Camera) -> None:
        """Draw nodes that are in the arena."""
        slots = self._arena.slots_of(nodes)
        counts = self._arena.count[slots]
        placement = np.empty(len(nodes), dtype=PLACEMENT)
        placement["offset"] = self._arena.origin[slots] - np.array(camera.eye)
        placement["placement"][:, 0] = self._arena.scale[slots]
        placement["placement"][:, 1] = spacing * (CLOSING * camera.focal)
        placement["node"] = nodes
        first = slots * self._samples
        if self._one_draw:
            commands = np.zeros(len(nodes), dtype=COMMAND)
            commands["count"], commands["instances"], commands["first"] = counts, 1, first
            commands["base_instance"] = np.arange(len(nodes))
            self._placements.write(placement)
            self._commands.write(commands)
            self._points.render_indirect(self._commands, moderngl.POINTS, len(nodes))
            return
        offset, scale, node = (self._program[name] for name in ("offset", "placement", "node"))
        rows = zip(placement, counts.tolist(), first.tolist(), strict=True)
        for row, count, start in rows:
            offset.write(row["offset"].tobytes())
            scale.write(row["placement"].tobytes())
            node.write(row["node"].tobytes())
            self._points.render(moderngl.POINTS, vertices=count, first=start)

    def _set_uniforms(self, camera: Camera, style: Style, depth_range: tuple[float, float]) -> None:
        surface = (255, 255, 255) if self._packer.has_colors else style.surface
        values: dict[str, Any] = {
            "rotation": tuple(camera.rotation().T.ravel()),  # column by column
            "size": (camera.width, camera.height),
            "margin": self._margin,
            "focal": camera.focal,
            "range": depth_range,
            "largest": self._largest,
            "round_from": ROUND_FROM,
            "round_factor": ROUND,
            "albedo": tuple(channel / 255 for channel in surface),
            "lamp": tuple(shading.lamp().tolist()),
            "lit": self._packer.has_normals,
            "two_sided": style.two_sided,
        }
        for name, value in values.items():
            self._program[name].value = value

    def _eye_dome(self, camera: Camera, style: Style) -> None:
        self._dimmed.use()
        self._context.enable_only(moderngl.NOTHING)
        self._color_image.use(0)
        self._depth_image.use(1)
        self._dimmer["picture"].value = 0
        self._dimmer["depths"].value = 1
        self._dimmer["factor"].value = style.edl_strength * camera.focal / (8 * shading.RADIUS)
        self._triangle.render(moderngl.TRIANGLES, vertices=3)

    def _read(self, source: Any, camera: Camera, cut: Cut, uploads: int) -> Frame:
        shape = (camera.height, camera.width)
        rgba = np.frombuffer(source.read(components=4), dtype=np.uint8).reshape(*shape, 4)
        depth = np.frombuffer(self._target.read(components=1, attachment=1, dtype="f4"), dtype="<f4").reshape(shape)
        node = (
            np.frombuffer(self._target.read(components=1, attachment=2, dtype="i4"), dtype="<i4")
            .reshape(shape)[::-1]
            .copy()
        )
        return Frame(
            rgb=np.ascontiguousarray(rgba[::-1, :, :3]),
            depth=np.where(depth[::-1] >= EMPTY, np.float32(np.inf), depth[::-1]),
            node=node,
            starved=starved_pixels(node, cut),
            splats=cut.splats,
            clouds=len(cut.nodes),
            uploads=uploads,
        )


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
    text = (files(__package__) / "shaders" / name).read_text(encoding="utf-8")
    for constant in ("AMBIENT", "DIFFUSE", "SPECULAR", "SHININESS", "UNLIT"):
        text = text.replace(f"@{constant}@", f"{float(getattr(shading, constant))}")
    text = text.replace("@RADIUS@", str(shading.RADIUS)).replace("@EMPTY@", f"{EMPTY:.9e}")
    return f"#version 330\n{defines}{text}"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]
