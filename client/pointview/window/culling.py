"""Occlusion culling of a window: when the picture is asked what it hides, and when the answer has settled.

While the camera moves the answer must come with the frame: what shows up is drawn in the frame that shows it. So every
frame is asked, a quarter of its pixels; where frames are so quick that this takes more than a share of them, every
second or third. Under a camera at rest the whole picture is asked, and again until nothing changes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pointview.occlusion import KEPT, Occlusion

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from lpc.index import IndexTree
    from pointview.camera import Camera
    from pointview.refine import Cut
    from pointview.render import Frame

SHARE = 0.1
"""Time that tests may take of moving frames."""

MOST_APART = 3
"""Frames from one test to the next at most."""

STRIDE = 2
"""Pixels and lines from one that is looked at to the next while the camera moves."""


class Culling:
    """What is hidden from frame to frame.

    Attributes
    ----------
    changed : bool
        Whether what is hidden changed since `prepare`.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._index: IndexTree | None = None
        self._occlusion: Occlusion | None = None
        self._camera: Camera | None = None
        self._frames, self._cost = 0, 0.0
        self._same = KEPT
        self.changed = False

    @property
    def hidden(self) -> NDArray[np.bool_] | None:
        """What to leave out of a cut, (nodes,) bool."""
        return None if self._occlusion is None else self._occlusion.hidden

    @property
    def verdict(self) -> str | None:
        """Why nothing is culled, or None."""
        return None if self._occlusion is None else self._occlusion.verdict

    @property
    def settled(self) -> bool:
        """Whether another look at the last picture would tell nothing new."""
        return self._occlusion is None or self.verdict is not None or self._same >= KEPT

    def prepare(self, index: IndexTree, *, wanted: bool) -> None:
        """Make ready for the next cut; forgets what is known of another index, and all when not wanted."""
        self.changed = False
        if not wanted:
            self._index = self._occlusion = None
        elif self._occlusion is None or index is not self._index:
            self._index, self._occlusion, self._same = index, Occlusion(index.header.nodes), KEPT

    def drew(self, cut: Cut, camera: Camera, frame: Frame, *, seconds: float) -> bool:
        """Learn from a new picture, which took some time; True if something shows up that should be drawn at once."""
        if self._occlusion is None:
            return False
        self._same = 0
        self._frames += 1
        moved, self._camera = camera != self._camera, camera
        if moved and self._frames < min(MOST_APART, math.ceil(self._cost / (SHARE * seconds or 1.0))):
            return False
        return self.look(cut, camera, frame, stride=STRIDE if moved else 1)

    def look(self, cut: Cut, camera: Camera, frame: Frame, *, stride: int = 1) -> bool:
        """Look at the last picture, once more if need be; True if something shows up in it."""
        occlusion, index = self._occlusion, self._index
        if occlusion is None or index is None:
            return False
        before, start = occlusion.hidden, self._clock()
        seen = occlusion.look(index, cut, camera, frame, stride=stride)
        self._frames, self._cost = 0, self._clock() - start
        if np.array_equal(before, occlusion.hidden):
            self._same += 1
        else:
            self._same, self.changed = 0, True
        return seen > 0
