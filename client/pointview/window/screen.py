"""The window: a glfw window, the picture on it as a texture, and Dear ImGui's frame around the panel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

import glfw
import moderngl
from imgui_bundle import imgui
from imgui_bundle.python_backends.glfw_backend import GlfwRenderer

from lpc.errors import Unavailable
from pointview.render import Style

from .inputs import Inputs
from .keyboard import Keyboard

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

IDLE = 0.5
"""Seconds that a frame without anything to do waits for input or news: the statistics are never older."""

LIVELY = 6
"""Frames after an event in which the panel may still change: menus open, a window finds its size."""

DOUBLE_CLICK = 0.35
"""Seconds between the two clicks, beside what the frames take that see them."""

LETTERS = 14.0
"""Height of the panel's letters, pixels of a display of usual density."""

LONGEST_STEP = 0.1
"""Seconds that a frame moves the camera on at most, after whatever wait."""

VERTEX = """#version 330
out vec2 at;
void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0;
    at = vec2(corner.x, 1.0 - corner.y);
    gl_Position = vec4(corner * 2.0 - 1.0, 0.0, 1.0);
}"""

FRAGMENT = """#version 330
uniform sampler2D picture;
in vec2 at;
out vec4 color;
void main() { color = texture(picture, at); }"""


class Screen:
    """An open window. Made, used and closed on the main thread.

    Parameters
    ----------
    title : str
    size : (int, int)
        Width and height, screen coordinates.
    visible : bool

    Raises
    ------
    Unavailable
        If there is no display, or it has no OpenGL 3.3.
    """

    def __init__(self, title: str, size: tuple[int, int], *, visible: bool = True) -> None:
        problems: list[str] = []
        glfw.set_error_callback(lambda _code, text: problems.append(_text(text)))
        if not glfw.init():
            raise Unavailable(f"no window can be opened here ({'; '.join(problems)}); `pointstream render` needs none")
        for hint, value in (
            (glfw.CONTEXT_VERSION_MAJOR, 3),
            (glfw.CONTEXT_VERSION_MINOR, 3),
            (glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE),
            (glfw.OPENGL_FORWARD_COMPAT, True),
            (glfw.VISIBLE, visible),
        ):
            glfw.window_hint(hint, value)
        self._window = glfw.create_window(*size, title, None, None)
        if not self._window:
            glfw.terminate()
            raise Unavailable(f"no OpenGL 3.3 window can be opened here: {'; '.join(problems)}")
        glfw.make_context_current(self._window)
        glfw.swap_interval(1)
        self._context = moderngl.create_context()
        program = self._context.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
        self._blit = self._context.vertex_array(program, [])
        self._texture: Any = None
        imgui.create_context()
        io, style = imgui.get_io(), imgui.get_style()
        io.set_ini_filename("")  # leaves no file behind
        io.fonts.add_font_default_vector()
        style.font_size_base = LETTERS
        style.frame_rounding = style.grab_rounding = 3.0
        style.set_color_(imgui.Col_.popup_bg, (0.1, 0.1, 0.1, 1.0))
        style.set_color_(imgui.Col_.slider_grab, (0.26, 0.59, 0.98, 0.5))  # the number behind it stays legible
        self._scale = 1.0
        self._imgui = GlfwRenderer(self._window, attach_callbacks=True)
        self._keyboard = Keyboard(self._window, self._imgui)
        self._dropped: list[str] = []
        drop: Any = self._drop  # typed as one path by the stubs; it is a list
        glfw.set_drop_callback(self._window, drop)
        self._shown_at = glfw.get_time()
        self._lively = LIVELY
        self._title = title
        self._corner, self._size = (0, 0), size
        self._longest = 0.0  # of the last frames, seconds
        self._click = (-1e9, 0.0, 0.0)

    @property
    def closing(self) -> bool:
        """Whether the window was asked to close."""
        return bool(glfw.window_should_close(self._window))

    @property
    def renderer(self) -> str:
        """What OpenGL calls the graphics hardware of the window."""
        return str(self._context.info["GL_RENDERER"])

    @property
    def letters(self) -> float:
        """Width of the window in heights of the panel's letters."""
        return float(glfw.get_window_size(self._window)[0] / (LETTERS * self._scale))

    def rename(self, title: str) -> None:
        """Give the window a title."""
        if title != self._title:
            glfw.set_window_title(self._window, title)
            self._title = title

    def wait(self, *, busy: bool) -> None:
        """Collect input; without anything to do, wait for it or for `wake`."""
        self._lively -= 1
        if busy or self._lively > 0:
            glfw.poll_events()
            return
        start = glfw.get_time()
        glfw.wait_events_timeout(IDLE)
        if glfw.get_time() - start < IDLE:
            self._lively = LIVELY

    @staticmethod
    def wake() -> None:
        """End a wait; from any thread."""
        glfw.post_empty_event()

    def begin(self, inset: float = 0.0) -> Inputs:
        """Begin a frame of the panel and return what was done to the picture.

        Parameters
        ----------
        inset : float
            What the panel takes of the window on its left, in heights of its letters.
        """
        self._adapt()
        inputs: Any = self._imgui  # its methods carry no types
        inputs.process_inputs()
        imgui.new_frame()
        now = glfw.get_time()
        seconds, self._shown_at = min(now - self._shown_at, LONGEST_STEP), now
        io, dropped = imgui.get_io(), tuple(self._dropped)
        self._dropped.clear()
        width, height = glfw.get_framebuffer_size(self._window)
        ratio = width / max(1.0, io.display_size.x)
        if width and height:  # else it is minimised: the picture stays what it is
            left = round(inset * imgui.get_font_size() * ratio)
            self._corner, self._size = (left, 0), (max(1, width - left), height)
        mouse = not io.want_capture_mouse

        def dragged(*buttons: int) -> tuple[float, float]:
            # In the frame of the press the way of the mouse to where it was pressed is no drag.
            held = any(imgui.is_mouse_down(button) and not imgui.is_mouse_clicked(button) for button in buttons)
            if not mouse or not held:
                return 0.0, 0.0
            return io.mouse_delta.x * ratio, io.mouse_delta.y * ratio

        pressed, held = self._keyboard.take(heard=not io.want_text_input)
        if "paste" in pressed:
            dropped = (*dropped, *self._clipboard())
        return Inputs(
            seconds=seconds,
            size=self._size,
            cursor=(io.mouse_pos.x * ratio - self._corner[0], io.mouse_pos.y * ratio),
            turned=dragged(0) if not io.key_shift else (0.0, 0.0),
            shifted=dragged(1, 2) if not io.key_shift else dragged(0, 1, 2),
            wheel=float(io.mouse_wheel) if mouse else 0.0,
            picked=mouse and self._is_double_click(now),
            pressed=pressed,
            held=held,
            dropped=dropped,
        )

    def show(self, rgb: NDArray[np.uint8]) -> None:
        """Replace the picture."""
        size = (rgb.shape[1], rgb.shape[0])
        if self._texture is None or self._texture.size != size:
            self.blank()
            self._texture = self._context.texture(size, 3, alignment=1)
        self._texture.write(rgb)

    def blank(self) -> None:
        """Take the picture away."""
        if self._texture is not None:
            self._texture.release()
            self._texture = None

    def end(self) -> None:
        """Put picture and panel on the screen."""
        imgui.render()
        target = self._context.screen
        target.use()
        self._context.viewport = (*self._corner, *self._size)
        self._context.disable(moderngl.BLEND | moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        red, green, blue = (channel / 255 for channel in Style().background)
        target.clear(red, green, blue)
        if self._texture is not None:
            self._texture.use(0)
            self._blit.render(moderngl.TRIANGLES, vertices=3)
        self._imgui.render(imgui.get_draw_data())
        glfw.swap_buffers(self._window)
        self._longest = max(glfw.get_time() - self._shown_at, 0.9 * self._longest)

    def close(self) -> None:
        """Close the window."""
        self._imgui.shutdown()
        imgui.destroy_context()
        self._context.release()
        glfw.destroy_window(self._window)
        glfw.terminate()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _is_double_click(self, now: float) -> bool:
        """Whether a click follows one at the same place; Dear ImGui's own test fails where frames take long."""
        if not imgui.is_mouse_clicked(0):
            return False
        (before, x, y), at = self._click, imgui.get_io().mouse_pos
        near = abs(at.x - x) + abs(at.y - y) < LETTERS * self._scale / 2
        double = near and now - before < DOUBLE_CLICK + 2 * self._longest
        self._click = (-1e9, 0.0, 0.0) if double else (now, at.x, at.y)
        return double

    def _adapt(self) -> None:
        """Give letters and margins the size of the display's density, where its coordinates do not do that already."""
        density = glfw.get_window_content_scale(self._window)[0]
        window, buffer = glfw.get_window_size(self._window)[0], glfw.get_framebuffer_size(self._window)[0]
        scale = density * window / buffer if window and buffer else self._scale
        if scale > 0 and abs(scale / self._scale - 1) > 0.01:
            style = imgui.get_style()
            style.scale_all_sizes(scale / self._scale)
            style.font_scale_dpi = self._scale = scale

    def _clipboard(self) -> tuple[str, ...]:
        text = _text(glfw.get_clipboard_string(self._window) or "").strip()
        return (text,) if text else ()

    def _drop(self, _window: Any, paths: Any) -> None:
        self._dropped.extend(str(path) for path in paths)


def _text(value: Any) -> str:
    """Return a text of glfw, which comes as bytes."""
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
