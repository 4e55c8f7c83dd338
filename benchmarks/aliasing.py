"""How splats alias, and what each kind does about it: `PYTHONPATH=tests python benchmarks/aliasing.py`.

Closed surfaces of random samples from three distances and at several tolerances: a sphere with a checkerboard in space,
the same without normals, and a grey one with bumps. The reference is the surface itself: 8x8 rays a pixel, lit by the
same lamp, the mean of their light. For each way to draw, in dB against 255: PSNR *inside* the silhouette, PSNR of *all*
pixels that the surface touches, and of the *change* between two cameras a fraction of a pixel apart, which a slow pan
shows as flicker. `--model MODEL.lpc` takes a scan instead; its reference is its finest picture of discs, 8x8 a pixel.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import asked
import numpy as np
from PIL import Image
from support import traced

from lpc.codec import decode_cloud
from lpc.context import line_of
from lpc.header import parse_header
from lpc.index import IndexTree
from lpc.points import PointBatch
from pointbuild import BuildOptions, build_model
from pointbuild.arrays import ArrayScan
from pointview.camera import Camera
from pointview.refine import refine
from pointview.render import Style, antialias, shading
from pointview.render.blending import linear_light
from pointview.render.cpu import CpuBackend

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

RAYS = 8
"""Of the reference, a pixel and axis."""

SIZES = (256, 96, 36)
"""Of the picture of one view, pixels: the smaller, the farther away."""

CELL = 0.05
"""Of the checkerboard; the sphere's radius is 1 and fills 80% of the picture."""

SHIFT = (0.37, 0.23)
"""Of the second camera, pixels."""

BUMPS, HEIGHT = 40.0, 0.01
"""Radians a radius, radii."""


@dataclass(frozen=True)
class Surface:
    """A surface around the origin, one radius in each direction."""

    name: str
    radius: Callable[[Array], Array]
    steepest: float  # of the radius, along the unit sphere
    checkered: bool
    normals: bool = True

    def value(self, xyz: Array) -> Array:
        """No more than the distance, negative inside."""
        far = np.linalg.norm(xyz, axis=-1)
        away = far - self.radius(xyz / np.maximum(far, 1e-9)[..., None])
        return np.asarray(away / math.hypot(1.0, 1.2 * self.steepest))

    def normal(self, xyz: Array, step: float = 1e-5) -> Array:
        slope = [self.value(xyz + step * axis) - self.value(xyz - step * axis) for axis in np.eye(3)]
        return np.asarray(np.stack(slope, axis=-1) / np.linalg.norm(slope, axis=0)[..., None])

    def sample(self, count: int) -> Array:
        """Random samples, evenly by area."""
        rng, found = np.random.default_rng(0), np.empty((0, 3))
        largest = (1 + HEIGHT) ** 2 * math.hypot(1.0, self.steepest)
        while len(found) < count:
            direction = rng.normal(size=(2 * count, 3))
            direction /= np.linalg.norm(direction, axis=1)[:, None]
            xyz = direction * self.radius(direction)[:, None]
            lean = np.einsum("ij,ij->i", self.normal(xyz), direction)
            area = self.radius(direction) ** 2 / lean
            found = np.concatenate([found, xyz[rng.random(len(xyz)) < area / largest]])
        return found[:count]

    def albedo(self, xyz: Array) -> Array:
        return checker(xyz) / 255.0 if self.checkered else np.full(xyz.shape, Style().surface) / 255.0


def _one(direction: Array) -> Array:
    return np.ones(direction.shape[:-1])


def _bumpy(direction: Array) -> Array:
    return np.asarray(1 + HEIGHT * np.sin(BUMPS * direction).prod(axis=-1))


SURFACES = (
    Surface("checkerboard", _one, 0.0, True),
    Surface("checkerboard without normals", _one, 0.0, True, normals=False),
    Surface("bumps", _bumpy, HEIGHT * BUMPS, False),
)


@dataclass(frozen=True)
class Way:
    """A way to draw: a style, at so many times the picture's width and height."""

    name: str
    style: Style
    finer: int = 1


PLAIN = Style(edl_strength=0.0)
WAYS = (
    Way("square", replace(PLAIN, splat="square")),
    Way("round", replace(PLAIN, splat="round")),
    Way("disc", PLAIN),
    Way("holes open", replace(PLAIN, close_holes=False)),
    Way("disc 2x2", PLAIN, 2),
    Way("blended", replace(PLAIN, splat="blended")),
    Way("blended 2x2", replace(PLAIN, splat="blended"), 2),
)


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("--samples", type=asked.samples, default=1_500_000)
    parser.add_argument("--tolerances", type=float, nargs="+", default=[0.5, 1.0, 2.0, 4.0, 8.0])
    parser.add_argument("--model", type=Path, help="a model instead of the surfaces")
    parser.add_argument("--sheet", type=Path, help="write the pictures of the nearest view side by side")
    arguments = parser.parse_args()
    if arguments.model:
        model = Model(arguments.model.read_bytes())
        study(arguments.model.stem, model, lambda camera: finest(model, camera), arguments)
        return
    for surface in SURFACES:
        xyz = surface.sample(arguments.samples)
        model = Model(built(surface, xyz))

        def truth(camera: Camera, surface: Surface = surface) -> tuple[Array, Array]:
            return traced_picture(surface, camera)

        study(surface.name, model, truth, arguments)


def study(name: str, model: Model, truth_at: Callable[[Camera], tuple[Array, Array]], arguments: Any) -> None:
    """Print the table of one model."""
    backend = CpuBackend(model.header, threads=2)
    print(f"\n{name}: {model.header.samples:,} samples; dB inside, of all, of the change")
    print(f"{'view':>4} {'px':>3} {'splats':>8} " + "".join(f"| {way.name:15}" for way in WAYS))
    for size in SIZES:
        cameras = [model.camera(size, shift) for shift in ((0.0, 0.0), SHIFT)]
        truth = [truth_at(camera) for camera in cameras]
        rows, costs, drawn = [], [], 0
        for tolerance in arguments.tolerances:
            shown = [[model.draw(backend, camera, tolerance, way) for camera in cameras] for way in WAYS]
            if shown[0][0].splats == drawn:
                break  # all that is left is the root
            drawn = shown[0][0].splats
            figures = [compare([drawing.picture for drawing in pair], truth) for pair in shown]
            print(
                f"{size:4d} {tolerance:3g} {drawn:8,} "
                + "".join("| " + "".join(f"{value:5.1f}" for value in three) for three in figures)
            )
            rows.append(np.hstack([truth[0][0], *(pair[0].picture for pair in shown)]))
            costs.append([pair[1].seconds for pair in shown])
        if size == SIZES[0]:
            for tolerance, cost in zip(arguments.tolerances, costs, strict=False):
                print(f"ms of CPU at {tolerance:3g} px  " + "".join(f"| {1e3 * one:14.1f} " for one in cost))
            if arguments.sheet:
                sheet = np.rint(np.vstack(rows)).astype(np.uint8)
                Image.fromarray(sheet).save(arguments.sheet.with_stem(f"{arguments.sheet.stem}-{name}"))
    backend.close()


def checker(xyz: Array) -> Array:
    """Black and white, in space."""
    odd = np.floor(xyz / CELL).astype(np.int64).sum(axis=-1) % 2
    return np.where(odd[..., None] == 1, 235, 40).astype(np.uint8) * np.ones(3, dtype=np.uint8)


def built(surface: Surface, xyz: Array) -> bytes:
    """A model of samples, as a file's bytes."""
    attributes: dict[str, Array] = {}
    if surface.normals:
        attributes["normal"] = surface.normal(xyz).astype(np.float32)
    if surface.checkered:
        attributes["color"] = checker(xyz)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "model.lpc"
        build_model(
            [ArrayScan(PointBatch(xyz, attributes))],
            out,
            BuildOptions(threads=1, normals="file"),
            clock=time.monotonic,
        )
        return out.read_bytes()


@dataclass(frozen=True)
class Drawing:
    """A picture (h, w, 3) float64, levels; its splats; CPU seconds."""

    picture: Array
    splats: int
    seconds: float


class Model:
    """A model in memory."""

    def __init__(self, data: bytes) -> None:
        self.header = parse_header(data)
        self.index = IndexTree(self.header)
        for page in range(self.header.pages):
            where = self.index.page_range(page)
            self.index.add_page(page, data[where.start : where.stop])
        self._data = data
        self._clouds: dict[int, Any] = {}

    def take(self, node: int) -> Any:
        if node not in self._clouds:
            where = self.index.cloud_range(node)
            self._clouds[node] = decode_cloud(
                self._data[where.start : where.stop],
                samples=int(self.index.samples[node]),
                schema=self.header.attributes,
                context=[self.take(above) for above in line_of(node, self.index.parent)],
            )
        return self._clouds[node]

    def camera(self, size: int, shift: tuple[float, float]) -> Camera:
        """A camera that sees the model in 80% of its picture, shifted by some pixels."""
        center, radius = self.index.center[0], float(self.index.radius[0])
        direction, half = np.array([0.35, -0.8, 0.48]), math.radians(30)
        away = radius / math.sin(math.atan(0.8 * math.tan(half)))
        camera = Camera(
            eye=tuple(center + away * direction / np.linalg.norm(direction)), target=tuple(center), up=(0, 0, 1),
            fov_y=math.degrees(2 * half), width=size, height=size,
        )  # fmt: skip
        right, up, _ = camera.rotation()
        moved = (shift[0] * right + shift[1] * up) * away / camera.focal
        return replace(camera, eye=tuple(np.array(camera.eye) + moved), target=tuple(center + moved))

    def draw(self, backend: CpuBackend, camera: Camera, tolerance: float, way: Way) -> Drawing:
        cut = refine(self.index, camera, tolerance, np.ones(self.header.nodes, dtype=bool))
        antialias.draw(backend, cut, self.take, camera, way.style, finer=way.finer)
        start = time.process_time()
        frame = antialias.draw(backend, cut, self.take, camera, way.style, finer=way.finer)
        return Drawing(frame.rgb.astype(float), cut.splats, time.process_time() - start)


def traced_picture(surface: Surface, camera: Camera) -> tuple[Array, Array]:
    """The surface in 8x8 rays a pixel, (h, w, 3) float64; and how much of each pixel it covers."""
    fine = replace(camera, width=camera.width * RAYS, height=camera.height * RAYS)
    depth = traced.trace(surface.value, fine)
    ray, length = traced.rays(fine)
    seen = np.isfinite(depth)
    xyz = np.array(camera.eye) + ray[seen] * (depth * length)[seen][:, None]
    levels = surface.albedo(xyz)
    if surface.normals:
        bright, shine = lit(surface.normal(xyz), -ray[seen], camera)
        levels = np.minimum(levels * bright[:, None] + shine[:, None], 1.0)
    picture = np.broadcast_to(np.array(PLAIN.background, dtype=np.uint8), (*depth.shape, 3)).copy()
    picture[seen] = np.rint(255 * levels)
    return encoded(boxes(linear_light()[picture], RAYS)), boxes(seen[..., None].astype(float), RAYS)[..., 0]


def lit(normal: Array, toward_eye: Array, camera: Camera) -> tuple[Array, Array]:
    """Factor of the albedo and highlight, see `shading`."""
    lamp = shading.lamp() @ camera.rotation()
    toward = np.maximum(normal @ lamp, 0.0)
    mirror = 2 * toward * np.einsum("ij,ij->i", normal, toward_eye) - toward_eye @ lamp
    shine = np.where(toward > 0, shading.SPECULAR * np.maximum(mirror, 0.0) ** shading.SHININESS, 0.0)
    return shading.AMBIENT + shading.DIFFUSE * toward, shine


def finest(model: Model, camera: Camera) -> tuple[Array, Array]:
    """The finest picture of a model, 8x8 a pixel; and how much of each pixel it covers."""
    fine = replace(camera, width=camera.width * RAYS, height=camera.height * RAYS)
    cut = refine(model.index, fine, 1.0, np.ones(model.header.nodes, dtype=bool))
    frame = CpuBackend(model.header, threads=2).draw(cut, model.take, fine, PLAIN)
    covered = np.isfinite(frame.depth)[..., None].astype(float)
    return encoded(boxes(linear_light()[frame.rgb], RAYS)), boxes(covered, RAYS)[..., 0]


def boxes(image: Array, side: int) -> Array:
    """Means of boxes of pixels."""
    height, width, channels = image.shape
    return image.reshape(height // side, side, width // side, side, channels).mean(axis=(1, 3), dtype=np.float64)


def encoded(light: Array) -> Array:
    """Levels of sRGB, 0 to 255, not rounded."""
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def compare(shown: Any, truth: Any) -> tuple[float, float, float]:
    """PSNR inside, of all, and of the change, dB."""
    covered = [coverage > 0 for _, coverage in truth]
    inside = truth[0][1] == 1
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        inside &= np.roll(truth[0][1], step, axis) == 1
    off = [one - picture for one, (picture, _) in zip(shown, truth, strict=True)]
    both = covered[0] & covered[1]
    return decibel(off[0][inside]), decibel(off[0][covered[0]]), decibel((off[1] - off[0])[both])


def decibel(off: Array) -> float:
    return 20 * math.log10(255 / max(float(np.sqrt(np.mean(np.square(off)))), 1e-9))


if __name__ == "__main__":
    main()
