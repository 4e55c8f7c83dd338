"""Views in time, as the PATH.json that ``stream --path`` and ``render --path`` replay."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from lpc.errors import StoreError

if TYPE_CHECKING:
    from pathlib import Path

    from pointview.camera import Camera

APART = 0.1
"""Least seconds between two entries; between them a path is interpolated."""


@dataclass(slots=True)
class Recorder:
    """A path that is being recorded.

    Parameters
    ----------
    start : float
        Seconds; times of the path count from here.
    seconds : float
        Since then, at the last view.
    """

    start: float
    seconds: float = 0.0
    entries: list[dict[str, Any]] = field(default_factory=list)

    def note(self, now: float, camera: Camera, *, last: bool = False) -> None:
        """Add the view of a frame, unless the last entry is too young; the last one takes its place."""
        t = max(0.0, round(now - self.start, 3))
        self.seconds = t
        young = bool(self.entries) and t - self.entries[-1]["t"] < APART
        if young and last and len(self.entries) > 1:
            self.entries.pop()
        if not young or last:
            self.entries.append({"t": t, **camera.to_view()})

    def write(self, path: Path) -> None:
        """Write the path.

        Raises
        ------
        StoreError
            If the file cannot be written.
        """
        try:
            path.write_text(json.dumps(self.entries, indent=1), encoding="utf-8")
        except OSError as error:
            raise StoreError(f"{path}: the path cannot be written there: {error.strerror or error}") from error


def free_name(folder: Path, stem: str, suffix: str) -> Path:
    """First of STEM-0001.SUFFIX, STEM-0002.SUFFIX, ... that is not there yet."""
    number = 1
    while (path := folder / f"{stem}-{number:04d}{suffix}").exists():
        number += 1
    return path
