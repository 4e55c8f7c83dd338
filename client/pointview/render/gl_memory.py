"""Where OpenGL keeps the samples of clouds, and how it draws some of them in one call.

Two ways with one result. From OpenGL 4.3 on, samples are vertex buffers, and the clouds of a draw are the commands of
one `glMultiDrawArraysIndirect`, each of which picks its cloud's parameters by its base instance. OpenGL 3.3 has no such
call: there samples and parameters are texels, one `glDrawArrays` draws as many vertices as the slots of the clouds
hold, and each finds its cloud and its sample by its number. The vertices of a slot that hold no sample are dropped.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import moderngl
import numpy as np

from .pack import SAMPLE_BYTES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .pack import PackedCloud

COMMANDS_FROM = 430
"""First version with multi-draw-indirect, 100 * major + 10 * minor."""

COMMAND = np.dtype([(name, "<u4") for name in ("count", "instances", "first", "base_instance", "padding")])
"""glMultiDrawArraysIndirect's command, padded: moderngl steps 20 bytes from one to the next."""

PLACEMENT = np.dtype(
    [
        ("offset", "<f4", 3),
        ("scale", "<f4"),
        ("corner", "<f4", 3),
        ("side", "<f4"),
        ("node", "<i4"),
        ("row", "<i4"),
        ("level", "<i4"),
        ("count", "<i4"),
        ("at", "<i4", 2),
        ("padding", "<i4", 2),
    ]
)
"""What a draw is told of one cloud; see the vertex shader."""

TEXELS = PLACEMENT.itemsize // 16
"""Of a placement."""

ROW = 1024
"""Texels in a row of the texture of placements: the least width that every OpenGL has."""

VERTEX_UNIT, COLOR_UNIT, CLOUDS_UNIT = 4, 5, 6
"""Texture units; the passes over the picture use those below."""


class Memory(Protocol):
    """Slots for the samples of clouds on the GPU."""

    defines: str
    """Lines at the head of the vertex shader that reads them."""

    slots: int
    """Clouds that fit: what was asked for, or what OpenGL allows."""

    size: int
    """Bytes that samples take."""

    def points(self, program: Any) -> Any:
        """Return what draws the samples with a program, a vertex array."""
        ...

    def write(self, slot: int, cloud: PackedCloud) -> None:
        """Put a cloud into a slot."""
        ...

    def draw(self, points: Any, slots: NDArray[np.int64], placements: NDArray[Any]) -> None:
        """Draw the clouds of some slots; `placements` tells of each, but for its place in this memory."""
        ...


class Buffers:
    """Vertex buffers and an indirect multi-draw: OpenGL 4.3."""

    defines = "#define COMMANDS\n"

    def __init__(self, context: Any, slots: int, samples: int) -> None:
        self.slots, self._samples = slots, samples
        self._vertex = context.buffer(reserve=slots * samples * 8)
        self._color = context.buffer(reserve=slots * samples * 4)
        self._placements = context.buffer(reserve=slots * PLACEMENT.itemsize)
        self._commands = context.buffer(reserve=slots * COMMAND.itemsize)
        self._context, self._told = context, np.zeros(slots, dtype=COMMAND)
        self._told["instances"], self._told["base_instance"] = 1, np.arange(slots)
        self.size = self._vertex.size + self._color.size

    def points(self, program: Any) -> Any:
        """Return a vertex array."""
        placement = "4f 4f 4i 16x /i", "cloud_origin", "cloud_corner", "cloud_numbers"
        content = [(self._vertex, "4u2", "vertex"), (self._color, "4f1", "color"), (self._placements, *placement)]
        return self._context.vertex_array(program, content)

    def write(self, slot: int, cloud: PackedCloud) -> None:
        """Put a cloud into a slot."""
        self._vertex.write(cloud.vertex, offset=slot * self._samples * 8)
        self._color.write(cloud.color, offset=slot * self._samples * 4)

    def draw(self, points: Any, slots: NDArray[np.int64], placements: NDArray[Any]) -> None:
        """Draw the clouds of some slots."""
        told = self._told[: len(slots)]
        told["count"], told["first"] = placements["count"], slots * self._samples
        self._placements.write(placements)
        self._commands.write(told)
        self.render(points, len(slots))

    def render(self, points: Any, clouds: int) -> None:
        """Draw the clouds that were told last."""
        points.render_indirect(self._commands, moderngl.POINTS, clouds)


class Textures:
    """Samples and parameters as texels, fetched by the number of the vertex: OpenGL 3.3.

    A slot is a rectangle of `wide` by `high` texels: a part of one row, but for clouds that exceed a row.
    """

    defines = ""

    def __init__(self, context: Any, slots: int, samples: int) -> None:
        most = int(context.info["GL_MAX_TEXTURE_SIZE"])
        self._wide, self._high = min(samples, most), -(-samples // most)
        self._across = min(most // self._wide, slots)
        self.slots = slots = min(slots, self._across * (most // self._high))
        size = self._wide * self._across, self._high * -(-slots // self._across)
        self._vertex = context.texture(size, 4, dtype="u2")
        self._color = context.texture(size, 4)
        rows = -(-slots * TEXELS // ROW)
        self._clouds = context.texture((ROW, rows), 4, dtype="i4")
        self._told = np.zeros(rows * ROW // TEXELS, dtype=PLACEMENT)
        for texture in (self._vertex, self._color, self._clouds):
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)  # others make an integer texture unreadable
        self._context, self._samples = context, samples
        self.size = size[0] * size[1] * SAMPLE_BYTES

    def points(self, program: Any) -> Any:
        """Return a vertex array."""
        units = {"vertices": VERTEX_UNIT, "colors": COLOR_UNIT, "clouds": CLOUDS_UNIT}
        for name, value in {**units, "samples": self._samples, "wide": self._wide}.items():
            program[name].value = value
        return self._context.vertex_array(program, [])

    def write(self, slot: int, cloud: PackedCloud) -> None:
        """Put a cloud into a slot."""
        count, (left, top) = len(cloud.vertex), self._corners(slot)
        for first in range(0, count, self._wide):
            some = slice(first, min(first + self._wide, count))
            where = left, top + first // self._wide, some.stop - first, 1
            self._vertex.write(cloud.vertex[some], viewport=where)
            self._color.write(cloud.color[some], viewport=where)

    def draw(self, points: Any, slots: NDArray[np.int64], placements: NDArray[Any]) -> None:
        """Draw the clouds of some slots."""
        count = len(slots)
        rows = -(-count * TEXELS // ROW)
        told = self._told[: rows * ROW // TEXELS]
        told[:count] = placements
        told["at"][:count, 0], told["at"][:count, 1] = self._corners(slots)
        self._clouds.write(told, viewport=(0, 0, ROW, rows))
        for texture, unit in ((self._vertex, VERTEX_UNIT), (self._color, COLOR_UNIT), (self._clouds, CLOUDS_UNIT)):
            texture.use(unit)
        self.render(points, count)

    def render(self, points: Any, clouds: int) -> None:
        """Draw the clouds that were told last."""
        points.render(moderngl.POINTS, clouds * self._samples)

    def _corners(self, slots: Any) -> tuple[Any, Any]:
        """Columns and rows where slots begin."""
        return slots % self._across * self._wide, slots // self._across * self._high
