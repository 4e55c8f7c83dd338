"""What a person did in a frame, and what that does to the viewpoint: pure, so that no test needs a window."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from . import controls
from .controls import Viewpoint

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pointview.camera import Camera, Vector

KEYS: tuple[tuple[str, str], ...] = (
    ("left drag", "orbit around the picked point"),
    ("right or middle drag", "shift the picture"),
    ("wheel", "zoom towards the cursor"),
    ("double click", "pick the point to turn around"),
    ("W A S D, E Q", "fly forward, left, back, right, up, down; Shift: faster"),
    ("G", "dragging turns the head: fly with the mouse"),
    ("F", "fit the model"),
    ("Home", "first view"),
    ("1 ... 6", "front, back, left, right, top, bottom"),
    ("U", "y or z is up"),
    ("C", "next colour mode"),
    ("T", "tint what waits for data"),
    ("[ ]", "finer, coarser"),
    ("B", "budget on, off"),
    ("P", "picture to a file"),
    ("R", "record the path, and write it"),
    ("Ctrl V", "open the pasted path or address"),
    ("Tab", "panel on, off"),
    ("F1, ?", "this help"),
    ("Ctrl Q", "close"),
)
"""Controls as the help lists them."""

AXES = {"1": "front", "2": "back", "3": "left", "4": "right", "5": "top", "6": "bottom"}

FLY = {"w": (0, 0, 1), "s": (0, 0, -1), "a": (-1, 0, 0), "d": (1, 0, 0), "e": (0, 1, 0), "q": (0, -1, 0)}
"""Right, up, forward."""

TURN = 2 * math.pi
"""Radians of orbiting over the smaller side of the picture."""

NOTCH = 0.85
"""Distance left after one notch of the wheel."""

FASTER = 4.0
"""Factor of the speed while Shift is held."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """One frame's input, for the picture alone: what the panel took is not in it.

    Parameters
    ----------
    seconds : float
        Since the frame before.
    size : (int, int)
        Width and height of the picture, pixels.
    cursor : (float, float)
        Pixel position.
    turned, shifted : (float, float)
        Pixels of dragging with the left button, and with another, right and down.
    wheel : float
        Notches, positive away from the hand.
    picked : bool
        Double click.
    pressed, held : frozenset of str
        Keys that went down, and keys that are down.
    dropped : tuple of str
        Paths and addresses that were dropped or pasted.
    """

    seconds: float
    size: tuple[int, int]
    cursor: tuple[float, float] = (0.0, 0.0)
    turned: tuple[float, float] = (0.0, 0.0)
    shifted: tuple[float, float] = (0.0, 0.0)
    wheel: float = 0.0
    picked: bool = False
    pressed: frozenset[str] = field(default_factory=frozenset)
    held: frozenset[str] = field(default_factory=frozenset)
    dropped: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What motions refer to.

    Parameters
    ----------
    bounds : (6,) floats
        Of the model.
    vertical : (x, y, z)
    home : Camera
        The first view.
    depth : (h, w) float32
        Of the last picture.
    shot : Camera
        That took it.
    """

    bounds: tuple[float, ...]
    vertical: Vector
    home: Camera
    depth: NDArray[np.float32]
    shot: Camera

    @property
    def extent(self) -> float:
        """Diagonal of the bounds, model units; 1 for a single point."""
        return math.dist(self.bounds[:3], self.bounds[3:]) or 1.0

    @property
    def closest(self) -> float:
        """Least distance to zoom in to, model units."""
        return controls.CLOSEST * self.extent + 1e-9 * max(abs(value) for value in self.bounds)

    def pick(self, x: float, y: float) -> Vector | None:
        """Find the point of the model under a pixel of the last picture."""
        return controls.pick(self.depth, self.shot, x, y)


def moved(view: Viewpoint, did: Inputs, scene: Scene, *, fly: bool, speed: float) -> Viewpoint:
    """Return the viewpoint after a frame's input.

    Parameters
    ----------
    fly : bool
        Dragging with the left button turns the head instead of the model.
    speed : float
        Of flying, extents of the scene per second.
    """
    view = _jumped(view, did.pressed, scene)
    if (view.camera.width, view.camera.height) != did.size:
        view = controls.resized(view, *did.size)
    if did.picked and (point := scene.pick(*did.cursor)) is not None:
        view = controls.turn_to(view, point)
    if did.turned != (0.0, 0.0):
        scale = TURN / min(did.size)
        yaw, pitch = -did.turned[0] * scale, did.turned[1] * scale
        view = controls.look_around(view, yaw / 3, pitch / 3) if fly else controls.orbit(view, yaw, pitch)
    if did.shifted != (0.0, 0.0):
        view = controls.pan(view, *did.shifted)
    if did.wheel:
        anchor = controls.anchor_of(view, *did.cursor, scene.pick(*did.cursor))
        view = controls.zoom(view, NOTCH**did.wheel, anchor, closest=scene.closest)
    return _flown(view, did, scene, speed)


def _jumped(view: Viewpoint, pressed: frozenset[str], scene: Scene) -> Viewpoint:
    for key in pressed:
        if key in AXES:
            view = controls.axis_view(view, scene.bounds, AXES[key], scene.vertical)
        elif key == "f":
            view = controls.fit(view, scene.bounds)
        elif key == "home":
            view = controls.resized(Viewpoint.of(scene.home), view.camera.width, view.camera.height)
    return view


def _flown(view: Viewpoint, did: Inputs, scene: Scene, speed: float) -> Viewpoint:
    keys = did.held & FLY.keys()
    if not keys:
        return view
    direction = np.sum([FLY[key] for key in keys], axis=0)
    length = speed * scene.extent * did.seconds * (FASTER if "shift" in did.held else 1.0)
    right, up, forward = (float(part) for part in direction * length)
    return controls.travel(view, right, up, forward)
