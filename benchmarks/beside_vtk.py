"""The CPU backend beside VTK's point rendering: `python benchmarks/beside_vtk.py [MODEL.lpc...]`.

Needs VTK (`pip install vtk`), which no part of pointstream does. The same samples in the same order, from the same
camera, at 1 and 3 pixels, all resident. A frame of VTK ends when OpenGL has finished, one of ours when the picture is
an array. The contestants draw in turn, so what else the machine does slows all of them alike; figures are medians.

    vtk       as it comes: vtkVertexGlyphFilter, vtkPolyDataMapper, the window's own multisampling; normals and colours
    vtk lean  the quickest that it goes: no multisampling, no normals, no light
    squares   ours, the picture of `vtk lean`: squares of pixels, nothing culled, no hole closed; on one thread, and two
    discs     ours, as every picture is drawn: lit discs, back faces dropped, holes closed

`wall` and `CPU` say how many times the splats of `vtk` in the same second, of the clock and of all threads together;
trust the second where the machine is shared. `lean` is the same against `vtk lean`, in CPU. `differ` is the share of
the pixels covered in either picture, this or `vtk lean`, that only one covers. With `--pictures FOLDER` the pictures
are kept.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import asked
import numpy as np
from PIL import Image
from splat import cut_of, front, sphere_clouds
from support import models

from lpc.codec import cloud_to_points
from lpc.points import PointBatch
from pointview.camera import Camera
from pointview.render import Style, open_backend

with suppress(ModuleNotFoundError):  # `--help` works without
    import vtkmodules.vtkRenderingOpenGL2  # noqa: F401  (registers the classes that draw)
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkPoints, vtkUnsignedCharArray
    from vtkmodules.vtkCommonDataModel import vtkPolyData
    from vtkmodules.vtkFiltersGeneral import vtkVertexGlyphFilter
    from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper, vtkRenderer, vtkRenderWindow

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from lpc.cloud import Cloud

SIZE = 1024
ROUNDS = 7
BACKGROUND = Style().background
SQUARES = Style(splat="square", two_sided=True, close_holes=False, edl_strength=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Samples, quantised in clouds for us and as arrays for VTK, and where they are seen from."""

    name: str
    header: Any
    clouds: list[Cloud]
    camera: Camera
    points: PointBatch

    @classmethod
    def of(cls, name: str, header: Any, clouds: list[Cloud], camera: Camera) -> Scene:
        points = PointBatch.concatenate([cloud_to_points(cloud, header) for cloud in clouds])
        return cls(name=name, header=header, clouds=clouds, camera=camera, points=points)

    @property
    def samples(self) -> int:
        return len(self.points)


class Vtk:
    """The samples in VTK, drawn off screen."""

    def __init__(self, scene: Scene, side: float, *, lean: bool) -> None:
        camera, points = scene.camera, scene.points
        positions, content = vtkPoints(), vtkPolyData()
        positions.SetData(numpy_to_vtk((points.xyz - np.array(camera.target)).astype(np.float32), deep=True))
        content.SetPoints(positions)
        if "normal" in points.attributes and not lean:
            content.GetPointData().SetNormals(numpy_to_vtk(points.attributes["normal"], deep=True))
        if "color" in points.attributes:
            content.GetPointData().SetScalars(numpy_to_vtk(_bytes(points.attributes["color"]), deep=True))
        cells, mapper, actor = vtkVertexGlyphFilter(), vtkPolyDataMapper(), vtkActor()
        cells.SetInputData(content)
        mapper.SetInputConnection(cells.GetOutputPort())
        actor.SetMapper(mapper)
        actor.GetProperty().SetPointSize(side)
        actor.GetProperty().SetLighting(not lean)
        renderer, self._window = vtkRenderer(), vtkRenderWindow()
        renderer.AddActor(actor)
        renderer.SetBackground(*(channel / 255 for channel in BACKGROUND))
        self._window.SetOffScreenRendering(1)
        if lean:
            self._window.SetMultiSamples(0)
        self._window.SetSize(camera.width, camera.height)
        self._window.AddRenderer(renderer)
        view = renderer.GetActiveCamera()
        view.SetPosition(*np.subtract(camera.eye, camera.target))
        view.SetFocalPoint(0, 0, 0)
        view.SetViewUp(*camera.up)
        view.SetViewAngle(camera.fov_y)
        renderer.ResetCameraClippingRange()

    def draw(self) -> None:
        self._window.Render()
        self._window.WaitForCompletion()

    def picture(self) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """The last frame, and where it is covered."""
        width, height = self._window.GetSize()
        pixels = vtkUnsignedCharArray()
        self._window.GetPixelData(0, 0, width - 1, height - 1, 0, pixels, 0)
        rgb = vtk_to_numpy(pixels).reshape(height, width, 3)[::-1]
        return rgb, (rgb != np.array(BACKGROUND)).any(axis=2)

    def close(self) -> None:
        self._window.Finalize()


class Ours:
    """The samples in the CPU backend."""

    def __init__(self, scene: Scene, side: float, style: Style, threads: int) -> None:
        # Up to a side of one pixel a splat is the pixel that its sample falls into.
        cut = cut_of(scene.header, scene.clouds, side if side > 1 else 0.5, scene.camera)
        self._backend = open_backend("cpu", scene.header, threads=threads)
        self.draw = partial(self._backend.draw, cut, scene.clouds.__getitem__, scene.camera, style)

    def picture(self) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        frame = self.draw()
        return frame.rgb, frame.node >= 0

    def close(self) -> None:
        self._backend.close()


def _bytes(color: NDArray[Any]) -> NDArray[np.uint8]:
    return color if color.dtype == np.uint8 else (color >> 8).astype(np.uint8)


def main() -> None:
    parser = asked.parser(__doc__)
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    if find_spec("vtkmodules") is None:
        parser.error("VTK is not installed: pip install vtk")
    print(f"{'model':16} {'px':>2} {'':10} {'ms wall':>8} {'CPU':>7} {'M/s wall':>8} {'CPU':>6}"
          f" {'wall':>6} {'CPU':>6} {'lean':>6} {'differ':>7}")  # fmt: skip
    for scene in scenes(options.models):
        for side in (1.0, 3.0):
            compare(scene, side, options.pictures)


def scenes(paths: list[Path]) -> Iterator[Scene]:
    """The models, then four million samples of a sphere."""
    for path in paths:
        model = models.load(path.read_bytes())
        yield Scene.of(path.stem, model.header, model.clouds, Camera.frame_model(model.header, width=SIZE, height=SIZE))
    header, clouds = sphere_clouds()
    yield Scene.of("sphere", header, clouds, front(SIZE))


def compare(scene: Scene, side: float, pictures: Path | None) -> None:
    """Print the table of one scene at one size of splats."""
    contestants: dict[str, Vtk | Ours] = {
        "vtk": Vtk(scene, side, lean=False),
        "vtk lean": Vtk(scene, side, lean=True),
        "squares, 1": Ours(scene, side, SQUARES, threads=1),
        "squares": Ours(scene, side, SQUARES, threads=2),
        "discs": Ours(scene, side, Style(), threads=2),
    }
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in contestants}
    for _ in range(ROUNDS + 1):  # the first is to warm up
        for name, contestant in contestants.items():
            wall, cpu = time.perf_counter(), time.process_time()
            contestant.draw()
            times[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    median = {name: np.median(taken[1:], axis=0) for name, taken in times.items()}
    _, same = contestants["vtk lean"].picture()
    for name, contestant in contestants.items():
        rgb, covered = contestant.picture()
        (wall, cpu), (vtk_wall, vtk_cpu) = median[name], median["vtk"]
        differ = np.count_nonzero(covered != same) / np.count_nonzero(covered | same)
        print(
            f"{scene.name:16} {side:2g} {name:10} {1e3 * wall:8.1f} {1e3 * cpu:7.1f}"
            f" {scene.samples / wall / 1e6:8.1f} {scene.samples / cpu / 1e6:6.1f}"
            f" {vtk_wall / wall:6.1f} {vtk_cpu / cpu:6.1f} {median['vtk lean'][1] / cpu:6.1f} {100 * differ:6.2f}%"
        )
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            Image.fromarray(rgb).save(pictures / f"{scene.name}-{side:g}-{name.replace(' ', '-').replace(',', '')}.png")
        contestant.close()


if __name__ == "__main__":
    main()
