"""Where the camera is at a time: a still view, or a recorded path of views."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.errors import FormatError
from pointview.camera import Camera

if TYPE_CHECKING:
    from pathlib import Path

VIEW_KEYS = ("eye", "target", "up", "fov_y")


@dataclass(frozen=True, slots=True)
class ViewPath:
    """Views at times; between two of them every value is interpolated linearly, outside the nearest one holds.

    Parameters
    ----------
    times : tuple of float
        Seconds, increasing.
    views : tuple of dict
        As many views (`Camera.to_view`).
    """

    times: tuple[float, ...]
    views: tuple[dict[str, Any], ...]

    @classmethod
    def still(cls, view: dict[str, Any]) -> ViewPath:
        """Return the path of a camera that does not move."""
        return cls((0.0,), (view,))

    @classmethod
    def read(cls, path: Path) -> ViewPath:
        """Read a PATH.json of the contract: a list of views, each with its time ``t`` in seconds.

        Raises
        ------
        FormatError
            If the file cannot be read or is no such list.
        """
        try:
            entries = json.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise FormatError(f"{path}: cannot be read: {error.strerror}") from error
        except (ValueError, RecursionError) as error:
            raise FormatError(f"{path}: is not JSON: {error}") from error
        if not isinstance(entries, Sequence) or isinstance(entries, str) or not entries:
            raise FormatError(f"{path}: a path is a list of at least one view, each with a time 't'")
        views, times = [], []
        for number, entry in enumerate(entries):
            try:
                views.append(Camera.from_view(entry, width=1, height=1).to_view())
                times.append(float(entry["t"]))
            except FormatError as error:
                raise FormatError(f"{path}: entry {number}: {error}") from error
            except (KeyError, TypeError, ValueError) as error:
                raise FormatError(f"{path}: entry {number}: needs a time 't' in seconds") from error
        if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise FormatError(f"{path}: the times 't' must increase from entry to entry")
        return cls(tuple(times), tuple(views))

    @property
    def moves(self) -> bool:
        """Whether the view ever changes."""
        return len(self.views) > 1

    def at(self, t: float) -> dict[str, Any]:
        """Return the view at a time in seconds."""
        after = int(np.searchsorted(self.times, t, side="right"))
        if after == 0 or after == len(self.times):
            return self.views[min(after, len(self.times) - 1)]
        before = after - 1
        weight = (t - self.times[before]) / (self.times[after] - self.times[before])
        start, end = self.views[before], self.views[after]
        return {
            key: ((1.0 - weight) * np.asarray(start[key]) + weight * np.asarray(end[key])).tolist() for key in VIEW_KEYS
        }
