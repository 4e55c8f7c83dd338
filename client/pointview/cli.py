"""``pointstream render``: options in, one call, a line or an object out."""

from __future__ import annotations

import asyncio
import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import click

from lpc.info import counted
from pointstream.arguments import COUNT, Number
from pointstream.cli import CACHE, choose_cache

from .arguments import LARGEST_SIDE, TOLERANCE, PathType, SizeType, ViewType

if TYPE_CHECKING:
    from lpc.header import Header
    from pointstream.cache import Cache

    from .refine import Cut
    from .still import StillOptions
    from .stream.path import ViewPath

MOST_THREADS = 8
MOST_PICTURES = 100_000
MOST_ANTIALIAS = 8


@click.command()
@click.argument("model")
@click.argument("out", metavar="OUT.png", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--size", type=SizeType(), default="1024x768", show_default=True, help="Picture size in pixels.")
@click.option("--view", type=ViewType(), help="Where to look from; without it the whole model is framed.")
@TOLERANCE
@click.option("--budget", type=COUNT, help="Most splats; coarser where the tolerance needs more.")
@click.option("--backend", type=click.Choice(["auto", "gl", "cpu"]), default="auto", show_default=True)
@click.option(
    "--splat",
    type=click.Choice(["square", "round", "disc", "blended"]),
    default="blended",
    show_default=True,
    help="What samples look like; blended: a pixel shows the mean of its samples.",
)
@click.option(
    "--antialias",
    type=click.IntRange(min=1, max=MOST_ANTIALIAS),
    default=1,
    show_default=True,
    help="Draw so many times wider and higher, and show the mean.",
)
@click.option("--two-sided", is_flag=True, help="Show surfaces from behind too: for normals that may point inward.")
@click.option("--path", type=PathType(), help="PATH.json: a picture at each time.")
@click.option("--turntable", type=click.IntRange(min=2, max=MOST_PICTURES), help="So many pictures around the model.")
@click.option(
    "--fps",
    type=Number(min=0.1, max=120),
    default=12.0,
    show_default=True,
    help="Pictures a second, of a path or turntable.",
)
@click.option(
    "--animation",
    type=click.Choice(["auto", "none", "mp4", "webp", "apng", "gif"]),
    default="auto",
    show_default=True,
    help="Format of the animated file beside the numbered pictures.",
)
@CACHE
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
@click.pass_context
def render(
    context: click.Context,
    /,
    model: str,
    out: Path,
    size: tuple[int, int],
    view: dict[str, Any] | None,
    tolerance: float,
    budget: int | None,
    backend: Any,
    splat: Any,
    antialias: int,
    two_sided: bool,
    path: ViewPath | None,
    turntable: int | None,
    fps: float,
    animation: str,
    cache: str | None,
    as_json: bool,
) -> None:
    """Draw MODEL, a path or address of a .lpc file, into OUT.{png,jpg,webp,tif,bmp,ppm}.

    With --path or --turntable, into OUT-0001.png, OUT-0002.png, ... and an animated file.
    """
    from .render.backend import Style
    from .render.picture import FORMATS, save_picture
    from .still import StillOptions, draw_still

    many = path is not None or turntable is not None
    if out.suffix.lower() not in FORMATS and (out.suffix or not many):
        raise click.UsageError(f"{out}: the suffix says the format; use one of {', '.join(FORMATS)}")
    for name in () if many else ("fps", "animation"):
        if context.get_parameter_source(name) != click.core.ParameterSource.DEFAULT:
            raise click.UsageError(f"--{name} is of many pictures: give --path or --turntable too")
    width, height = size
    if max(size) * antialias > LARGEST_SIDE:
        raise click.UsageError(f"{width}x{height} with --antialias {antialias} is above {LARGEST_SIDE} pixels a side")
    options = StillOptions(
        width=width,
        height=height,
        view=view,
        tolerance=tolerance,
        budget=budget,
        backend=backend,
        threads=min(os.cpu_count() or 1, MOST_THREADS),
        style=Style(two_sided=two_sided, splat=splat),
        antialias=antialias,
    )
    if many:
        if path is not None and (view is not None or turntable is not None):
            raise click.UsageError("--path excludes --view and --turntable")
        _sequence(model, out, options, path, turntable, fps, animation, choose_cache(cache, model), as_json)
        return
    with Waiting() as waiting:
        still = asyncio.run(draw_still(model, options, cache=choose_cache(cache, model), progress=waiting.show))
    save_picture(still.frame.rgb, out)
    for problem in still.problems:
        click.echo(f"pointstream: {problem}", err=True)
    if as_json:
        click.echo(json.dumps(still.report))
    else:
        figures = still.report
        starved = f", {figures['starved_clouds']} of them starved" if figures["starved_clouds"] else ""
        click.echo(
            f"{out}: {counted(figures['splats'], 'splat')} of {counted(figures['clouds'], 'cloud')}{starved},"
            f" {figures['frame_ms']:.1f} ms on {figures['backend']}, {figures['bytes_read']:,} bytes read"
        )


def _sequence(
    model: str,
    out: Path,
    options: StillOptions,
    path: ViewPath | None,
    turntable: int | None,
    fps: float,
    animation: str,
    cache: Cache | None,
    as_json: bool,
) -> None:
    """Draw the pictures of a path or turntable."""
    from pointstream.progress import progress

    from .camera import Camera
    from .sequence import draw_sequence, path_views, turntable_views

    along = None if path is None else path_views(path, fps)
    if along is not None and len(along) > MOST_PICTURES:
        raise click.UsageError(f"{len(along):,} pictures are more than {MOST_PICTURES:,}: lower --fps")

    def views_of(header: Header) -> list[dict[str, Any]]:
        if along is not None:
            return along
        width, height = options.width, options.height
        if options.view is not None:
            return turntable_views(Camera.from_view(options.view, width=width, height=height), turntable or 1)
        camera = Camera.frame_model(header, width=width, height=height)
        return turntable_views(camera, turntable or 1, header.bounds)

    with progress("drawing", turntable or len(along or ())) as step:
        report = asyncio.run(
            draw_sequence(
                model,
                views_of,
                out,
                options,
                fps=fps,
                animation=animation,
                cache=cache,
                progress=step,
            )
        )
    if as_json:
        click.echo(json.dumps(asdict(report)))
        return
    beside = f" and {report.animation}" if report.animation else ""
    click.echo(
        f"{report.first} to {report.last}{beside}: {report.pictures} pictures of up to {report.splats:,} splats,"
        f" {report.frame_ms:.1f} ms on {report.backend}, {report.bytes_read:,} bytes read"
    )


class Waiting:
    """A line on the terminal that says how far fetching is; nothing elsewhere."""

    def __init__(self) -> None:
        from rich.console import Console

        self._status = Console(stderr=True).status("Opening ...")
        self._shown = self._status.console.is_terminal

    def __enter__(self) -> Self:
        if self._shown:
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            self._status.stop()

    def show(self, cut: Cut) -> None:
        """Tell one cut on the way."""
        if self._shown:
            self._status.update(f"{counted(cut.splats, 'sample')} here, {counted(len(cut.wants), 'cloud')} wanted")
