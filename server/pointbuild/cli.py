"""``pointstream build``."""

from __future__ import annotations

import json
import math
import signal
import sys
import time
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console

from lpc.errors import LpcError
from lpc.info import counted, info_dict

from .build import BuildReport, build_model
from .extend import read_header
from .options import BuildOptions
from .progress import Bar, Lines, Silent
from .readers.detect import SUFFIXES
from .sizes import parse_size

if TYPE_CHECKING:
    from collections.abc import Iterator
    from contextlib import AbstractContextManager
    from types import FrameType

    from .cluster import Cluster


MODELS_OWN = ("cloud_size", "position_error", "seed", "normal_bits", "color_bits", "attributes", "effort")
"""Options that a model has settled for all scans that are added to it."""


@click.command()
@click.argument("scans", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="SCAN...")
@click.option("-o", "--output", "out", type=click.Path(path_type=Path), metavar="MODEL.lpc",
              help="Needed unless scans are added to a model.")  # fmt: skip
@click.option("--append", default=None, type=click.Path(path_type=Path), metavar="MODEL.lpc",
              help="Add the scans to this model.")  # fmt: skip
@click.option("--cloud-size", default=2048, show_default=True, type=click.IntRange(1, 65535), help="Samples a cloud.")
@click.option("--memory", default="2G", show_default=True, help="Ceiling on resident memory.")
@click.option(
    "--threads", default=0, type=click.IntRange(0, 1024), help="Worker threads; default: as many as there are cores."
)
@click.option("--position-error", default="auto", show_default=True, metavar="auto|LENGTH|MODEL.lpc",
              help="How far a sample may move; auto: half the spacing; a model: on its lattice.")  # fmt: skip
@click.option("--seed", default=0, show_default=True, type=click.IntRange(-(2**63), 2**64 - 1),
              help="Of the hash that picks each cloud's samples.")  # fmt: skip
@click.option("--normals", default="auto", show_default=True, type=click.Choice(["auto", "keep", "estimate", "drop"]),
              help="auto: those of the scan, or of a mesh's faces.")  # fmt: skip
@click.option("--normal-bits", default=8, show_default=True, type=click.IntRange(2, 16),
              help="Of each of a normal's two numbers.")  # fmt: skip
@click.option("--colour-bits", "--color-bits", "color_bits", default=None, type=click.IntRange(1, 16),
              help="Of each of a colour's three; default: all that it has.")  # fmt: skip
@click.option("--attributes", default=None, metavar="LIST|all",
              help="Names with commas between; default: normal,color,intensity,classification.")  # fmt: skip
@click.option("--effort", default="default", show_default=True, type=click.Choice(["fast", "default", "best"]),
              help="What packing may cost.")  # fmt: skip
@click.option("--scratch", default=None, type=click.Path(path_type=Path), help="Directory for temporary files.")
@click.option("--dask", default=None, metavar="ADDRESS", help="Scheduler whose workers sort and encode.")
@click.option("--share", default=None, metavar="URL",
              help="What all workers reach, a folder or s3://...; default: that of --scratch.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")
@click.pass_context
def build(
    context: click.Context,
    /,
    scans: tuple[Path, ...],
    out: Path | None,
    append: Path | None,
    memory: str,
    position_error: str,
    attributes: str | None,
    as_json: bool,
    dask: str | None,
    share: str | None,
    **options: Any,
) -> None:
    """Turn scans (PLY, LAS, LAZ, E57, PCD, OBJ, NPZ, text), or directories of them, into one model."""
    out = _target(context, out, append)
    error, step = _lattice(position_error)
    chosen = BuildOptions(
        memory_bytes=_size(memory),
        position_error=error,
        step=step,
        attributes=None
        if attributes is None
        else tuple(name.strip() for name in attributes.split(",") if name.strip()),
        **options,
    )
    if out.suffix.lower() in SUFFIXES:
        raise click.UsageError(f"{out} is the name of a scan, and a model is none; give it the suffix .lpc")
    if share is not None and dask is None:
        raise click.BadParameter("only a build on a cluster (--dask) shares files", param_hint="--share")
    with _stopped_by_signals(), _progress(as_json) as progress, _cluster(dask, share) as cluster:
        report = build_model(
            scans, out, chosen, progress, clock=time.monotonic, tell=_tell, cluster=cluster, append=append
        )
    if as_json:
        kept = report.clouds_kept
        added = {} if append is None else {"clouds_kept": kept, "clouds_written": report.header.nodes - kept}
        click.echo(json.dumps(report_dict(report) | added))
    else:
        click.echo(_sentence(report, out) + (f"; {counted(report.clouds_kept, 'cloud')} kept" if append else ""))


def _tell(text: str) -> None:
    click.echo(text, err=True)


def report_dict(report: BuildReport) -> dict[str, Any]:
    """Describe a build by the contract's keys."""
    return {
        **info_dict(report.header),
        "seconds": round(report.seconds, 3),
        "samples_per_second": round(report.samples_per_second),
        "peak_rss_bytes": report.peak_rss_bytes,
    }


def _sentence(report: BuildReport, out: Path) -> str:
    header = report.header
    dropped = sum(header.rejected.values())
    size = f"{counted(header.samples, 'sample')} in {counted(header.nodes, 'cloud')}, {counted(header.levels, 'level')}"
    return (
        f"{out}: {size}, {header.bytes:,} bytes "
        f"({header.bits_per_sample['total']:.1f} bits a sample), {report.seconds:.1f} s"
        + (f"; {counted(dropped, 'record')} without a position dropped" if dropped else "")
    )


def _size(text: str) -> int:
    try:
        return parse_size(text)
    except LpcError as error:
        raise click.BadParameter(str(error), param_hint="--memory") from error


def _target(context: click.Context, out: Path | None, append: Path | None) -> Path:
    """Where the model goes: over the one that is added to, if nothing else is said."""
    if append is None:
        if out is None:
            raise click.UsageError("say where the model goes: -o MODEL.lpc")
        return out
    for name in MODELS_OWN:
        if context.get_parameter_source(name) != click.core.ParameterSource.DEFAULT:
            option = name.replace("_", "-").replace("color", "colour")
            raise click.UsageError(f"--{option} is settled by the model that --append names: leave it out")
    return append if out is None else out


def _lattice(text: str) -> tuple[float | None, float | None]:
    """Position error, or step of the lattice of a model."""
    if text == "auto":
        return None, None
    if text.endswith(".lpc"):
        return None, read_header(Path(text)).step
    try:
        length = float(text)
    except ValueError:
        length = math.nan
    if not (math.isfinite(length) and length > 0):
        raise click.BadParameter(
            f"{text!r} is neither auto, a length above 0 nor a model (.lpc)", param_hint="--position-error"
        )
    return length, None


def _cluster(address: str | None, url: str | None) -> AbstractContextManager[Cluster | None]:
    if address is None:
        return nullcontext()
    from .cluster import dask_cluster  # slow to import

    return dask_cluster(address, url)


def _progress(quiet: bool) -> Any:
    if quiet:
        return nullcontext(Silent())
    console = Console(stderr=True)
    return Bar(console) if console.is_terminal else Lines(sys.stderr, time.monotonic)


@contextmanager
def _stopped_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP unwind the stack as SIGINT does, so that temporary files go."""
    numbers = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)

    def stop(number: int, _: FrameType | None) -> None:
        for each in numbers:  # cleaning up takes a moment: nothing may interrupt it
            signal.signal(each, signal.SIG_IGN)
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + number)

    before = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
