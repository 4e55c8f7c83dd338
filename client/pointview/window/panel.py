"""The panel beside the picture: settings and statistics. Edits `Settings` and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, get_args

from imgui_bundle import imgui

from lpc.info import counted
from pointview.colouring import Mode, available_modes
from pointview.render import Splat

from .inputs import AXES, KEYS
from .overlay import written_bytes
from .scales import written_place
from .settings import BUDGETS, TOLERANCES, Settings

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pointview.refine import Culled

    from .viewer import Viewer

WIDTH = 22.0
"""Of the panel, in heights of its letters."""

BESIDE = 2.2
"""Widths of the panel that a window must have for the picture to stand beside it; else the panel stands on it."""

MODE_NAMES: dict[Mode, str] = {
    "color": "the model's own", "shading": "shading alone", "height": "height", "intensity": "intensity",
    "classification": "classification", "normal": "normals", "level": "level of the tree",
}  # fmt: skip

ROOM = 1.3
"""Widths of the panel that a window must have for the panel to be shown at all."""

SPLATS: tuple[Splat, ...] = get_args(Splat)
SPLAT_NAMES: dict[str, str] = {
    "disc": "discs in the surface", "round": "discs", "square": "squares", "blended": "blended surface",
}  # fmt: skip


@dataclass(slots=True)
class Panel:
    """The panel of a viewer.

    Attributes
    ----------
    commands : frozenset of str
        Keys that its buttons stand for, as of the last frame.
    """

    commands: frozenset[str] = frozenset()

    @staticmethod
    def width(settings: Settings, window: float) -> float:
        """Return how wide it is, in heights of its letters."""
        return WIDTH if settings.panel and window >= ROOM * WIDTH else 0.0

    @staticmethod
    def inset(settings: Settings, window: float) -> float:
        """Return what the panel takes of a window on its left, in heights of its letters."""
        return WIDTH if settings.panel and window >= BESIDE * WIDTH else 0.0

    def draw(self, viewer: Viewer, renderer: str) -> None:
        """Write one frame of it."""
        self.commands = frozenset()
        settings, window = viewer.settings, imgui.get_io().display_size.x / imgui.get_font_size()
        if self.width(settings, window):
            self._settings(viewer, renderer)
        if settings.help:
            _help(settings, self.inset(settings, window))

    def _settings(self, viewer: Viewer, renderer: str) -> None:
        letter, flags = imgui.get_font_size(), imgui.WindowFlags_
        imgui.set_next_window_pos((0, 0), imgui.Cond_.always)
        imgui.set_next_window_size((WIDTH * letter, imgui.get_io().display_size.y), imgui.Cond_.always)
        imgui.begin("pointstream", None, flags.no_decoration & ~flags.no_scrollbar | flags.no_nav | flags.no_move)
        imgui.push_item_width(-6.5 * letter)
        opened = imgui.TreeNodeFlags_.default_open
        if imgui.collapsing_header("View", opened):
            self._views(viewer)
        if imgui.collapsing_header("Colours", opened):
            _colours(viewer)
        if imgui.collapsing_header("Quality", opened):
            _quality(viewer)
        if imgui.collapsing_header("Statistics", opened):
            _statistics(viewer, renderer)
        imgui.pop_item_width()
        imgui.end()

    def _views(self, viewer: Viewer) -> None:
        settings = viewer.settings
        self._buttons((("fit", "f"), ("home", "home"), ("help", "f1")))
        names = [(name, key) for key, name in AXES.items()]
        self._buttons(names[:3])
        self._buttons(names[3:])
        recording = viewer.recorder is not None
        self._buttons((("picture", "p"), ("stop" if recording else "record path", "r"), ("tint", "t")))
        imgui.align_text_to_frame_padding()
        imgui.text("up is")
        for axis in ("y", "z"):
            imgui.same_line()
            if imgui.radio_button(axis, viewer.up == axis):
                settings.up = "y" if axis == "y" else "z"
        imgui.same_line(0, 2 * imgui.get_font_size())
        _, settings.marks = imgui.checkbox("axes, scale", settings.marks)
        _, settings.fly = imgui.checkbox("dragging turns the head (G)", settings.fly)
        flags = imgui.SliderFlags_.logarithmic
        _, settings.speed = imgui.slider_float("fly speed", settings.speed, 0.01, 2.0, "%.2f sizes/s", flags)

    def _buttons(self, those: Iterable[tuple[str, str]]) -> None:
        """Write three buttons in a row, which stand for keys."""
        width = (imgui.get_content_region_avail().x - 2 * imgui.get_style().item_spacing.x) / 3
        for number, (label, key) in enumerate(those):
            if number:
                imgui.same_line()
            if imgui.button(label, (width, 0)):
                self.commands |= {key}
            imgui.set_item_tooltip(f"key {key.title()}")


def _quality(viewer: Viewer) -> None:
    settings, logarithmic = viewer.settings, imgui.SliderFlags_.logarithmic
    _, settings.tolerance = imgui.slider_float("tolerance", settings.tolerance, *TOLERANCES, "%.2f px", logarithmic)
    low, high = (1e-6 * budget for budget in BUDGETS)
    settings.steady, milliseconds = _limit(
        "a frame", settings.steady, 1e3 * settings.frame_seconds, (5.0, 500.0), "%.0f ms at most"
    )
    settings.frame_seconds = milliseconds / 1e3
    settings.limited, millions = _limit(
        "splats", settings.limited, 1e-6 * settings.budget, (low, high), "%.2f M at most"
    )
    if abs(millions * 1e6 - settings.budget) > 1:
        settings.budget = round(millions * 1e6)
    names = [SPLAT_NAMES.get(splat, splat) for splat in SPLATS]
    changed, at = imgui.combo("kind", SPLATS.index(settings.splat), names)
    if changed:
        settings.splat = SPLATS[at]
    _, settings.close_holes = imgui.checkbox("close holes", settings.close_holes)
    imgui.same_line(0, 2 * imgui.get_font_size())
    _, settings.two_sided = imgui.checkbox("both sides", settings.two_sided)
    _, settings.occlusion = imgui.checkbox("leave out what is hidden", settings.occlusion)
    if viewer.culling.verdict is not None:
        imgui.push_style_color(imgui.Col_.text, imgui.get_style_color_vec4(imgui.Col_.text_disabled))
        imgui.text_wrapped(viewer.culling.verdict)
        imgui.pop_style_color()


def _limit(label: str, on: bool, value: float, ends: tuple[float, float], form: str) -> tuple[bool, float]:
    """Write a limit that can be switched off."""
    _, on = imgui.checkbox(f"##{label} on", on)
    imgui.same_line()
    imgui.begin_disabled(not on)
    imgui.set_next_item_width(imgui.calc_item_width() - imgui.get_frame_height_with_spacing())
    _, value = imgui.slider_float(label, value, *ends, form, imgui.SliderFlags_.logarithmic)
    imgui.end_disabled()
    return on, value


def _colours(viewer: Viewer) -> None:
    settings, index = viewer.settings, viewer.mirror.index
    modes = ("shading",) if index is None else available_modes(index.header)
    at = modes.index(settings.mode) if settings.mode in modes else 0
    changed, at = imgui.combo("colours", at, [MODE_NAMES[mode] for mode in modes])
    if changed:
        settings.mode = modes[at]
    _, settings.tint = imgui.checkbox("tint what waits for data", settings.tint)


def _statistics(viewer: Viewer, renderer: str) -> None:
    rows: list[tuple[str, str]] = []
    cut, frame, stats = viewer.cut, viewer.frame, None if viewer.feed is None else viewer.feed.stats
    if cut is not None and frame is not None:
        rows += [
            ("splats", f"{frame.splats:,}"),
            ("clouds", f"{frame.clouds:,}, {int(cut.starved.sum()):,} lack data"),
            ("left out", _left_out(cut.culled)),
            ("coarsest", f"{cut.max_spacing_px:.2f} px"),
            ("drawn in", f"{1e3 * viewer.drawing:.0f} ms, {viewer.painter.name.partition(' ')[0]}"),
        ]
    if stats is not None:
        rtt = "" if stats.rtt is None else f", {1e3 * stats.rtt:.0f} ms"
        rows += [
            ("line", "a file" if stats.goodput is None else f"{written_bytes(stats.goodput)}/s{rtt}"),
            ("received", f"{written_bytes(stats.bytes_received)}, {counted(stats.requests, 'request')}"),
            ("ahead", f"{written_bytes(stats.speculative_bytes)}, {written_bytes(stats.wasted_bytes)} not drawn"),
            ("in memory", f"{counted(stats.resident_clouds, 'cloud')}, {written_bytes(stats.resident_bytes)}"),
        ]
        rows += [("trouble", f"{error.text} ({error.count} times)") for error in stats.errors[:3]]
    if viewer.view is not None:
        rows.append(("turns around", written_place(viewer.view.pivot, viewer.mirror.header.bounds)))
    if imgui.begin_table("statistics", 2):
        imgui.table_setup_column("", imgui.TableColumnFlags_.width_fixed, 6.5 * imgui.get_font_size())
        for name, value in rows:
            imgui.table_next_row()
            imgui.table_next_column()
            imgui.text_disabled(name)
            imgui.table_next_column()
            imgui.text_wrapped(value)
        imgui.end_table()
    if renderer:
        imgui.text_disabled(f"window: {renderer.partition(' (')[0]}")


def _left_out(culled: Culled) -> str:
    parts = ((culled.frustum, "outside"), (culled.backface, "away"), (culled.occluded, "hidden"))
    return ", ".join(f"{count:,} {why}" for count, why in parts if count) or "nothing"


def _help(settings: Settings, inset: float) -> None:
    size = imgui.get_io().display_size
    middle = ((inset * imgui.get_font_size() + size.x) / 2, size.y / 2)
    imgui.set_next_window_pos(middle, imgui.Cond_.always, (0.5, 0.5))
    imgui.set_next_window_size_constraints((0, 0), (size.x, size.y))
    flags = imgui.WindowFlags_
    _, stays = imgui.begin("Controls", True, flags.always_auto_resize | flags.no_nav | flags.no_collapse)
    if imgui.begin_table("keys", 2, imgui.TableFlags_.sizing_fixed_fit):
        for key, text in KEYS:
            imgui.table_next_row()
            imgui.table_next_column()
            imgui.text(key)
            imgui.table_next_column()
            imgui.text(text)
        imgui.end_table()
    imgui.end()
    settings.help = bool(stays)
