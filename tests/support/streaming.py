"""Short streaming experiments from the command line."""

from __future__ import annotations

import json
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pointstream.command import run as command

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


def stream(
    model: object, folder: Path, *arguments: object, link: str = "adsl", clock: str = "virtual"
) -> dict[str, Any]:
    """Run ``pointstream stream`` and return its report.json."""
    given = ("--link", link, "--clock", clock, "--report", folder, "--size", "160x120", *arguments)
    assert command(["stream", str(model), *map(str, given)]) == 0
    return json.loads((folder / "report.json").read_text())


@contextmanager
def silent(label: str, total: int) -> Iterator[Callable[[int], None]]:
    """A progress that shows nothing."""
    yield lambda steps: None
