"""Tolerance and cut of the next frame: what is asked for, kept within the budget and the frame time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pointview.budget import allowance, refine_within
from pointview.feedback import Feedback
from pointview.refine import Cut, refine

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pointview.camera import Camera

    from .mirror import Mirror
    from .settings import Settings

    Hidden = NDArray[np.bool_] | None

STILL = 6.0
"""Frame times that a frame of a camera at rest may take: nobody steers it."""


@dataclass(slots=True)
class Quality:
    """The tolerance from frame to frame: one while the camera moves, one for when it rests.

    Attributes
    ----------
    tolerance : float
        Of the last cut, pixels.
    """

    moving: Feedback
    resting: Feedback
    tolerance: float = math.inf

    @classmethod
    def at(cls, tolerance: float) -> Quality:
        """Start at a tolerance in pixels."""
        return cls(moving=Feedback(tolerance=tolerance), resting=Feedback(tolerance=tolerance))

    def cut(
        self,
        mirror: Mirror,
        camera: Camera,
        settings: Settings,
        hidden: Hidden,
        contrast: NDArray[np.float64] | None = None,
        *,
        moving: bool,
    ) -> Cut:
        """Compute the cut of a frame."""
        assert mirror.index is not None
        tolerance = settings.tolerance
        options: dict[str, Any] = {"cull_backfaces": not settings.two_sided, "hidden": hidden}
        if settings.steady:
            tolerance = max(tolerance, (self.moving if moving else self.resting).tolerance)
        self.tolerance = tolerance
        order: dict[str, Any] = {"priority": "error", "contrast": contrast}
        if not settings.limited:
            return refine(mirror.index, camera, tolerance, mirror.resident, **options, **order)
        index = mirror.index
        within = allowance(index, camera, settings.budget, index.known, at_least=tolerance, **options)
        self.tolerance = within.tolerance
        return refine_within(index, camera, within, mirror.resident, **options, **order)

    def took(self, seconds: float, settings: Settings, *, moving: bool) -> bool:
        """Take in what a frame took; True if a camera at rest should be drawn again, with another tolerance."""
        finest, allowed = settings.tolerance, settings.frame_seconds
        if not settings.steady:
            self.moving = self.resting = Feedback(tolerance=finest)
            return False
        if moving:
            self.moving = self.moving.step(seconds, allowed=allowed, finest=finest, moved=True)
            self.resting = Feedback(tolerance=min(self.resting.tolerance, self.moving.tolerance))
            return False
        before = self.resting.tolerance
        self.resting = self.resting.step(seconds, allowed=allowed * STILL, finest=finest, moved=False)
        return self.resting.tolerance != before


def loaded_bytes(mirror: Mirror, camera: Camera, settings: Settings, hidden: Hidden) -> tuple[int, int]:
    """Bytes of the view's clouds that are here, and of all that it will have as far as the index tells."""
    if mirror.index is None:
        return 0, 0
    options: dict[str, Any] = {"cull_backfaces": not settings.two_sided, "hidden": hidden}
    goal = refine(mirror.index, camera, settings.tolerance, mirror.index.known, **options).nodes
    sizes = mirror.index.size[goal]
    return int(sizes[mirror.resident[goal]].sum()), int(np.sum(sizes))
