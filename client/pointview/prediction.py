"""Where a moving camera will be: the motion it is in goes on, at constant linear and angular velocity. Pure.

Theory
------
A camera is a frame of three axes at the eye, in units of its distance to the target: its *pose* is a rotation R, a
place e and a length d. From one pose to another leads exactly one map of space ``x -> e1 + (d1/d0) Q (x - e0)`` with
``Q = R1 R0^T``, a rotation, a shift and a change of scale at once. To apply it again, or half of it, is to go on at the
velocity "about the right thing", whatever that is: an orbit goes on around its centre, a turning head around the eye, a
flight along its line or its arc, and a zoom by equal factors, so that it never passes what it approaches (Chasles'
theorem, with the scale as a fourth freedom).

With k and theta the axis and angle of Q, and ``lambda = ln(d1/d0)``, the velocity at time s (in steps of the observed
motion) is ``exp(lambda s)`` times a turn by ``theta s`` of the one at 0. Its integral is, along k,

    e(1 + s) - e1 = exp(lambda) expm1(lambda s) / expm1(lambda) * (e1 - e0)

and across k the same with the complex ``lambda + i theta`` in place of lambda. Only differences of places enter, so
survey coordinates lose nothing.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .camera import Camera

SMALL = 1e-9
"""Below this a motion is none: radians, parts of the distance, logarithm of the scale."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """What counts as one motion.

    Parameters
    ----------
    memory : float
        Seconds over which the velocity is taken.
    gap : float
        Seconds without a pose after which what was before is forgotten.
    jump_angle, jump_distance, jump_scale : float
        A step from one pose to the next beyond one of these is a jump to another place: radians, parts of the distance
        from eye to target, factor of that distance.
    """

    memory: float = 0.2
    gap: float = 0.5
    jump_angle: float = 0.5
    jump_distance: float = 0.5
    jump_scale: float = 1.5


@dataclass(slots=True)
class Motion:
    """The last poses of a camera."""

    options: MotionOptions = field(default_factory=MotionOptions)
    _seen: deque[tuple[float, Camera]] = field(default_factory=deque)

    def note(self, t: float, camera: Camera) -> bool:
        """Take in where the camera is at a time in seconds, later than the one before; False if it jumped there."""
        if self._seen:
            before, last = self._seen[-1]
            if t <= before:
                return True
            if t - before > self.options.gap or self._jumped(last, camera):
                self._seen.clear()
        self._seen.append((t, camera))
        # The pose at the beginning of the memory stays: velocity is over the whole of it.
        while len(self._seen) > 2 and self._seen[1][0] <= t - self.options.memory:
            self._seen.popleft()
        return len(self._seen) > 1

    def ahead(self, seconds: float) -> Camera | None:
        """Return the camera after some seconds more of the same motion; None where it rests or is not known yet."""
        if len(self._seen) < 2 or self._seen[-1][1] == self._seen[-2][1]:
            return None
        (start, old), (now, camera) = self._seen[0], self._seen[-1]
        return carry_on(old, camera, seconds / (now - start))

    def _jumped(self, old: Camera, new: Camera) -> bool:
        if (old.fov_y, old.width, old.height) != (new.fov_y, new.width, new.height):
            return True
        _, angle = axis_angle(new.rotation().T @ old.rotation())
        reach = min(_distance(old), _distance(new))
        return (
            angle > self.options.jump_angle
            or math.dist(old.eye, new.eye) > self.options.jump_distance * reach
            or abs(math.log(_distance(new) / _distance(old))) > math.log(self.options.jump_scale)
        )


def carry_on(old: Camera, new: Camera, steps: float) -> Camera | None:
    """Carry on the motion from one camera to another.

    Parameters
    ----------
    steps : float
        How far: 1 is once more what lies between the two, 0 stays at `new`, -1 is `old`.

    Returns
    -------
    Camera or None
        None where the two see the same, and where the motion leaves the range of numbers.
    """
    turn = new.rotation().T @ old.rotation()
    axis, angle = axis_angle(turn)
    shift = np.array(new.eye) - np.array(old.eye)
    scale = math.log(_distance(new) / _distance(old))
    if abs(angle) < SMALL and abs(scale) < SMALL and np.linalg.norm(shift) < SMALL * _distance(new):
        return None
    if not abs(scale * steps) < 300:
        return None
    along = axis * (axis @ shift)
    across = shift - along
    # In the plane across the axis, `across` is 1 and `axis x across` is i.
    factor = _again(complex(scale, angle), steps)
    moved = _again(complex(scale, 0.0), steps).real * along + factor.real * across
    moved += factor.imag * np.cross(axis, across)
    _, up, forward = new.rotation() @ rotation(axis, -angle * steps)
    eye = np.array(new.eye) + moved
    target = eye + forward * (_distance(new) * math.exp(scale * steps))
    values = np.concatenate([eye, target, up])
    if not np.isfinite(values).all() or np.array_equal(eye, target):
        return None
    return replace(new, eye=_vector(eye), target=_vector(target), up=_vector(up))


def axis_angle(turn: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Axis (unit vector) and angle, 0 to pi, of a rotation matrix."""
    sine = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    size = float(np.linalg.norm(sine))
    cosine = (float(np.trace(turn)) - 1) / 2
    angle = math.atan2(size, cosine)
    if size > 1e-6 or cosine > 0:
        return (sine / size if size > 0 else np.array([0.0, 0.0, 1.0])), angle
    # A half turn has no sine: its matrix is 2 k k^T - 1.
    column = np.argmax(np.diag(turn))
    axis = (turn + np.eye(3))[:, column]
    axis /= np.linalg.norm(axis)
    return axis * (1.0 if axis @ sine >= 0 else -1.0), angle


def rotation(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """Return the matrix that turns by `angle` radians around a unit vector (Rodrigues' formula)."""
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _again(rate: complex, steps: float) -> complex:
    """Displacement of the next `steps` over that of the last one, velocities growing by exp(rate) a step."""
    if abs(rate) < SMALL:
        return complex(steps)
    return complex(np.exp(rate) * np.expm1(rate * steps) / np.expm1(rate))


def _distance(camera: Camera) -> float:
    return math.dist(camera.eye, camera.target)


def _vector(values: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
