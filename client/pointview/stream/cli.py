"""``pointstream stream`` and ``pointstream demo``."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lpc.info import counted
from pointstream.arguments import Number
from pointview.arguments import TOLERANCE, PathType, SizeType, ViewType, read_link

if TYPE_CHECKING:
    from .path import ViewPath

LONGEST = 3600.0
"""Seconds: a run keeps two pictures a second in memory."""


@click.command()
@click.argument("model")
@click.option("--link", required=True, metavar="none|adsl|lan|RATE[,RTT]", help="The line to stream over.")
@click.option(
    "--seconds",
    default=30.0,
    show_default=True,
    type=Number(min=0.1, max=LONGEST),
    help="Length of the run.",
)
@click.option("--report", required=True, type=click.Path(path_type=Path, file_okay=False), help="Folder to write to.")
@click.option("--view", type=ViewType(), help="Where to look from; without it the whole model is framed.")
@click.option("--path", type=PathType(), help="PATH.json: views at times.")
@click.option("--clock", default="real", show_default=True, type=click.Choice(["real", "virtual"]))
@click.option("--size", type=SizeType(), default="1024x768", show_default=True, help="Picture size in pixels.")
@TOLERANCE
@click.option(
    "--priority",
    default="error",
    show_default=True,
    type=click.Choice(["index", "error"]),
    help="Fetch by the screen error that a byte removes, or in the order of the file.",
)
@click.option(
    "--splat-rule",
    default="place",
    show_default=True,
    type=click.Choice(["place", "paper"]),
    help="A splat's size follows the data at its place, or, as in the paper, its cloud.",
)
@click.option(
    "--occlusion",
    default="off",
    show_default=True,
    type=click.Choice(["auto", "off"]),
    help="auto leaves out what is hidden, where that pays, at the price of a few pixels.",
)
@click.option(
    "--prefetch",
    default="auto",
    show_default=True,
    type=click.Choice(["auto", "off"]),
    help="auto fetches what a moving camera will see next where the link would be idle.",
)
@click.option("--json", "as_json", is_flag=True, help="Print report.json on stdout.")
def stream(
    model: str,
    link: str,
    seconds: float,
    report: Path,
    view: dict[str, Any] | None,
    path: ViewPath | None,
    clock: str,
    size: tuple[int, int],
    tolerance: float,
    priority: str,
    splat_rule: str,
    occlusion: str,
    prefetch: str,
    as_json: bool,
) -> None:
    """Stream MODEL over a link and report its error against run time."""
    from pointstream.progress import progress

    from .experiment import Experiment, run_experiment
    from .path import ViewPath
    from .report import prepare_folder, write_report

    if view is not None and path is not None:
        raise click.UsageError("--view and --path exclude each other")
    profile = read_link(link)
    views = path if view is None else ViewPath.still(view)
    experiment = Experiment(
        model=model,
        link=link,
        profile=profile,
        clock="virtual" if clock == "virtual" else "real",
        seconds=seconds,
        size=size,
        tolerance=tolerance,
        priority="index" if priority == "index" else "error",
        splat_rule="paper" if splat_rule == "paper" else "place",
        occlusion="off" if occlusion == "off" else "auto",
        prefetch="off" if prefetch == "off" else "auto",
        views=views,
    )
    prepare_folder(report)
    result, moments = run_experiment(experiment, say=lambda line: click.echo(line, err=True), progress=progress)
    written = write_report(report, result, moments)
    for text in result.errors:
        click.echo(f"pointstream: {text}", err=True)
    if as_json:
        click.echo(json.dumps(asdict(result), allow_nan=False))
        return
    first = "never" if result.first_picture_s is None else f"{result.first_picture_s:.2f} s"
    settled = "not within the run" if result.settled_s is None else f"{result.settled_s:.2f} s"
    use = "no limit" if result.link_utilisation is None else f"{100 * result.link_utilisation:.1f} %"
    click.echo(f"first picture   {first}")
    click.echo(f"settled         {settled}")
    click.echo(f"received        {result.bytes:,} bytes in {counted(result.requests, 'request')}")
    click.echo(f"link used       {use}")
    if result.speculative_bytes:
        click.echo(f"fetched ahead   {result.speculative_bytes:,} bytes, {result.wasted_bytes:,} of them never drawn")
    if result.occlusion == "auto":
        click.echo(f"hidden          {result.left_out.get('occlusion') or f'{result.occluded:,} branches left out'}")
    click.echo(f"report          {written[0]}")


@click.command()
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("out/demo"),
    show_default=True,
    help="Folder for the model, the pictures and the report.",
)
@click.option("--scan", type=click.Path(path_type=Path, exists=True, dir_okay=False), help="A scan of your own.")
@click.option(
    "--seconds",
    default=30.0,
    show_default=True,
    type=Number(min=1.0, max=LONGEST),
    help="Length of the run.",
)
@click.option("--link", default="adsl", show_default=True, metavar="none|adsl|lan|RATE[,RTT]")
def demo(out: Path, scan: Path | None, seconds: float, link: str) -> None:
    """Build a model, serve it, stream it over 1.25 Mbit/s: the whole tour."""
    from .demo import tour

    read_link(link)  # a wrong one costs no build
    for line in tour(out, scan=scan, seconds=seconds, link=link):
        click.echo(line)
