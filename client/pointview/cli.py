"""``pointstream render``: options in, one call, a line or an object out."""

from __future__ import annotations

import asyncio
import json
import math
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import click

from lpc.errors import FormatError
from pointstream.cli import CACHE, choose_cache

if TYPE_CHECKING:
    from .refine import Cut

LARGEST_SIDE = 16384
MOST_THREADS = 8


class SizeType(click.ParamType[tuple[int, int]]):
    """WIDTHxHEIGHT, pixels."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Return (width, height)."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", str(value).strip())
        if match is None:
            self.fail(f"{value!r} is no size; write for example 1024x768", param, ctx)
        width, height = int(match[1]), int(match[2])
        if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
            self.fail(f"{value!r}: sides are 1 to {LARGEST_SIDE} pixels", param, ctx)
        return width, height


class ViewType(click.ParamType[dict[str, Any]]):
    """A VIEW.json file."""

    name = "VIEW.json"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> dict[str, Any]:
        """Return the object; that it is a view is checked by `Camera.from_view`.

        Raises
        ------
        FormatError
            If the file holds no JSON object.
        """
        if isinstance(value, dict):
            return value
        try:
            view = json.loads(Path(value).read_text(encoding="utf-8"))
        except OSError as error:
            self.fail(f"cannot read {value}: {error.strerror}", param, ctx)
        except (ValueError, RecursionError) as error:
            raise FormatError(f"{value} is not JSON; a view is an object with eye, target, up and fov_y") from error
        if not isinstance(view, dict):
            raise FormatError(f"{value} is no view: an object with eye, target, up and fov_y")
        return view


def positive(_ctx: click.Context, _param: click.Parameter, value: float) -> float:
    """Refuse what click's ranges let pass: a NaN is neither below nor above anything."""
    if not 0 < value < math.inf:
        raise click.BadParameter(f"{value} is not above 0")
    return value


@click.command()
@click.argument("model")
@click.argument("out", metavar="OUT.png", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--size", type=SizeType(), default="1024x768", show_default=True, help="Picture size in pixels.")
@click.option("--view", type=ViewType(), help="Where to look from; without it the whole model is framed.")
@click.option(
    "--tolerance",
    type=float,
    callback=positive,
    default=1.0,
    show_default=True,
    help="Spacing of samples on the screen that is fine enough, pixels.",
)
@click.option("--budget", type=click.IntRange(min=1), help="Most splats; coarser where the tolerance needs more.")
@click.option("--backend", type=click.Choice(["auto", "gl", "cpu"]), default="auto", show_default=True)
@click.option("--two-sided", is_flag=True, help="Show surfaces from behind too: for normals that may point inward.")
@CACHE
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def render(
    model: str,
    out: Path,
    size: tuple[int, int],
    view: dict[str, Any] | None,
    tolerance: float,
    budget: int | None,
    backend: Any,
    two_sided: bool,
    cache: str | None,
    as_json: bool,
) -> None:
    """Draw MODEL, a path or address of a .lpc file, into OUT.png."""
    from .render.backend import Style
    from .render.picture import save_png
    from .still import StillOptions, draw_still

    width, height = size
    options = StillOptions(
        width=width,
        height=height,
        view=view,
        tolerance=tolerance,
        budget=budget,
        backend=backend,
        threads=min(os.cpu_count() or 1, MOST_THREADS),
        style=Style(two_sided=two_sided),
    )
    with Waiting() as waiting:
        still = asyncio.run(draw_still(model, options, cache=choose_cache(cache, model), progress=waiting.show))
    save_png(still.frame.rgb, out)
    for problem in still.problems:
        click.echo(f"pointstream: {problem}", err=True)
    if as_json:
        click.echo(json.dumps(still.report))
    else:
        figures = still.report
        starved = f", {figures['starved_clouds']} of them starved" if figures["starved_clouds"] else ""
        click.echo(
            f"{out}: {figures['splats']:,} splats of {figures['clouds']:,} clouds{starved},"
            f" {figures['frame_ms']:.1f} ms on {figures['backend']}, {figures['bytes_read']:,} bytes read"
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
            self._status.update(f"{cut.splats:,} samples here, {len(cut.wants):,} clouds wanted")
