"""``pointstream serve``."""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lpc.errors import LpcError

from .config import ServeConfig

if TYPE_CHECKING:
    from collections.abc import Callable


@click.command()
@click.argument("directory", type=click.Path(path_type=Path))
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on; 0.0.0.0 is all of them.")
@click.option("--port", default=8080, show_default=True, type=click.IntRange(0, 65535), help="0 takes a free port.")
@click.option("--cors", multiple=True, metavar="ORIGIN", help="Let pages of ORIGIN read models in a browser; * is all.")
@click.option("--quiet", is_flag=True, help="Write no line for each request.")
def serve(directory: Path, host: str, port: int, cors: tuple[str, ...], quiet: bool) -> None:
    """Serve the models below DIRECTORY over HTTP."""
    config = ServeConfig(directory=directory, host=host, port=port, cors=cors)
    logging.basicConfig(
        level=logging.WARNING if quiet else logging.INFO, format="%(asctime)s %(message)s", stream=sys.stderr
    )
    try:
        with asyncio.Runner(loop_factory=_loop_factory()) as runner:
            runner.run(_serve_until_signalled(config))
    except LpcError as error:
        raise click.ClickException(str(error)) from error


async def _serve_until_signalled(config: ServeConfig) -> None:
    from .listener import serving  # aiohttp is wanted only here, not for --help

    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    async with serving(config) as url:
        click.echo(f"Serving {config.directory} at {url}")
        await stop.wait()
        for number in (signal.SIGINT, signal.SIGTERM):  # a second signal does not wait for the replies under way
            loop.remove_signal_handler(number)


def _loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """Return uvloop's where it is installed: small replies cost two thirds there."""
    try:
        import uvloop
    except ImportError:
        return None
    return uvloop.new_event_loop
