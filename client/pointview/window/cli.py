"""``pointstream view``: options in, a window, and what it took."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from lpc.errors import NotFound
from pointstream.arguments import COUNT, POSITIVE, Number
from pointstream.cli import CACHE, choose_cache
from pointview.arguments import TOLERANCE, SizeType, ViewType, read_link
from pointview.cli import MOST_THREADS


@click.command()
@click.argument("model", required=False)
@click.option("--size", type=SizeType(), default="1280x800", show_default=True, help="Size of the window.")
@click.option("--view", type=ViewType(), help="Where to look from first; without it the whole model is framed.")
@TOLERANCE
@click.option("--budget", type=COUNT, help="Most splats.")
@click.option(
    "--frame-time",
    type=Number(min=0),
    metavar="SECONDS",
    help="Draw coarser where a frame takes longer; 0: however long it takes.",
)
@click.option("--backend", type=click.Choice(["auto", "gl", "cpu"]), default="auto", show_default=True)
@click.option("--link", metavar="none|adsl|lan|RATE[,RTT]", help="See the model as over this line.")
@click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    default=Path(),
    help="Where pictures and recorded paths go; the current directory if not given.",
)
@click.option("--seconds", type=POSITIVE, help="Close by itself.")
@CACHE
@click.option("--json", "as_json", is_flag=True, help="Print the figures of the session as one JSON object.")
def view(
    model: str | None,
    size: tuple[int, int],
    view: dict[str, Any] | None,
    tolerance: float,
    budget: int | None,
    frame_time: float | None,
    backend: Any,
    link: str | None,
    folder: Path,
    seconds: float | None,
    cache: str | None,
    as_json: bool,
) -> None:
    """Open a window on MODEL, a path or address of a .lpc file; F1 shows the controls."""
    from .feed import Feed
    from .loop import run_loop
    from .screen import Screen
    from .settings import Settings
    from .viewer import Viewer, ViewerOptions

    profile = None if link is None else read_link(link)
    settings = Settings(tolerance=tolerance, help=model is None)
    if budget is not None:
        settings.budget, settings.limited = budget, True
    if frame_time is not None:
        settings.steady = frame_time > 0
        settings.frame_seconds = frame_time or settings.frame_seconds
    options = ViewerOptions(backend=backend, threads=min(os.cpu_count() or 1, MOST_THREADS), folder=folder, view=view)

    def open_feed(target: str) -> Feed:
        return Feed(target, cache=choose_cache(cache, target), link=profile, wake=Screen.wake)

    if model is not None and "://" not in model and not Path(model).exists():
        raise NotFound(f"{model}: there is no such file")  # before a window is opened for it
    title = "pointstream" if model is None else f"{model} - pointstream"
    with Screen(title, size) as screen:
        viewer = Viewer(open_feed, options, settings, wake=Screen.wake)
        try:
            if model is not None:
                viewer.open(model)
            report = run_loop(screen, viewer, seconds=seconds)
        finally:
            viewer.close()
    if as_json:
        click.echo(json.dumps(asdict(report)))
    elif viewer.mirror.index is None and viewer.message:
        raise click.ClickException(viewer.message)
