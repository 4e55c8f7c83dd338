"""Kinds of option values that the commands of this package share; a wrong one is exit status 2 and one line."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lpc.errors import FormatError
from pointstream.arguments import POSITIVE

if TYPE_CHECKING:
    from pointlink.profiles import Profile

    from .stream.path import ViewPath

LARGEST_SIDE = 16384


class SizeType(click.ParamType[tuple[int, int]]):
    """WIDTHxHEIGHT, pixels."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Return (width, height)."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", str(value).strip())
        if match is None:
            self.fail(f"{value!r} is no size; write for example 1024x768", param, ctx)
        width, height = int(match[1]), int(match[2])
        if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
            self.fail(f"{value!r}: sides are 1 to {LARGEST_SIDE} pixels", param, ctx)
        return width, height


class ViewType(click.ParamType[dict[str, Any]]):
    """A VIEW.json file."""

    name = "VIEW.json"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> dict[str, Any]:
        """Return the object, which is a view."""
        from .camera import Camera

        if isinstance(value, dict):
            return value
        try:
            view = json.loads(Path(value).read_text(encoding="utf-8"))
            Camera.from_view(view, width=1, height=1)
        except OSError as error:
            self.fail(f"cannot read {value}: {error.strerror}", param, ctx)
        except FormatError as error:
            self.fail(f"{value}: {error}", param, ctx)
        except (ValueError, RecursionError):
            self.fail(f"{value} is not JSON; a view is an object with eye, target, up and fov_y", param, ctx)
        return dict(view)


class PathType(click.ParamType["ViewPath"]):
    """A PATH.json file."""

    name = "PATH.json"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> ViewPath:
        """Return the path."""
        from .stream.path import ViewPath

        if isinstance(value, ViewPath):
            return value
        try:
            return ViewPath.read(Path(value))
        except FormatError as error:
            self.fail(str(error), param, ctx)


def read_link(text: str) -> Profile:
    """Read the option ``--link``.

    Raises
    ------
    click.BadParameter
        If it is none.
    """
    from pointlink.profiles import parse_profile

    try:
        return parse_profile(text)
    except ValueError as error:
        raise click.BadParameter(str(error), param_hint="--link") from error


TOLERANCE = click.option(
    "--tolerance",
    type=POSITIVE,
    default=1.0,
    show_default=True,
    help="Spacing of samples on the screen that is fine enough, pixels.",
)
"""The option of every command that refines."""
