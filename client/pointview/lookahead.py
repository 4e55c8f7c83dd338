"""What the next views of a moving camera will want, the nearest in time first.

How far ahead it pays to look depends on who steers. So predictions are remembered until their time comes, and compared
with where the camera is then: one *holds* if it is nearer to that than the camera that made it was. A horizon counts as
long as most of its last predictions held: motion that turns round every second leaves the short ones. Predictions that
a rest or a jump puts an end to tell nothing of the motion.
"""

from __future__ import annotations

import math
from collections import deque
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
    every : float
        Seconds from one prediction that is remembered to the next.
    rest : float
        Seconds without motion after which what was predicted before is forgotten.
    trust : float
        Share of a horizon's predictions that must have held; what is assumed before the first comes due.
    memory : int
        Predictions over which that share is taken, roughly: older ones fade.
    """

    horizons: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0)
    enough: int = 64
    every: float = 0.1
    rest: float = 0.25
    trust: float = 0.7
    memory: int = 16


@dataclass(slots=True)
class Lookahead:
    """Watches a camera and says what to fetch before it gets there."""

    options: LookaheadOptions = field(default_factory=LookaheadOptions)
    motion: Motion = field(default_factory=Motion)
    _held: list[float] = field(init=False)
    _due: list[deque[tuple[float, Camera, Camera]]] = field(init=False)
    _noted: float = field(default=-math.inf, init=False)
    _moved: float = field(default=-math.inf, init=False)
    _camera: Camera | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._held = [self.options.trust] * len(self.options.horizons)
        self._due = [deque() for _ in self.options.horizons]

    def note(self, t: float, camera: Camera) -> None:
        """Take in where the camera of a frame is, at a time in seconds."""
        went_on = self.motion.note(t, camera)
        if camera != self._camera:
            if not went_on or t - self._moved > self.options.rest:
                self._due = [deque() for _ in self.options.horizons]
            self._camera, self._moved = camera, t
            self._judge(t, camera)
        if t - self._noted >= self.options.every:
            self._noted = t
            for seconds, due in zip(self.options.horizons, self._due, strict=True):
                if (there := self.motion.ahead(seconds)) is not None:
                    due.append((t + seconds, camera, there))

    def _judge(self, t: float, camera: Camera) -> None:
        """Compare what was predicted for now with what is."""
        for number, due in enumerate(self._due):
            while due and due[0][0] <= t:
                _, here, there = due.popleft()
                held = _apart(there, camera) < _apart(here, camera)
                self._held[number] += (held - self._held[number]) / self.options.memory

    def nodes(self, look: Callable[[Camera], Cut]) -> Nodes:
        """Return the nodes that coming views lack, each once, most urgent first; none for a camera at rest.

        Parameters
        ----------
        look : callable
            Refines a view as the frame's own was.
        """
        found: Nodes = np.empty(0, dtype=np.int64)
        for seconds, held in zip(self.options.horizons, self._held, strict=True):
            camera = self.motion.ahead(seconds)
            if camera is None or held < self.options.trust or len(found) >= self.options.enough:
                break
            found = np.concatenate([found, look(camera).asks])
            _, first = np.unique(found, return_index=True)
            found = found[np.sort(first)]
        return found


def _apart(a: Camera, b: Camera) -> float:
    """How far two views are from each other: eyes and targets, over the distance between these."""
    return (math.dist(a.eye, b.eye) + math.dist(a.target, b.target)) / math.dist(b.eye, b.target)
