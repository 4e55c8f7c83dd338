"""``pointstream link``: a throttled front until it is interrupted."""

from __future__ import annotations

import asyncio
import signal
import sys
from typing import TYPE_CHECKING

import click

from lpc.errors import LpcError
from pointlink.front import check_upstream, parse_upstream, precise_loop, serve_front
from pointlink.profiles import parse_profile

if TYPE_CHECKING:
    from pointlink.front import Upstream
    from pointlink.profiles import Profile


def read_profile(ctx: click.Context, param: click.Parameter, value: str) -> Profile:
    """Read a profile (a click callback); a wrong one ends with exit status 2."""
    try:
        return parse_profile(value)
    except ValueError as error:
        raise click.BadParameter(str(error), ctx, param) from error


def _read_upstream(ctx: click.Context, param: click.Parameter, value: str) -> Upstream:
    try:
        return parse_upstream(value)
    except ValueError as error:
        raise click.BadParameter(str(error), ctx, param) from error


@click.command()
@click.argument("upstream", callback=_read_upstream)
@click.option("--profile", callback=read_profile, required=True, help="none, adsl, lan or RATE[,RTT]: 1.25M,50ms")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port to listen on; 0: any free one.")
def link(upstream: Upstream, profile: Profile, host: str, port: int) -> None:
    """Put a slow link in front of a server.

    UPSTREAM is http://HOST[:PORT]/PATH, https://HOST/PATH or tcp://HOST:PORT. Prints the address that stands for it;
    the same paths work there. A rate is TCP payload bits per second in both directions.
    """
    try:
        with asyncio.Runner(loop_factory=precise_loop) as runner:
            runner.run(_serve(upstream, profile, host, port))
    except LpcError as error:
        raise click.ClickException(str(error)) from error


async def _serve(upstream: Upstream, profile: Profile, host: str, port: int) -> None:
    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    if sys.platform != "win32":  # its loops have no signal handlers: there the interrupt ends the runner
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, stopped.set)
    await check_upstream(upstream)
    async with await serve_front(upstream, profile, host=host, port=port) as front:
        click.echo(front.url)
        click.echo(f"{profile}; interrupt to stop", err=True)
        await stopped.wait()
