"""Where the eye is and what it sees: float64 throughout, every product relative to the eye.

Conventions: model space is right-handed and in model units; camera space has x to the right, y up and *depth*
forward: the distance along the viewing direction, positive in front of the eye. Pixel (0, 0) is the top left one, its
centre is at (0.5, 0.5). Survey coordinates of 6,000,000 m lose their millimetres in float32, so nothing becomes
float32 before the eye has been subtracted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.errors import FormatError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from lpc.header import Header

Vector = tuple[float, float, float]

FOV_Y = 45.0
MARGIN = 1.04  # a model framed by `Camera.frame_model` leaves this much room around it
MIN_NEAR = 1e-6  # of the far distance: closer samples would be splats larger than the picture


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """A perspective camera with square pixels.

    Parameters
    ----------
    eye, target, up : (x, y, z)
        Model units. `up` need not be perpendicular to the viewing direction; where it is parallel to it another axis
        takes its place.
    fov_y : float
        Vertical field of view, degrees, between 0 and 180.
    width, height : int
        Picture size, pixels.

    Raises
    ------
    FormatError
        For anything that is no view: not finite, eye at the target, field of view or size out of range.
    """

    eye: Vector
    target: Vector
    up: Vector
    fov_y: float = FOV_Y
    width: int = 1024
    height: int = 768

    def __post_init__(self) -> None:
        numbers = (*self.eye, *self.target, *self.up, self.fov_y)
        if not all(math.isfinite(number) for number in numbers):
            raise FormatError("view: a number is not finite")
        if not 0 < self.fov_y < 180:
            raise FormatError(f"view: fov_y is {self.fov_y:g}, it must be between 0 and 180 degrees")
        if self.width < 1 or self.height < 1:
            raise FormatError(f"a picture of {self.width}x{self.height} pixels has no pixel")
        if math.dist(self.eye, self.target) == 0:
            raise FormatError("view: eye and target are the same point")
        if math.hypot(*self.up) == 0:
            raise FormatError("view: up is the zero vector")

    @classmethod
    def from_view(cls, view: Mapping[str, Any], *, width: int, height: int) -> Camera:
        """Build a camera from the object of a VIEW.json file.

        Raises
        ------
        FormatError
            If a key is missing or its value is not what the contract says.
        """
        if not isinstance(view, Mapping):
            raise FormatError("view: not a JSON object with eye, target, up and fov_y")

        def vector(key: str) -> Vector:
            value = view.get(key)
            if not isinstance(value, list | tuple) or len(value) != 3 or not all(_is_number(item) for item in value):
                raise FormatError(f"view: {key} must be three numbers [x, y, z]")
            return float(value[0]), float(value[1]), float(value[2])

        fov_y = view.get("fov_y", FOV_Y)
        if not _is_number(fov_y):
            raise FormatError("view: fov_y must be a number of degrees")
        return cls(
            eye=vector("eye"), target=vector("target"), up=vector("up"), fov_y=float(fov_y), width=width, height=height
        )

    def to_view(self) -> dict[str, Any]:
        """Return the inverse of `from_view`: an object for a VIEW.json file."""
        return {"eye": list(self.eye), "target": list(self.target), "up": list(self.up), "fov_y": self.fov_y}

    @classmethod
    def frame_model(
        cls, header: Header, *, width: int, height: int, fov_y: float = FOV_Y, z_up: bool | None = None
    ) -> Camera:
        """Frame a whole model: along -y with z up, along -z with y up; z is up where it is georeferenced."""
        if header.crs is not None if z_up is None else z_up:
            backward, up = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
        else:
            backward, up = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
        return cls.frame_box(header.bounds, backward=backward, up=up, width=width, height=height, fov_y=fov_y)

    @classmethod
    def frame_box(
        cls, bounds: ArrayLike, *, backward: Vector, up: Vector, width: int, height: int, fov_y: float = FOV_Y
    ) -> Camera:
        """Frame a box from the side that `backward` points to.

        Parameters
        ----------
        bounds : (6,) float64
            x0, y0, z0, x1, y1, z1, model units.
        backward : (x, y, z)
            Unit vector from the box's centre to the eye.
        """
        low, high = np.asarray(bounds, dtype=np.float64).reshape(2, 3)
        center = (low + high) / 2
        unit = cls(eye=backward, target=(0.0, 0.0, 0.0), up=up, fov_y=fov_y, width=width, height=height)
        corners = np.array(np.meshgrid(*zip(low - center, high - center, strict=True))).reshape(3, 8).T
        right, above, forward = (corners @ unit.rotation().T).T
        # A corner is inside when |right| <= tan * depth, and depth = distance + forward.
        tan_y = math.tan(math.radians(fov_y) / 2)
        tan_x = tan_y * width / height
        distance = float(np.max(np.maximum(np.abs(right) / tan_x, np.abs(above) / tan_y) * MARGIN - forward))
        if distance <= 0:  # all samples coincide
            distance = max(1.0, float(np.abs(center).max()) * 1e-6)
        eye = center + distance * np.array(backward)
        return cls(eye=_vector(eye), target=_vector(center), up=up, fov_y=fov_y, width=width, height=height)

    @property
    def focal(self) -> float:
        """Pixels of a length of one unit at a depth of one unit."""
        return self.height / (2 * math.tan(math.radians(self.fov_y) / 2))

    def rotation(self) -> NDArray[np.float64]:
        """Rows right, up and forward, (3, 3): `rotation() @ (x - eye)` is x in camera space."""
        # Of three numbers Python is quicker than numpy.
        (x, y, z), (eye_x, eye_y, eye_z) = self.target, self.eye
        forward = _unit((x - eye_x, y - eye_y, z - eye_z))
        right = _cross(forward, _unit(self.up))
        if math.hypot(*right) < 1e-9:
            least = min(range(3), key=lambda axis: abs(forward[axis]))
            right = _cross(forward, (float(least == 0), float(least == 1), float(least == 2)))
        right = _unit(right)
        return np.array([right, _cross(right, forward), forward])

    def to_camera(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points of model space (n, 3) in camera space: right, up, depth."""
        return (np.asarray(points, dtype=np.float64) - np.array(self.eye)) @ self.rotation().T

    def project(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixel coordinates (n, 2), y down, and depths (n,) of points of model space.

        Notes
        -----
        Points that are not in front of the eye have a depth <= 0 and pixel coordinates without meaning.
        """
        right, up, depth = self.to_camera(points).T
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = self.focal / depth
            pixel = np.stack([self.width / 2 + right * scale, self.height / 2 - up * scale], axis=1)
        return pixel, depth

    def frustum_planes(self) -> NDArray[np.float64]:
        """Inward unit normals of the left, right, bottom, top and eye planes, (5, 3), in model space.

        All five pass through the eye, so a sphere is outside one when `normal @ (center - eye) < -radius`. There is
        no far plane: the far distance follows from what is drawn (`depth_range`).
        """
        tan_y = math.tan(math.radians(self.fov_y) / 2)
        tan_x = tan_y * self.width / self.height
        planes = np.array([[1, 0, tan_x], [-1, 0, tan_x], [0, 1, tan_y], [0, -1, tan_y], [0, 0, 1]], dtype=np.float64)
        planes /= np.linalg.norm(planes, axis=1, keepdims=True)
        return planes @ self.rotation()

    def depth_range(self, center: NDArray[np.float64], radius: NDArray[np.float64]) -> tuple[float, float]:
        """Nearest and farthest depth of spheres, both positive, near < far.

        Parameters
        ----------
        center : (n, 3) float64
            Model space.
        radius : (n,) float64
        """
        if len(center) == 0:
            return 1.0, 2.0
        depth = (np.asarray(center, dtype=np.float64) - np.array(self.eye)) @ self.rotation()[2]
        far = float(np.max(depth + radius))
        if far <= 0:
            return 1.0, 2.0
        far *= 1.0 + 1e-5
        near = max(float(np.min(depth - radius)) * (1.0 - 1e-5), far * MIN_NEAR)
        return near, far


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _unit(vector: Vector) -> Vector:
    x, y, z = vector
    length = math.hypot(x, y, z)
    return x / length, y / length, z / length


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _vector(values: NDArray[np.float64]) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])
