"""``pointstream info``, ``verify`` and ``export``."""

from __future__ import annotations

import asyncio
import json
import re
import time
from contextlib import ExitStack
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lpc.errors import LpcError, ScanError
from lpc.info import counted

from .arguments import BOUNDS, COUNT, DEEPEST, POSITIVE
from .cache import Cache
from .model import open_model
from .progress import progress
from .reading import Reader, Region
from .stores import is_address, open_store
from .verify import Scan, VerifyReport
from .verify import verify as verify_reader

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from lpc.points import PointBatch

    from .arguments import Bounds
    from .model import Model

JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
CACHE = click.option(
    "--cache",
    metavar="DIR|none",
    help="Where to keep what comes from an address, so that it is not fetched again; the user's cache if not given.",
)


def choose_cache(choice: str | None, target: str) -> Cache | None:
    """Return the cache that ``--cache`` means for a target; files need none."""
    if choice == "none" or not is_address(target):
        return None
    if choice is not None:
        return Cache(Path(choice))
    from platformdirs import user_cache_path

    return Cache(user_cache_path("pointstream", appauthor=False))


@click.command()
@click.argument("model")
@JSON
def info(model: str, as_json: bool) -> None:
    """Say what MODEL, a path or an http(s) address, holds; reads 64 KiB of it."""
    with open_model(model) as opened:
        facts = opened.info
    if as_json:
        click.echo(json.dumps(facts))
    else:
        _print_info(facts)


@click.command()
@click.argument("model")
@click.option("--against", "scans", multiple=True, type=click.Path(), help="A scan it was built from; more may follow.")
@click.argument("more", nargs=-1, type=click.Path())
@JSON
def verify(model: str, scans: tuple[str, ...], more: tuple[str, ...], as_json: bool) -> None:
    """Check every page and cloud of MODEL; with --against SCAN..., that it holds exactly the samples of these scans."""
    if more and not scans:
        raise click.UsageError(f"{more[0]}: scans to compare with stand after --against")
    open_scan = _scan_reader() if scans else None
    opened = [open_scan(path, attributes="all") for path in (*scans, *more)] if open_scan is not None else []
    report = asyncio.run(_verify(model, opened))
    if as_json:
        click.echo(json.dumps(report.to_json()))
    else:
        _print_report(report)
    if not report.ok:
        others = f" (and {len(report.problems) - 1} more)" if len(report.problems) > 1 else ""
        click.echo(f"pointstream: {model}: {report.problems[0]}{others}", err=True)
        click.get_current_context().exit(1)


@click.command()
@click.argument("model")
@click.argument("out", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--level", type=click.IntRange(0, DEEPEST), help="Deepest level of the tree, 0 for the root alone.")
@click.option("--spacing", type=POSITIVE, help="Detail that is enough, model units.")
@click.option("--bounds", type=BOUNDS, help="X0,Y0,Z0,X1,Y1,Z1 in model units: only samples inside.")
@CACHE
def export(
    model: str,
    out: Path,
    level: int | None,
    spacing: float | None,
    bounds: Bounds | None,
    cache: str | None,
) -> None:
    """Write the samples of MODEL to OUT.{ply,las,laz,xyz,npz}, every one once."""
    if level is not None and spacing is not None:
        raise click.UsageError("give --level or --spacing, not both")
    from .writers import SUFFIXES, Target, write_points

    if out.suffix.lower() not in SUFFIXES:
        raise click.UsageError(f"{out}: the suffix says the format; use one of {', '.join(SUFFIXES)}")
    with open_model(model, cache=choose_cache(cache, model)) as opened:
        header = opened.header
        choice = {"level": level, "spacing": spacing, "bounds": bounds}
        total = opened.count(**choice)  # type: ignore[arg-type]
        # Counts stand at the head of most formats, so what the bounds cut is counted first.
        count = total if bounds is None else sum(map(len, _batches(opened, "counting", total, choice)))
        if bounds is not None and not count:
            spans = ",".join(f"{value:.9g}" for value in header.bounds)
            raise LpcError(f"{model}: no sample that is here is inside the bounds; the whole model spans {spans}")
        target = Target(
            count=count,
            attributes=opened.attributes,
            bounds=opened.reach,
            position_error=header.position_error,
            origin=header.origin,
            step=header.step,
            crs=header.crs,
        )
        dropped = write_points(out, _batches(opened, "exporting", count, choice), target)
        complete = opened.complete
    click.echo(f"{out}: {counted(count, 'sample')}" + ("" if complete else " of a file that is cut short"), err=True)
    for name in dropped:
        click.echo(f"{out}: left out {name}, the format has no room for it", err=True)


@click.command()
@click.argument("model")
@click.argument("folder", metavar="DIR", type=click.Path(file_okay=False, path_type=Path))
@click.option("--bounds", type=BOUNDS, help="X0,Y0,Z0,X1,Y1,Z1 in model units: only clouds that touch it.")
@click.option("--spacing", type=POSITIVE, help="Detail that is enough, model units.")
@click.option("--bytes", "most_bytes", type=COUNT, help="Bytes of it to have at most; coarse comes first.")
@JSON
def fetch(
    model: str,
    folder: Path,
    bounds: Bounds | None,
    spacing: float | None,
    most_bytes: int | None,
    as_json: bool,
) -> None:
    """Copy MODEL into DIR for use without a network; interrupted, the same command goes on where it was.

    The copy of a part is a MODEL too: a coarser one outside the part.
    """
    from .fetch import FetchOptions, copy_name
    from .fetch import fetch as fetch_model

    out = folder / copy_name(model)
    options = FetchOptions(region=Region(bounds=bounds, spacing=spacing), most_bytes=most_bytes)
    with ExitStack() as stack:
        try:
            report = asyncio.run(
                fetch_model(
                    open_store(model, clock=time.monotonic),
                    out,
                    options,
                    begin=lambda total: stack.enter_context(progress("fetching bytes", total)),
                )
            )
        except KeyboardInterrupt:
            click.echo(f"{out}: paused; the same command goes on", err=True)
            raise
    if as_json:
        click.echo(json.dumps(report.to_json()))
    else:
        part = "the whole model" if report.complete else f"{report.clouds:,} of {counted(report.clouds_total, 'cloud')}"
        if report.cut_short:
            part += " of a file that is cut short"
        click.echo(
            f"{out}: {part}, {report.bytes:,} of {report.bytes_total:,} bytes, {report.bytes_fetched:,} of them new"
        )
    for problem in report.problems:
        click.echo(f"pointstream: {out}: {problem}", err=True)
    if report.problems:
        click.get_current_context().exit(1)


def _batches(model: Model, label: str, total: int, choice: dict[str, Any]) -> Iterator[PointBatch]:
    with progress(label, total) as advance:
        for batch in model.batches(**choice):
            yield batch
            advance(len(batch))


async def _verify(target: str, scans: list[Scan]) -> VerifyReport:
    store = open_store(target, clock=time.monotonic)
    try:
        reader = await Reader.open(store)
        with progress("checking clouds", reader.index.header.nodes) as advance:
            return await verify_reader(reader, scans, advance=advance)
    finally:
        await store.close()


def _scan_reader() -> Callable[..., Scan]:
    """Find what reads scans: another package's trade, met by the name of an entry point."""
    for point in entry_points(group="pointstream.readers", name="scan"):
        return point.load()
    raise ScanError("no reader of scans is installed: pip install 'pointstream[server]'")


def _print_info(facts: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, text in _rows(facts):
        table.add_row(name, text)
    Console(highlight=False).print(table)


def _rows(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    low, high = facts["bounds"]
    bits = facts["bits_per_sample"]
    yield "format", facts["format"]
    yield "samples", f"{facts['samples']:,} in {counted(facts['clouds'], 'cloud')} of at most {facts['cloud_size']:,}"
    yield "levels", str(facts["levels"])
    yield "bytes", f"{facts['bytes']:,}"
    if not facts["complete"]:
        here = facts["here"]
        yield (
            "incomplete",
            f"here is a coarser model: {here['samples']:,} of the samples in {counted(here['clouds'], 'cloud')}",
        )
    yield "bits per sample", ", ".join(f"{name} {value:.2f}" for name, value in bits.items() if value)
    yield "spacing", f"{facts['spacing']:.6g}"
    yield "spacing, stored / LPC", " ".join(f"{ratio:.3f}" for ratio in facts["spacing_ratio"]) + "  (5%, 50%, 95%)"
    yield "position error", f"at most {facts['position_error']:.6g}"
    yield "from", " ".join(f"{value:.10g}" for value in low)
    yield "to", " ".join(f"{value:.10g}" for value in high)
    yield "attributes", ", ".join(facts["attributes"]) or "none"
    for name, error in facts["attribute_errors"].items():
        cost = f"{facts['attribute_bits'][name]:.2f} bits, " if name in facts["attribute_bits"] else ""
        unit = " degrees" if name == "normal" else ""
        yield name, cost + (f"within {error:.3g}{unit}" if error else "as it came")
    for name, value in facts["constants"].items():
        yield f"{name} everywhere", str(value)
    yield "crs", crs_name(facts["crs"]) if facts["crs"] else "none"
    reasons: dict[str, list[str]] = {}
    for name, why in facts["left_out"].items():
        reasons.setdefault(why, []).append(name)
    for why, names in reasons.items():
        yield "left out", f"{', '.join(names)}: {why}"
    for why, count in facts["rejected"].items():
        if count:
            yield f"rejected: {why}", counted(count, "record")
    yield "build", facts["digest"]


_WKT = re.compile(
    r""""(?:[^"]|"")*"|(?:ID|AUTHORITY)\s*[\[(]\s*"EPSG"\s*,\s*"?(?P<code>\d+)"?[^\])]*[\])]|(?P<open>[\[(])|(?P<close>[\])])"""
)
"""What matters of a WKT: quoted texts, EPSG codes, brackets."""


def crs_name(wkt: str) -> str:
    """Give the name of a coordinate system and its EPSG code, or those of its parts; WKT 1 and 2, without a library."""
    name, codes, depth = "", dict[int, list[str]](), 0
    for token in _WKT.finditer(wkt):
        if token["code"]:
            codes.setdefault(depth, []).append(token["code"])
        elif token["open"] or token["close"]:
            depth += 1 if token["open"] else -1
        elif not name:
            name = token[0][1:-1].replace('""', '"')
    compound = wkt.lstrip().upper().startswith(("COMPD_CS", "COMPOUNDCRS"))
    found = codes.get(1, []) or (codes.get(2, []) if compound else [])
    return (name or wkt[:80]) + (f" (EPSG:{'+'.join(found)})" if found else "")


def _print_report(report: VerifyReport) -> None:
    click.echo(f"{report.clouds_checked:,} of {counted(report.clouds, 'cloud')} checked")
    if (match := report.match) is not None:
        click.echo(
            f"samples of the scans {match.samples_in}, of the model {match.samples_out}, missing {match.missing}"
        )
        click.echo(f"largest position error {match.max_position_error:.6g}")
        if match.max_normal_error_degrees is not None:
            click.echo(f"largest normal error {match.max_normal_error_degrees:.4f} degrees")
        if match.max_color_error is not None:
            click.echo(f"largest colour error {match.max_color_error}")
        click.echo(f"compared: {', '.join(['position', *match.differing])}")
        for name, why in match.not_compared.items():
            click.echo(f"not compared: {name}, {why}")
    for problem in report.problems:
        click.echo(f"problem: {problem}")
    click.echo("ok" if report.ok else "not ok")
