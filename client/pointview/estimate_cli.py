"""``pointstream estimate``: what a view will cost, before anything of it is fetched."""

from __future__ import annotations

import asyncio
import json
from dataclasses import asdict
from typing import Any

import click

from lpc.info import counted
from pointstream.cli import CACHE, choose_cache

from .arguments import TOLERANCE, SizeType, ViewType, read_link
from .cli import Waiting


@click.command()
@click.argument("model")
@click.option("--size", type=SizeType(), default="1024x768", show_default=True, help="Picture size in pixels.")
@click.option("--view", type=ViewType(), help="Where to look from; without it the whole model is framed.")
@TOLERANCE
@click.option(
    "--link", metavar="none|adsl|lan|RATE[,RTT]", help="The line to reckon with; what is measured if not given."
)
@click.option("--two-sided", is_flag=True, help="Count what faces away too.")
@CACHE
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def estimate(
    model: str,
    size: tuple[int, int],
    view: dict[str, Any] | None,
    tolerance: float,
    link: str | None,
    two_sided: bool,
    cache: str | None,
    as_json: bool,
) -> None:
    """Say how many bytes and seconds a view of MODEL takes to reach a tolerance; reads its index, and no clouds."""
    from .estimate import EstimateOptions
    from .estimate import estimate as reckon

    profile = None if link is None else read_link(link)
    options = EstimateOptions(
        width=size[0], height=size[1], view=view, tolerance=tolerance, two_sided=two_sided, profile=profile
    )
    with Waiting() as waiting:
        found = asyncio.run(reckon(model, options, cache=choose_cache(cache, model), progress=waiting.show))
    if as_json:
        click.echo(json.dumps(asdict(found), allow_nan=False))
        return
    clouds = counted(found.clouds, "cloud")
    click.echo(f"bytes           {found.bytes:,}, of which {found.cloud_bytes:,} in {clouds} of the view")
    click.echo(f"splats          {found.splats:,} at a tolerance of {found.tolerance:g} px")
    time = "unknown: give --link" if found.seconds is None else f"{found.seconds:.1f} s"
    if found.rate is not None:
        time += f" at {found.rate / 1e3:,.1f} kB/s"
    click.echo(f"time            {time}")
    click.echo(f"read for this   {found.bytes_read:,} bytes")
    for name, why in found.left_out.items():
        click.echo(f"{name:<15} {why}")
