"""What is written on the picture: settings, legend, statistics, load bar, help. Edits `Settings` and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from imgui_bundle import imgui

from pointview.colouring import Legend, Mode, available_modes

from .inputs import AXES, KEYS
from .settings import BUDGETS, TOLERANCES, Settings

if TYPE_CHECKING:
    from pointview.render import Splat

    from .viewer import Viewer

WIDTH = 24.0
"""Of the panel, in heights of its letters."""

MODE_NAMES: dict[Mode, str] = {
    "color": "colour", "shading": "shading alone", "height": "height", "intensity": "intensity",
    "classification": "classification", "normal": "normal", "level": "level",
}  # fmt: skip

SPLAT_NAMES: dict[Splat, str] = {
    "square": "squares",
    "round": "round",
    "disc": "discs in the surface",
    "blended": "blended",
}
SPLATS = tuple(SPLAT_NAMES)


@dataclass(slots=True)
class Panel:
    """The panel of a viewer.

    Attributes
    ----------
    commands : frozenset of str
        Keys that its buttons stand for, as of the last frame.
    """

    frames_per_second: float = 0.0
    commands: frozenset[str] = frozenset()

    def draw(self, viewer: Viewer, renderer: str) -> None:
        """Write one frame of it."""
        self.commands = frozenset()
        settings = viewer.settings
        if settings.panel:
            self._settings(viewer, renderer)
        if settings.help:
            _help(settings)
        _load_bar(viewer)

    def _settings(self, viewer: Viewer, renderer: str) -> None:
        settings, letter = viewer.settings, imgui.get_font_size()
        imgui.set_next_window_pos((letter / 2, letter / 2), imgui.Cond_.first_use_ever)
        imgui.set_next_window_size((WIDTH * letter, 0), imgui.Cond_.always)
        imgui.begin("pointstream", None, imgui.WindowFlags_.no_resize | imgui.WindowFlags_.no_nav)
        imgui.push_item_width(-6.5 * letter)
        self._views(settings)
        if imgui.collapsing_header("Quality", imgui.TreeNodeFlags_.default_open):
            _quality(viewer)
        if imgui.collapsing_header("Colours", imgui.TreeNodeFlags_.default_open):
            _colours(viewer)
        if imgui.collapsing_header("Statistics", imgui.TreeNodeFlags_.default_open):
            self._statistics(viewer, renderer)
        imgui.separator()
        for label, key in (("picture", "p"), ("stop" if viewer.recorder else "record", "r"), ("help", "f1")):
            self._button(label, key)
            imgui.same_line()
        imgui.new_line()
        if viewer.message:
            imgui.text_wrapped(viewer.message)
        imgui.pop_item_width()
        imgui.end()

    def _views(self, settings: Settings) -> None:
        self._button("fit", "f")
        imgui.same_line()
        self._button("home", "home")
        imgui.same_line()
        _, settings.fly = imgui.checkbox("fly", settings.fly)
        for key, name in AXES.items():
            if key not in "14":
                imgui.same_line()
            self._button(name, key)
        if settings.fly:
            _, settings.speed = imgui.slider_float(
                "speed", settings.speed, 0.01, 2.0, "%.2f", imgui.SliderFlags_.logarithmic
            )

    def _button(self, label: str, key: str) -> None:
        if imgui.small_button(label):
            self.commands |= {key}

    def _statistics(self, viewer: Viewer, renderer: str) -> None:
        cut, frame = viewer.cut, viewer.frame
        lines = [f"{self.frames_per_second:.0f} frames/s   {viewer.painter.name or 'no picture yet'}"]
        if cut is not None and frame is not None:
            lines.append(f"{frame.splats:,} splats   {frame.clouds:,} clouds")
            lines.append(f"{int(cut.starved.sum()):,} starved   {len(cut.wants):,} wanted")
            culled = cut.culled
            lines.append(f"culled: {culled.frustum:,} outside, {culled.backface:,} away, {culled.occluded:,} hidden")
            lines.append(f"{cut.max_spacing_px:.2f} px at the coarsest place")
        stats = None if viewer.feed is None else viewer.feed.stats
        if stats is not None:
            rate = "no link" if stats.goodput is None else f"{_bytes(stats.goodput)}/s"
            lines.append(f"{rate}   {_bytes(stats.bytes_received)} received")
            lines.append(f"{stats.resident_clouds:,} clouds resident, {_bytes(stats.resident_bytes)}")
            lines += [f"{error.text} ({error.count})" for error in stats.errors[:2]]
        for line in lines:
            imgui.text_wrapped(line)
        if renderer:
            imgui.text_disabled(renderer)


def _quality(viewer: Viewer) -> None:
    settings = viewer.settings
    logarithmic = imgui.SliderFlags_.logarithmic
    _, settings.tolerance = imgui.slider_float("tolerance", settings.tolerance, *TOLERANCES, "%.2f px", logarithmic)
    _, settings.limited = imgui.checkbox("##limited", settings.limited)
    imgui.same_line()
    imgui.begin_disabled(not settings.limited)
    imgui.set_next_item_width(imgui.calc_item_width() - imgui.get_frame_height_with_spacing())
    _, settings.budget = imgui.slider_int("splats", settings.budget, *BUDGETS, "%d", logarithmic)
    imgui.end_disabled()
    _, settings.steady = imgui.checkbox("##steady", settings.steady)
    imgui.same_line()
    imgui.begin_disabled(not settings.steady)
    imgui.set_next_item_width(imgui.calc_item_width() - imgui.get_frame_height_with_spacing())
    changed, milliseconds = imgui.slider_float(
        "ms a frame", 1e3 * settings.frame_seconds, 5.0, 500.0, "%.0f", logarithmic
    )
    if changed:
        settings.frame_seconds = milliseconds / 1e3
    imgui.end_disabled()
    changed, at = imgui.combo("splats", SPLATS.index(settings.splat), list(SPLAT_NAMES.values()))
    if changed:
        settings.splat = SPLATS[at]
    _, settings.close_holes = imgui.checkbox("close holes", settings.close_holes)
    _, settings.two_sided = imgui.checkbox("both sides", settings.two_sided)
    _, settings.occlusion = imgui.checkbox("leave out what is hidden", settings.occlusion)
    if viewer.culling.verdict is not None:
        imgui.text_wrapped(viewer.culling.verdict)


def _colours(viewer: Viewer) -> None:
    settings, index = viewer.settings, viewer.mirror.index
    modes = ("shading",) if index is None else available_modes(index.header)
    at = modes.index(settings.mode) if settings.mode in modes else 0
    changed, at = imgui.combo("mode", at, [MODE_NAMES[mode] for mode in modes])
    if changed:
        settings.mode = modes[at]
    _, settings.tint = imgui.checkbox("tint what waits for data", settings.tint)
    colouring = viewer.painter.colouring
    if colouring is not None and colouring.legend is not None:
        _legend(colouring.legend)


def _legend(legend: Legend) -> None:
    draw, letter = imgui.get_window_draw_list(), imgui.get_font_size()
    if legend.ramp is not None:
        corner, width = imgui.get_cursor_screen_pos(), imgui.get_content_region_avail().x
        steps = 64
        for step in range(steps):
            color = legend.ramp[step * 255 // (steps - 1)]
            left, right = corner.x + width * step / steps, corner.x + width * (step + 1) / steps
            draw.add_rect_filled((left, corner.y), (right, corner.y + letter * 0.8), _packed(*map(int, color)))
        imgui.dummy((width, letter * 0.8))
        imgui.text(f"{legend.low:g}")
        high = f"{legend.high:g}"
        imgui.same_line(imgui.get_cursor_pos_x() + width - imgui.calc_text_size(high).x)
        imgui.text(high)
    for text, color in legend.entries:
        corner = imgui.get_cursor_screen_pos()
        draw.add_rect_filled((corner.x, corner.y), (corner.x + letter, corner.y + letter), _packed(*color))
        imgui.dummy((letter, letter))
        imgui.same_line()
        imgui.text(text)


def _help(settings: Settings) -> None:
    size = imgui.get_io().display_size
    imgui.set_next_window_pos((size.x / 2, size.y / 2), imgui.Cond_.appearing, (0.5, 0.5))
    _, stays = imgui.begin("Controls", True, imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_nav)
    if imgui.begin_table("keys", 2):
        for key, text in KEYS:
            imgui.table_next_row()
            imgui.table_next_column()
            imgui.text(key)
            imgui.table_next_column()
            imgui.text(text)
        imgui.end_table()
    imgui.end()
    settings.help = bool(stays)


def _load_bar(viewer: Viewer) -> None:
    """Draw a line along the lower edge of the picture: how much of the view is here."""
    here, whole = viewer.loaded
    if viewer.feed is None or (whole and here >= whole):
        return
    size, letter = imgui.get_io().display_size, imgui.get_font_size()
    draw = imgui.get_foreground_draw_list()
    share = here / whole if whole else 0.0
    top = size.y - letter / 4
    draw.add_rect_filled((0.0, top), (size.x, size.y), _packed(60, 64, 72))
    draw.add_rect_filled((0.0, top), (size.x * share, size.y), _packed(255, 214, 10))
    text = f"{_bytes(here)} of {_bytes(whole)}" if whole else (viewer.message or "opening ...")
    width = imgui.calc_text_size(text).x
    draw.add_text((size.x - width - letter / 2, top - letter * 1.3), _packed(230, 230, 230), text)


def _packed(red: int, green: int, blue: int) -> int:
    return red | green << 8 | blue << 16 | 255 << 24


def _bytes(count: float) -> str:
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.2f} GiB"
