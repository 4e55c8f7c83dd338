"""What keys, drops and pastes command, besides moving the camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

from lpc.errors import LpcError
from pointview.colouring import MODES, available_modes
from pointview.render.picture import save_picture

from .painter import shown
from .recorder import free_name
from .settings import TOLERANCES

if TYPE_CHECKING:
    from collections.abc import Callable

    from .inputs import Inputs
    from .viewer import Viewer

SCANS = (
    ".ply", ".las", ".laz", ".e57", ".pcd", ".npz", ".obj", ".xyz", ".pts", ".csv", ".txt", ".asc", ".xyzrgb", ".xyzn",
)  # fmt: skip
"""Suffixes of what `pointstream build` reads."""


def obey(viewer: Viewer, did: Inputs) -> None:
    """Do what a frame's input commands."""
    for target in map(tidied, did.dropped[:1]):
        if target.lower().endswith(SCANS):
            name = Path(target).name
            viewer.tell(f"{name} is a scan: make a model of it with `pointstream build {name} -o MODEL.lpc`")
        elif target:
            viewer.open(target)
    settings = viewer.settings
    for key in did.pressed:
        if key == "c":
            modes = MODES if viewer.mirror.index is None else available_modes(viewer.mirror.header)
            at = modes.index(settings.mode) if settings.mode in modes else 0
            settings.mode = modes[(at + 1) % len(modes)]
        elif key == "t":
            settings.tint = not settings.tint
        elif key == "g":
            settings.fly = not settings.fly
        elif key == "b":
            settings.limited = not settings.limited
        elif key in ("[", "]"):
            finer = settings.tolerance * (0.8 if key == "[" else 1.25)
            settings.tolerance = min(max(finer, TOLERANCES[0]), TOLERANCES[1])
        elif key == "u":
            settings.up = "z" if viewer.up == "y" else "y"
        elif key == "tab":
            settings.panel = not settings.panel
        elif key in ("f1", "?"):
            settings.help = not settings.help
        elif key == "escape":
            settings.help = False
        elif key in ("p", "f12"):
            _save_picture(viewer)
        elif key == "r":
            _record(viewer)
        elif key == "quit":
            viewer.closing = True


def tidied(target: str) -> str:
    """Return the path or address in what was dropped or pasted: its first line, without quotes, of a file: address."""
    line = target.strip().partition("\n")[0].strip()
    if len(line) > 1 and line[0] == line[-1] and line[0] in "'\"":
        line = line[1:-1]
    if line.startswith("file://"):
        return unquote(line.removeprefix("file://").removeprefix("localhost"))
    return line


def _save_picture(viewer: Viewer) -> None:
    """Write the picture without the panel to the first free name."""
    frame = viewer.frame
    if frame is not None:
        path = free_name(viewer.options.folder, _stem(viewer), ".png")
        _try(viewer, lambda: save_picture(shown(frame, viewer.settings), path), path)


def _record(viewer: Viewer) -> None:
    """Start to record the path of the camera, or write what was recorded."""
    recorder = viewer.toggle_recording()
    if recorder is not None and recorder.entries:
        path = free_name(viewer.options.folder, f"{_stem(viewer)}-path", ".json")
        _try(viewer, lambda: recorder.write(path), path)


def _stem(viewer: Viewer) -> str:
    """Name of the model's file without its suffix."""
    name = "" if viewer.feed is None else viewer.feed.target.rstrip("/").rpartition("/")[2].partition("?")[0]
    return Path(name).stem or "model"


def _try(viewer: Viewer, write: Callable[[], None], path: Path) -> None:
    try:
        write()
    except LpcError as error:
        viewer.tell(str(error))
    else:
        viewer.tell(f"written: {path}")
