"""What the next views of a moving camera will want, the nearest in time first."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from .prediction import Motion

if TYPE_CHECKING:
    from collections.abc import Callable

    from .camera import Camera
    from .refine import Cut, Nodes


@dataclass(frozen=True, slots=True, kw_only=True)
class LookaheadOptions:
    """How far to look.

    Parameters
    ----------
    horizons : tuple of float
        Seconds from now, increasing.
    enough : int
        Nodes after which no later view is looked at: more than a link without anything else to do asks for in a frame.
    """

    horizons: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0)
    enough: int = 64


@dataclass(slots=True)
class Lookahead:
    """Watches a camera and says what to fetch before it gets there."""

    options: LookaheadOptions = field(default_factory=LookaheadOptions)
    motion: Motion = field(default_factory=Motion)

    def note(self, t: float, camera: Camera) -> None:
        """Take in where the camera of a frame is, at a time in seconds."""
        self.motion.note(t, camera)

    def nodes(self, look: Callable[[Camera], Cut]) -> Nodes:
        """Return the nodes that coming views lack, each once, most urgent first; none for a camera at rest.

        Parameters
        ----------
        look : callable
            Refines a view as the frame's own was.
        """
        found: Nodes = np.empty(0, dtype=np.int64)
        for seconds in self.options.horizons:
            camera = self.motion.ahead(seconds)
            if camera is None or len(found) >= self.options.enough:
                break
            found = np.concatenate([found, look(camera).asks])
            _, first = np.unique(found, return_index=True)
            found = found[np.sort(first)]
        return found
