"""What is written on the picture: legend, axes, scale bar, load bar and messages. Draws, and changes nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from imgui_bundle import imgui

from .scales import ticks, tidy_length, unit_of, written_length

if TYPE_CHECKING:
    from pointview.colouring import Legend

    from .controls import Viewpoint
    from .viewer import Viewer

AXES = (("x", (232, 92, 84)), ("y", (112, 190, 92)), ("z", (96, 148, 240)))
TEXT, SHADE, YELLOW, RED = (230, 230, 230), (18, 21, 26), (255, 214, 10), (232, 64, 56)

PLATE = 140
"""Of 255: how much what is always there darkens the picture behind it."""

PREPARING = "getting ready to draw ... (some seconds at the first use after an installation)"
WELCOME = "Drop a model here, or paste its path or address with Ctrl V"


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlay:
    """The picture's part of the window, in units of Dear ImGui.

    Parameters
    ----------
    left, right, bottom : float
        Edges of the picture; the upper one is 0.
    clear : float
        Where the panel ends, which stands on the picture in a narrow window.
    letter : float
        Height of letters.
    draw : draw list
        Behind all windows of the panel.
    """

    left: float
    clear: float
    right: float
    bottom: float
    letter: float
    draw: Any

    @classmethod
    def beside(cls, inset: float, panel: float) -> Overlay:
        """Return that of this frame.

        Parameters
        ----------
        inset, panel : float
            What the panel takes of the window, and how wide it is, in heights of letters.
        """
        size, letter = imgui.get_io().display_size, imgui.get_font_size()
        return cls(
            left=inset * letter,
            clear=panel * letter,
            right=size.x,
            bottom=size.y,
            letter=letter,
            draw=imgui.get_background_draw_list(),
        )

    def show(self, viewer: Viewer) -> None:
        """Draw everything."""
        if viewer.mirror.index is None:
            text = viewer.message or ("opening ..." if viewer.feed is not None else WELCOME)
            (self._message if viewer.settings.help else self._notice)(text)
            return
        if viewer.frame is None:
            self._notice(PREPARING)
            return
        settings, view, crs = viewer.settings, viewer.view, viewer.mirror.header.crs
        if view is not None and settings.marks and self.bottom > 14 * self.letter:
            self._axes(view)
            self._scale_bar(view, unit_of(crs))
        if view is not None and viewer.turning:
            self._pivot(view)
        colouring = viewer.painter.colouring
        if colouring is not None and colouring.legend is not None:
            self._legend(colouring.legend, unit_of(crs) if colouring.mode == "height" else "")
        if viewer.recorder is not None:
            self._recording(viewer.recorder.seconds)
        if viewer.message:
            self._message(viewer.message)
        if viewer.loading:
            self._load_bar(*viewer.loaded)

    def _axes(self, view: Viewpoint) -> None:
        """Draw where x, y and z point, the farthest first."""
        right, up, forward = view.camera.rotation()
        x, y, arm = self.clear + 3.6 * self.letter, self.bottom - 3.6 * self.letter, 2.0 * self.letter
        self.draw.add_circle_filled((x, y), 1.65 * arm, _packed(SHADE, PLATE))
        for axis in sorted(range(3), key=lambda axis: -forward[axis]):
            name, color = AXES[axis]
            tip = (x + arm * float(right[axis]), y - arm * float(up[axis]))
            self.draw.add_line((x, y), tip, _packed(SHADE), self.letter / 3)
            self.draw.add_line((x, y), tip, _packed(color), self.letter / 7)
            size = imgui.calc_text_size(name)
            beyond = (x + 1.35 * arm * float(right[axis]), y - 1.35 * arm * float(up[axis]))
            self._text(beyond[0] - size.x / 2, beyond[1] - size.y / 2, name, color)

    def _scale_bar(self, view: Viewpoint, unit: str) -> None:
        """Draw a tidy length as it is seen at the pivot."""
        depth = float(view.camera.to_camera([view.pivot])[0, 2])
        if depth <= 0:
            return
        pixels = view.camera.focal / depth / max(imgui.get_io().display_framebuffer_scale.x, 1e-3)
        length = tidy_length(0.25 * (self.right - self.clear) / pixels)
        text, width = written_length(length, unit), length * pixels
        right, y = self.right - self.letter, self.bottom - 1.2 * self.letter
        size = imgui.calc_text_size(text)
        wide, high = max(width, size.x), size.y + self.letter
        left = right - width / 2 - wide / 2
        self._box(left - self.letter / 2, y - high, left + wide + self.letter / 2, y + self.letter * 0.7, PLATE)
        for color, thick in ((SHADE, self.letter / 3), (TEXT, self.letter / 8)):
            self.draw.add_line((right - width, y), (right, y), _packed(color), thick)
            for x in (right - width, right):
                self.draw.add_line((x, y - self.letter / 3), (x, y + self.letter / 3), _packed(color), thick)
        self._text(right - width / 2 - size.x / 2, y - size.y - self.letter / 3, text)

    def _pivot(self, view: Viewpoint) -> None:
        """Draw the point that the camera turns around."""
        pixel, depth = view.camera.project([view.pivot])
        if depth[0] <= 0:
            return
        scale = max(imgui.get_io().display_framebuffer_scale.x, 1e-3)
        x, y, arm = self.left + float(pixel[0, 0]) / scale, float(pixel[0, 1]) / scale, 0.7 * self.letter
        for color, thick in ((SHADE, self.letter / 4), (YELLOW, self.letter / 10)):
            self.draw.add_circle((x, y), arm / 2, _packed(color), 0, thick)
            self.draw.add_line((x - arm, y), (x + arm, y), _packed(color), thick)
            self.draw.add_line((x, y - arm), (x, y + arm), _packed(color), thick)

    def _legend(self, legend: Legend, unit: str) -> None:
        letter, line = self.letter, 1.35 * self.letter
        title = f"{legend.title}, {unit}" if unit else legend.title
        marks = [] if legend.ramp is None else ticks(legend.low, legend.high)
        texts = [text for text, _ in legend.entries] + [text for _, text in marks]
        width = max([imgui.calc_text_size(title).x] + [imgui.calc_text_size(text).x + 1.6 * letter for text in texts])
        height = min(14 * letter, self.bottom - 8 * letter) if legend.ramp is not None else line * len(legend.entries)
        if height < 3 * letter and legend.ramp is not None:
            return
        left, top = round(self.right - width - 1.5 * letter), round(letter)
        self._box(left - letter / 2, top - letter / 2, self.right - letter / 2, top + line + height + letter / 2)
        self.draw.add_text((left, top), _packed(TEXT), title)
        top += round(line)
        if legend.ramp is not None:
            colors = [_packed(tuple(map(int, color))) for color in legend.ramp[::-1]]
            for number, color in enumerate(colors):
                upper, lower = (top + height * part // len(colors) for part in (number, number + 1))
                self.draw.add_rect_filled((left, upper), (left + letter, lower), color)
            for value, text in marks:
                share = (value - legend.low) / (legend.high - legend.low) if legend.high > legend.low else 0.5
                y = top + height * (1 - share)
                self.draw.add_line((left + letter, y), (left + 1.3 * letter, y), _packed(TEXT), 1.0)
                self.draw.add_text((left + 1.6 * letter, y - letter / 2), _packed(TEXT), text)
        for number, (text, entry) in enumerate(legend.entries):
            y = top + line * number
            self.draw.add_rect_filled((left, y), (left + letter, y + letter), _packed(entry))
            self.draw.add_text((left + 1.6 * letter, y), _packed(TEXT), text)

    def _recording(self, seconds: float) -> None:
        x, y, text = self.clear + 1.5 * self.letter, self.letter, f"recording, {seconds:.0f} s"
        edge = x + 1.4 * self.letter + imgui.calc_text_size(text).x
        self._box(x - self.letter / 2, y - self.letter / 2, edge + self.letter / 2, y + 1.5 * self.letter)
        self.draw.add_circle_filled((x + self.letter / 2, y + self.letter / 2), 0.4 * self.letter, _packed(RED))
        self._text(x + 1.4 * self.letter, y, text)

    def _notice(self, text: str) -> None:
        """Write in the middle of a window without a picture."""
        wrap = 0.9 * (self.right - self.clear)
        size = imgui.calc_text_size(text, False, wrap)
        x, y = (self.clear + self.right - size.x) / 2, (self.bottom - size.y) / 2
        self.draw.add_text(imgui.get_font(), self.letter, (x, y), _packed(TEXT), text, wrap)

    def _message(self, text: str) -> None:
        """Write at the upper edge."""
        wrap = max(0.55 * (self.right - self.clear), 14 * self.letter)
        size = imgui.calc_text_size(text, False, wrap)
        x, y = self.clear + 1.5 * self.letter, 3.4 * self.letter
        self._box(x - self.letter / 2, y - self.letter / 2, x + size.x + self.letter / 2, y + size.y + self.letter / 2)
        self.draw.add_text(imgui.get_font(), self.letter, (x, y), _packed(TEXT), text, wrap)

    def _load_bar(self, here: int, whole: int) -> None:
        """Draw how much of the view is here, along the lower edge."""
        width, top = self.right - self.clear, self.bottom - self.letter / 3
        self.draw.add_rect_filled((self.clear, top), (self.right, self.bottom), _packed((60, 64, 72)))
        self.draw.add_rect_filled((self.clear, top), (self.clear + width * here / whole, self.bottom), _packed(YELLOW))
        text = f"{written_bytes(here)} of {written_bytes(whole)}"
        half, x, y = imgui.calc_text_size(text).x / 2, self.clear + width / 2, top - 1.5 * self.letter
        self._box(x - half - self.letter / 2, y - self.letter / 4, x + half + self.letter / 2, top, PLATE)
        self._text(x - half, y, text)

    def _text(self, x: float, y: float, text: str, color: tuple[int, ...] = TEXT) -> None:
        """Write on whatever colour."""
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            self.draw.add_text((x + dx, y + dy), _packed(SHADE), text)
        self.draw.add_text((x, y), _packed(color), text)

    def _box(self, left: float, top: float, right: float, bottom: float, alpha: int = 210) -> None:
        """Darken the picture behind what is written there."""
        self.draw.add_rect_filled((left, top), (right, bottom), _packed(SHADE, alpha), self.letter / 4)


def written_bytes(count: float) -> str:
    """Write a number of bytes."""
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.2f} GiB"


def _packed(color: tuple[int, ...], alpha: int = 255) -> int:
    red, green, blue = color
    return red | green << 8 | blue << 16 | alpha << 24
