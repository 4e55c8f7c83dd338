"""Camera motions as pure functions: a viewpoint and what the hand did to the next viewpoint.

A viewpoint is a camera and its *pivot*, the point that it turns around. `up` is the model's vertical and stays what it
is: orbiting is a turntable, as in Potree and in CloudCompare with a locked vertical.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pointview.camera import Camera, Vector

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

POLE = math.radians(1.0)
"""Least angle between the viewing direction and the vertical; nearer, the horizon would flip."""

CLOSEST = 1e-6
"""Least distance of the eye from what it zooms in on, over the size of the model's coordinates and extent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Viewpoint:
    """A camera, and the point of model space that it turns around."""

    camera: Camera
    pivot: Vector

    @classmethod
    def of(cls, camera: Camera) -> Viewpoint:
        """Turn around what the camera looks at."""
        return cls(camera=camera, pivot=camera.target)


def orbit(view: Viewpoint, yaw: float, pitch: float) -> Viewpoint:
    """Turn the camera around the pivot; the pivot keeps its distance and its place in the picture.

    Parameters
    ----------
    yaw, pitch : float
        Radians; positive moves the eye to the right and up. The pitch stops before the poles.
    """
    turn = _turn(view.camera, yaw, pitch)
    pivot = np.array(view.pivot)
    eye = pivot + turn @ (np.array(view.camera.eye) - pivot)
    target = pivot + turn @ (np.array(view.camera.target) - pivot)
    return replace(view, camera=replace(view.camera, eye=_vector(eye), target=_vector(target)))


def look_around(view: Viewpoint, yaw: float, pitch: float) -> Viewpoint:
    """Turn the head: the eye stays, positive angles look to the right and up."""
    eye = np.array(view.camera.eye)
    target = eye + _turn(view.camera, -yaw, pitch) @ (np.array(view.camera.target) - eye)
    return replace(view, camera=replace(view.camera, target=_vector(target)))


def pan(view: Viewpoint, dx: float, dy: float) -> Viewpoint:
    """Shift the picture by pixels, right and down, such that the plane of the pivot follows the hand."""
    camera = view.camera
    depth = float(camera.to_camera([view.pivot])[0, 2])
    if depth <= 0:  # the pivot was flown past
        depth = math.dist(camera.eye, camera.target)
    right, up, _ = camera.rotation()
    return _moved(view, (up * dy - right * dx) * depth / camera.focal)


def zoom(view: Viewpoint, factor: float, anchor: Vector, *, closest: float = 0.0) -> Viewpoint:
    """Bring the eye to `factor` times its distance from a point, which stays under its pixel.

    Parameters
    ----------
    anchor : (x, y, z)
        Model space.
    closest : float
        The eye does not come nearer to the anchor, model units.
    """
    at = np.array(anchor)
    offset = np.array(view.camera.eye) - at
    distance = float(np.linalg.norm(offset))
    if distance == 0.0 or (factor < 1.0 and distance * factor < closest):
        return view
    return _moved(view, (factor - 1.0) * offset)


def travel(view: Viewpoint, right: float, up: float, forward: float) -> Viewpoint:
    """Fly by lengths in model units along the axes of the camera; the pivot stays."""
    move = np.array([right, up, forward]) @ view.camera.rotation()
    return replace(_moved(view, move), pivot=view.pivot)


def turn_to(view: Viewpoint, point: Vector) -> Viewpoint:
    """Make a picked point the pivot; the picture does not change."""
    return replace(view, pivot=point)


def resized(view: Viewpoint, width: int, height: int) -> Viewpoint:
    """Give the camera another picture size; the vertical field of view stays."""
    return replace(view, camera=replace(view.camera, width=width, height=height))


def fit(view: Viewpoint, bounds: ArrayLike) -> Viewpoint:
    """Frame a box (x0, y0, z0, x1, y1, z1) from the present direction."""
    backward = _vector(-view.camera.rotation()[2])
    return _framed(view, bounds, backward, view.camera.up)


def axis_view(view: Viewpoint, bounds: ArrayLike, axis: str, vertical: Vector) -> Viewpoint:
    """Frame a box along an axis.

    Parameters
    ----------
    axis : {"front", "back", "left", "right", "top", "bottom"}
    vertical : (x, y, z)
        The model's up: (0, 0, 1) or (0, 1, 0). From above and below, the picture's up is what is behind from the front.
    """
    backward, up = axis_directions(axis, vertical)
    framed = _framed(view, bounds, backward, up)
    if up == vertical:
        return framed
    # Almost from above or below: with the model's vertical as up, orbiting goes on as a turntable.
    tilt = math.sin(POLE) * float(np.dot(backward, vertical))
    backward = _vector(np.array(backward) * math.cos(POLE) - np.array(up) * tilt)
    return _framed(view, bounds, backward, vertical)


def axis_directions(axis: str, vertical: Vector) -> tuple[Vector, Vector]:
    """Where the eye is from the box, and what is up in the picture."""
    z_up = vertical == (0.0, 0.0, 1.0)
    behind: Vector = (0.0, 1.0, 0.0) if z_up else (0.0, 0.0, -1.0)
    ahead: Vector = (-behind[0], -behind[1], -behind[2])
    below: Vector = (-vertical[0], -vertical[1], -vertical[2])
    return {
        "front": (ahead, vertical),
        "back": (behind, vertical),
        "left": ((-1.0, 0.0, 0.0), vertical),
        "right": ((1.0, 0.0, 0.0), vertical),
        "top": (vertical, behind),
        "bottom": (below, ahead),
    }[axis]


def unproject(camera: Camera, x: float, y: float, depth: float) -> Vector:
    """Point of model space at a pixel position and depth."""
    right = (x - camera.width / 2) * depth / camera.focal
    above = (camera.height / 2 - y) * depth / camera.focal
    return _vector(np.array(camera.eye) + np.array([right, above, depth]) @ camera.rotation())


def pick(depth: NDArray[np.float32], camera: Camera, x: float, y: float, *, reach: int = 12) -> Vector | None:
    """Find the drawn point nearest to a pixel position, or None if there is none within `reach` pixels.

    Parameters
    ----------
    depth : (height, width) float32
        Of the picture that `camera` took; infinite where it is empty.
    """
    column, row = int(x), int(y)
    left, top = max(0, column - reach), max(0, row - reach)
    window = depth[top : max(0, row + reach + 1), left : max(0, column + reach + 1)]
    rows, columns = np.nonzero(np.isfinite(window))
    if len(rows) == 0:
        return None
    nearest = int(np.argmin((columns + left - column) ** 2 + (rows + top - row) ** 2))
    at_x, at_y = float(columns[nearest]) + left + 0.5, float(rows[nearest]) + top + 0.5
    return unproject(camera, at_x, at_y, float(window[rows[nearest], columns[nearest]]))


def anchor_of(view: Viewpoint, x: float, y: float, picked: Vector | None) -> Vector:
    """Return what to zoom towards: the picked point, else the point under the cursor in the plane of the pivot."""
    if picked is not None:
        return picked
    depth = float(view.camera.to_camera([view.pivot])[0, 2])
    if depth <= 0:
        depth = math.dist(view.camera.eye, view.camera.target)
    return unproject(view.camera, x, y, depth)


def vertical_of(*, z_up: bool) -> Vector:
    """Return the model's up: z or y."""
    return (0.0, 0.0, 1.0) if z_up else (0.0, 1.0, 0.0)


def _framed(view: Viewpoint, bounds: ArrayLike, backward: Vector, up: Vector) -> Viewpoint:
    old = view.camera
    return Viewpoint.of(
        Camera.frame_box(bounds, backward=backward, up=up, width=old.width, height=old.height, fov_y=old.fov_y)
    )


def _moved(view: Viewpoint, move: NDArray[np.float64]) -> Viewpoint:
    eye, target = np.array(view.camera.eye) + move, np.array(view.camera.target) + move
    return replace(view, camera=replace(view.camera, eye=_vector(eye), target=_vector(target)))


def _turn(camera: Camera, yaw: float, pitch: float) -> NDArray[np.float64]:
    """Rotation about the vertical, then about the camera's right; short of the poles."""
    right, _, forward = camera.rotation()
    vertical = np.array(camera.up) / math.hypot(*camera.up)
    # Angle between the direction to look along and the vertical; the eye going up makes it larger.
    angle = math.acos(float(np.clip(forward @ vertical, -1.0, 1.0)))
    pitch = min(max(angle + pitch, POLE), math.pi - POLE) - angle
    return _rotation(vertical, yaw) @ _rotation(right, -pitch)


def _rotation(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """Rotation matrix about a unit axis, right-handed (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def _vector(values: NDArray[np.float64]) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])
