"""``pointstream doctor``."""

from __future__ import annotations

import asyncio
import json
import time
from typing import TYPE_CHECKING, Any

import click

from lpc.errors import StoreError

from .arguments import Number
from .doctor import advisable, can_serve, diagnose
from .remedies import recipes_for

if TYPE_CHECKING:
    from .doctor import Finding, Observations

_MARKS = {"good": "+", "advice": "!", "failure": "x", "unknown": "?"}


@click.command()
@click.argument("url")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
@click.option("--rest", default=3.0, show_default=True, type=Number(0, 120), help="Seconds to try keep-alive.")
def doctor(url: str, as_json: bool, rest: float) -> None:
    """Say whether the host of URL, a model, can serve models, and what to change; exit status 1 if it cannot.

    Asks a dozen times, reads at most 3 MB.
    """
    from .probe import ProbeOptions, parse_address, probe

    try:
        parse_address(url)
    except StoreError as error:
        raise click.BadParameter(str(error), param_hint="URL") from error
    seen = asyncio.run(probe(url, clock=time.perf_counter, options=ProbeOptions(rest=rest)))
    findings = diagnose(seen)
    able = can_serve(findings)
    recipes = recipes_for(seen.first.headers.get("server")) if advisable(findings) else {}
    if as_json:
        click.echo(json.dumps(_to_json(seen, findings, able, dict(recipes))))
    else:
        _print(seen, findings, able, dict(recipes))
    if not able:
        click.get_current_context().exit(1)


def _print(seen: Observations, findings: list[Finding], able: bool, recipes: dict[str, str]) -> None:
    click.echo(f"{seen.address} ({seen.first.headers.get('server', 'does not say what it is')})")
    for finding in findings:
        click.echo(f"  {_MARKS[finding.level]} {finding.topic}: {finding.text}")
    advice = sum(finding.level == "advice" for finding in findings)
    better = f", and could do better in {advice}" if advice else ""
    if any(finding.topic == "address" for finding in findings):
        click.echo("Nothing can be said of the host without a model on it: give the address of one.")
    else:
        click.echo(f"This host can serve models{better}." if able else "This host cannot serve models as it is.")
    for name, lines in recipes.items():
        click.echo(f"\nFor {name}:\n")
        click.echo("\n".join(f"    {line}" for line in lines.strip().splitlines()))


def _to_json(seen: Observations, findings: list[Finding], able: bool, recipes: dict[str, str]) -> dict[str, Any]:
    return {
        "address": seen.address,
        "server": seen.first.headers.get("server"),
        "can_serve": able,
        "findings": [{"topic": f.topic, "level": f.level, "text": f.text} for f in findings],
        "bytes": seen.length,
        "complete": None if seen.header is None or seen.length is None else seen.length >= seen.header.bytes,
        "round_trip_seconds": min(seen.rtts, default=None),
        "goodput_bits_per_second": None if seen.goodput is None else 8 * seen.goodput,
        "keep_alive": seen.kept,
        "idle_seconds_survived": seen.rested,
        "recipes": {name: lines.strip() for name, lines in recipes.items()},
    }
