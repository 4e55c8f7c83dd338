"""The catalogue as a page for people. Plain HTML, no script: it works in any browser and through any cache."""

from __future__ import annotations

import re
import shlex
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from .catalogue import Entry

_STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #888; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.1rem; margin: 0; }
article { border-top: 1px solid var(--line); padding: 1rem 0; overflow: hidden; }
article img { float: right; width: 11rem; border-radius: 4px; margin-left: 1rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0 1rem; margin: .5rem 0; }
dt { color: var(--soft); } dd { margin: 0; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
pre { background: #8881; padding: .4rem .7rem; border-radius: 4px; margin: 0; white-space: pre-wrap;
      overflow-wrap: anywhere; user-select: all; }
.problem { color: #c33; } footer { color: var(--soft); border-top: 1px solid var(--line); padding-top: 1rem; }
"""


def catalogue_page(entries: Iterable[Entry], origin: str, *, query: str = "") -> str:
    """Return the page of all models.

    Parameters
    ----------
    entries : iterable of Entry
        In the order in which they are shown.
    origin : str
        Scheme and host under which the visitor reached the server, ``http://host:8080``.
    query : str
        What the visitor's address has after ``?``: links repeat it, so that a signed folder can be walked.
    """
    shown = list(entries)
    models = [entry for entry in shown if entry.header is not None]
    samples = sum(entry.header.samples for entry in models if entry.header is not None)
    summary = f"{_some(len(models), 'model')}, {count(samples)} samples"
    suffix = f"?{query}" if query else ""
    articles = (
        "\n".join(_article(entry, origin, suffix) for entry in shown) or "<p>No models are in this folder yet.</p>"
    )
    return (
        '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>Point models</title>\n<style>{_STYLE}</style>\n"
        f"<h1>Point models</h1>\n<p>{summary}</p>\n{articles}\n"
        f'<footer>The same as <a href="catalogue.json{escape(suffix)}">JSON</a>. '
        "The lines above open a model with pointstream.</footer>\n"
    )


def _article(entry: Entry, origin: str, suffix: str) -> str:
    link = f'<h2><a href="{escape(entry.path + suffix)}" download>{escape("/".join(entry.names))}</a></h2>'
    if entry.header is None:
        return f'<article>\n{link}\n<p class="problem">Not a model: {escape(entry.problem or "")}</p>\n</article>'
    picture = f'<img src="{escape(entry.path + ".png" + suffix)}" alt="">\n' if entry.picture else ""
    facts = "\n".join(f"<dt>{name}</dt><dd>{escape(value)}</dd>" for name, value in _facts(entry))
    address = origin + entry.path + suffix
    command = f"<pre>pointstream view {escape(shlex.quote(address))}</pre>"
    return f"<article>\n{picture}{link}\n<dl>\n{facts}\n</dl>\n{command}\n</article>"


def _facts(entry: Entry) -> list[tuple[str, str]]:
    header = entry.header
    assert header is not None
    low, high = header.bounds[:3], header.bounds[3:]
    size = " × ".join(f"{b - a:.6g}" for a, b in zip(low, high, strict=True))
    attributes = [attribute.name for attribute in header.attributes] + sorted(header.constants)
    bits = header.bits_per_sample.get("total", 8 * header.bytes / header.samples)
    facts = [
        ("samples", f"{count(header.samples)} in {_some(header.nodes, 'cloud')}, {_some(header.levels, 'level')}"),
        ("size", f"{byte_size(entry.size)}, {bits:.1f} bits a sample"),
        ("attributes", ", ".join(attributes) or "none"),
        ("extent", f"{size}, spacing {header.spacing:.3g}, error at most {header.position_error:.2g}"),
        ("bounds", f"{_point(low)} to {_point(high)}"),
        ("coordinates", crs_name(header.crs) or "no reference system"),
    ]
    if not entry.complete:
        here = f"{byte_size(entry.size)} of {byte_size(header.bytes)} are here: a coarser model"
        facts.insert(0, ("incomplete", here))
    return facts


def _point(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:.10g}" for value in values) + ")"


def crs_name(wkt: str | None) -> str | None:
    """Name that a WKT text begins with: ``PROJCRS["OSGB36 / British National Grid", ...``."""
    if not wkt:
        return None
    found = re.match(r'\s*\w+\s*\[\s*"([^"]*)"', wkt)
    return found[1] if found else wkt[:80]


def count(number: int) -> str:
    """Return a number with groups of three digits set apart."""
    return f"{number:,}".replace(",", "\u202f")


def _some(number: int, noun: str) -> str:
    return f"{count(number)} {noun}{'' if number == 1 else 's'}"


def byte_size(number: int) -> str:
    """Return a number of bytes with three significant digits and a decimal unit."""
    if number < 1000:
        return f"{number} bytes"
    value, units = number / 1000, ["kB", "MB", "GB", "TB"]
    while value >= 999.5 and len(units) > 1:
        value /= 1000
        del units[0]
    return f"{value:.3g} {units[0]}"
