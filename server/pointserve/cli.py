"""``pointstream serve`` and ``pointstream sign``."""

from __future__ import annotations

import asyncio
import logging
import math
import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lpc.errors import LpcError

from .config import ServeConfig
from .guard import Guard, read_key, read_tokens, sign_address

if TYPE_CHECKING:
    from collections.abc import Callable

_FILE = click.Path(dir_okay=False, path_type=Path)
_SECONDS = {"s": 1, "m": 60, "h": 3600, "d": 86_400, "w": 604_800}
_FACTORS = {"": 1.0, "k": 1e3, "M": 1e6, "G": 1e9}


class _Seconds(click.FloatRange):
    """A range that a NaN is not in; click's own lets it pass."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        seconds = super().convert(value, param, ctx)
        if math.isnan(seconds):
            self.fail(f"{value} is no number of seconds", param, ctx)
        return seconds


def _parse_rate(ctx: click.Context, param: click.Parameter, value: str | None) -> float | None:
    if value is None:
        return None
    found = re.fullmatch(r"(\d+(?:\.\d+)?)([kMG]?)", value)
    if found is None or not 8000 <= (rate := float(found[1]) * _FACTORS[found[2]]) <= 1e15:
        raise click.BadParameter(f"{value!r} is no number of bits a second like 20M or 800k, at least 8k", ctx, param)
    return rate


def _parse_duration(ctx: click.Context, param: click.Parameter, value: str) -> int:
    found = re.fullmatch(r"(\d{1,9})([smhdw])", value)
    if found is None or int(found[1]) == 0:
        raise click.BadParameter(f"{value!r} is no time like 30m, 12h or 7d", ctx, param)
    return int(found[1]) * _SECONDS[found[2]]


@click.command()
@click.argument("directory", type=click.Path(path_type=Path))
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on; 0.0.0.0 is all of them.")
@click.option("--port", default=8080, show_default=True, type=click.IntRange(0, 65535), help="0 takes a free port.")
@click.option("--workers", default=1, show_default=True, type=click.IntRange(1, 64), help="Processes on the port.")
@click.option("--cors", multiple=True, metavar="ORIGIN", help="Let pages of ORIGIN read models in a browser; * is all.")
@click.option("--certfile", type=_FILE, help="Certificate chain, PEM: speak https.")
@click.option("--keyfile", type=_FILE, help="Its private key, where that is a file of its own.")
@click.option("--token-file", type=_FILE, help="Tokens, one a line; only who shows one may read.")
@click.option("--sign-key", type=_FILE, help="Key of signed addresses (pointstream sign); only who has one may read.")
@click.option("--rate", callback=_parse_rate, metavar="BITS", help="Bits a second for one address, 20M for example.")
@click.option(
    "--connections", default=800, show_default=True, type=click.IntRange(1, 1 << 20), help="At a time, in total."
)
@click.option(
    "--per-address", default=256, show_default=True, type=click.IntRange(1, 1 << 20), help="At a time, of one address."
)
@click.option("--grace", default=60.0, show_default=True, type=_Seconds(0, 86_400), help="Seconds to end replies in.")
@click.option(
    "--log", "log", default="text", show_default=True, type=click.Choice(["text", "json"]), help="Of requests."
)
@click.option("--quiet", is_flag=True, help="Write no line for each request.")
def serve(
    directory: Path,
    host: str,
    port: int,
    workers: int,
    cors: tuple[str, ...],
    certfile: Path | None,
    keyfile: Path | None,
    token_file: Path | None,
    sign_key: Path | None,
    rate: float | None,
    connections: int,
    per_address: int,
    grace: float,
    log: str,
    quiet: bool,
) -> None:
    """Serve the models below DIRECTORY over HTTP."""
    _set_up_log(log, quiet)
    try:
        guard = Guard(
            tokens=() if token_file is None else read_tokens(token_file),
            key=b"" if sign_key is None else read_key(sign_key),
        )
        config = ServeConfig(
            directory=directory, host=host, port=port, cors=cors, guard=guard, certfile=certfile, keyfile=keyfile,
            rate=rate, connections=connections, per_address=per_address, grace=grace,
        )  # fmt: skip
        _run(config, workers)
    except LpcError as error:
        raise click.ClickException(str(error)) from error


def _run(config: ServeConfig, workers: int) -> None:
    from .workers import serve_until, supervise  # aiohttp is wanted only here, not for --help

    def announce(url: str) -> None:
        click.echo(f"Serving {config.directory} at {url}")

    if workers > 1:
        supervise(config, workers, loop_factory=loop_factory(), announce=announce)
        return
    with asyncio.Runner(loop_factory=loop_factory()) as runner:
        runner.run(serve_until(config, ready=announce))


def _set_up_log(form: str, quiet: bool) -> None:
    from .accesslog import JsonFormatter

    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if form == "json" else logging.Formatter("%(asctime)s %(message)s"))
    logging.basicConfig(level=logging.WARNING if quiet else logging.INFO, handlers=[handler])


def loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """Return uvloop's where it is installed: small replies cost two thirds there."""
    try:
        import uvloop
    except ImportError:
        return None
    return uvloop.new_event_loop


@click.command()
@click.argument("address")
@click.option("--sign-key", required=True, type=_FILE, help="The key that `serve --sign-key` has.")
@click.option("--expires", default="7d", show_default=True, callback=_parse_duration, help="30m, 12h, 7d, 4w ...")
def sign(address: str, sign_key: Path, expires: int) -> None:
    """Print ADDRESS, a model or a folder (ends with a slash), with a signature that admits to it for a time."""
    try:
        key = read_key(sign_key)
    except LpcError as error:
        raise click.ClickException(str(error)) from error
    try:
        click.echo(sign_address(address, key, int(time.time()) + expires))
    except LpcError as error:
        raise click.BadParameter(str(error), param_hint="ADDRESS") from error
