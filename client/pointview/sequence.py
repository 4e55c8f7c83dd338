"""Many pictures of one model: along a recorded path, or once around it; and an animation of them.

Every picture is settled before it is drawn, so a sequence shows no data on its way; `stream --path` shows that. What
one picture fetched is there for the next.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.errors import StoreError, Unavailable
from pointstream.layer import AccessLayer, LayerOptions
from pointstream.stores import open_store

from .camera import Camera
from .render import antialias, open_backend
from .render.picture import save_picture
from .settle import settle
from .still import CAPACITY, StillOptions, camera_of, cut_of
from .window.controls import Viewpoint, fit, orbit, zoom

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike
    from PIL import Image

    from lpc.header import Header
    from pointstream.cache import Cache

    from .stream.path import ViewPath

View = dict[str, Any]

MOST_BYTES = 2 << 30
"""Pixels of an animation that is made without being asked for: all formats but mp4 are written from memory."""

ANIMATIONS = ("mp4", "webp", "apng", "gif")
"""Formats, the preferred one first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceReport:
    """What a sequence took.

    Parameters
    ----------
    backend : str
    pictures : int
    first, last : str
        Names of the files.
    animation : str or None
        Name of the animated file.
    splats : int
        Of the picture with most.
    frame_ms : float
        Drawing, on average.
    bytes_read : int
    """

    backend: str
    pictures: int
    first: str
    last: str
    animation: str | None
    splats: int
    frame_ms: float
    bytes_read: int


def path_views(path: ViewPath, fps: float) -> list[View]:
    """Return the views along a path, `fps` a second from its first time to its last."""
    start, stop = path.times[0], path.times[-1]
    count = max(1, math.floor((stop - start) * fps + 1e-9) + 1)
    return [path.at(start + number / fps) for number in range(count)]


def turntable_views(camera: Camera, count: int, bounds: ArrayLike | None = None) -> list[View]:
    """Return views once around the target of a camera, at equal angles, starting at its own.

    Parameters
    ----------
    bounds : (6,) float64, optional
        A box around the target that is to stay within all the pictures.
    """
    start = Viewpoint.of(camera)
    around = [orbit(start, math.tau * number / count, 0.0) for number in range(count)]
    if bounds is not None:
        farthest = max(math.dist(fit(view, bounds).camera.eye, camera.target) for view in around)
        factor = farthest / math.dist(camera.eye, camera.target)
        around = [zoom(view, factor, camera.target) for view in around]
    return [view.camera.to_view() for view in around]


def numbered(out: Path, count: int) -> list[Path]:
    """OUT-0001.png, OUT-0002.png, ...: with as many digits as it takes, four at least."""
    digits = max(4, len(str(count)))
    return [out.with_name(f"{out.stem}-{number:0{digits}d}{out.suffix or '.png'}") for number in range(1, count + 1)]


async def draw_sequence(
    target: str,
    views_of: Callable[[Header], Sequence[View]],
    out: Path,
    options: StillOptions,
    *,
    fps: float,
    animation: str = "auto",
    cache: Cache | None = None,
    progress: Callable[[int], None] | None = None,
) -> SequenceReport:
    """Draw views of the model at a path or address to numbered files.

    Parameters
    ----------
    views_of : callable
        Gives the views of a model.
    out : Path
        OUT.png stands for OUT-0001.png, OUT-0002.png, ...
    fps : float
        Pictures a second of the animation.
    animation : {"auto", "none", "mp4", "webp", "apng", "gif"}
        Format of the animated file beside the pictures; "auto": the first of these that can be written here.
    progress : callable
        Told how many pictures were just done.

    Raises
    ------
    StoreError, FormatError
        If the model cannot be opened, a view is none, or a file cannot be written.
    Unavailable
        If no encoder of the asked format is installed.
    """
    encoder = find_encoder(animation)  # before any work
    store = open_store(target, clock=time.monotonic, cache=cache)
    layer = await AccessLayer.open(store, options=LayerOptions(capacity=CAPACITY), clock=time.monotonic)
    try:
        views = views_of(layer.header)
        files = numbered(out, len(views))
        backend = open_backend(options.backend, layer.header, threads=options.threads)
        most, drawing = 0, 0.0
        try:
            for view, file in zip(views, files, strict=True):
                one = replace(options, view=view)
                look = partial(cut_of, options=one)
                cut = await settle(layer, look, clock=time.monotonic, patience=options.patience)
                start = time.perf_counter()
                camera = camera_of(layer, one)
                frame = antialias.draw(backend, cut, layer.take, camera, options.style, finer=options.antialias)
                drawing += time.perf_counter() - start
                most = max(most, frame.splats)
                save_picture(frame.rgb, file)
                if progress is not None:
                    progress(1)
        finally:
            backend.close()
        animated = None
        fits = encoder == "mp4" or 3 * options.width * options.height * len(files) <= MOST_BYTES
        if encoder is not None and len(files) > 1 and (fits or animation != "auto"):
            animated = out.with_suffix(f".{encoder}")
            write_animation(files, animated, encoder, fps)
        return SequenceReport(
            backend=backend.name,
            pictures=len(files),
            first=files[0].name,
            last=files[-1].name,
            animation=None if animated is None else animated.name,
            splats=most,
            frame_ms=round(1e3 * drawing / len(files), 3),
            bytes_read=layer.stats.bytes_received,
        )
    finally:
        await layer.close()


def find_encoder(asked: str) -> str | None:
    """Return the format to animate in; None for no animation.

    Raises
    ------
    Unavailable
        If the asked format cannot be written here.
    """
    if asked == "none":
        return None
    can: dict[str, Callable[[], bool]] = {
        "mp4": _has_ffmpeg,
        "webp": partial(_pillow_writes, "webp"),
        "apng": lambda: True,
        "gif": lambda: True,
    }
    if asked == "auto":
        return next(name for name in ANIMATIONS if can[name]())
    if not can[asked]():
        needs = "imageio-ffmpeg (pip install 'pointstream[film]')" if asked == "mp4" else f"a Pillow with {asked}"
        raise Unavailable(f"{asked} needs {needs}, which is not installed here; use --animation gif")
    return asked


def write_animation(files: Sequence[Path], out: Path, encoder: str, fps: float) -> None:
    """Write pictures as one animated file.

    Raises
    ------
    StoreError
        If it cannot be written.
    """
    try:
        if encoder == "mp4":
            _write_mp4(files, out, fps)
        else:
            _write_pillow(files, out, encoder, fps)
    except OSError as error:
        raise StoreError(f"cannot write {out}: {error.strerror or error}") from error


def _write_pillow(files: Sequence[Path], out: Path, encoder: str, fps: float) -> None:
    first, *others = [_loaded(file) for file in files]
    formats: dict[str, dict[str, Any]] = {
        "webp": {"format": "WEBP", "quality": 85, "method": 4},
        "apng": {"format": "PNG"},
        "gif": {"format": "GIF"},
    }
    milliseconds = max(1, round(1e3 / fps))
    first.save(out, save_all=True, append_images=others, duration=milliseconds, loop=0, **formats[encoder])


def _write_mp4(files: Sequence[Path], out: Path, fps: float) -> None:
    import imageio_ffmpeg

    width, height = _loaded(files[0]).size
    odd = ((0, height % 2), (0, width % 2), (0, 0))  # H.264 halves the colours: an odd side gets its last line twice
    size = (width + odd[1][1], height + odd[0][1])
    options: dict[str, Any] = {"fps": fps, "quality": 7, "macro_block_size": 2, "ffmpeg_log_level": "quiet"}
    out.unlink(missing_ok=True)
    writer = imageio_ffmpeg.write_frames(str(out), size, **options)
    writer.send(None)
    try:
        for file in files:
            writer.send(np.pad(np.asarray(_loaded(file).convert("RGB")), odd, mode="edge"))
    except OSError as error:  # its text is a page of ffmpeg's
        raise StoreError(f"cannot write {out}: ffmpeg stopped; use --animation webp") from error
    finally:
        writer.close()
    if not out.exists() or not out.stat().st_size:  # ffmpeg may stop after it took the last picture
        raise StoreError(f"cannot write {out}: ffmpeg made no film of it; use --animation webp")


def _loaded(file: Path) -> Image.Image:
    from PIL import Image

    with Image.open(file) as picture:
        return picture.copy()


def _has_ffmpeg() -> bool:
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        return False
    return True


def _pillow_writes(name: str) -> bool:
    from PIL import features

    return bool(features.check(name))
