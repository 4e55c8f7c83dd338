"""The command lines of this folder, all alike: `--help` says what a script is about, `--samples` takes 200k and 10M."""

from __future__ import annotations

import argparse
from pathlib import Path

UNITS = {"k": 1_000, "M": 1_000_000, "G": 1_000_000_000}


def parser(about: str | None) -> argparse.ArgumentParser:
    """A parser of a script with this docstring."""
    return argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)


def samples(text: str) -> int:
    """A number of samples: 200k, 2M, 1.5G, 234717830."""
    try:
        count = round(float(text[:-1]) * UNITS[text[-1]]) if text[-1:] in UNITS else int(text)
    except (ValueError, OverflowError):
        count = 0
    if count < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of samples like 200k, 10M or 234717830")
    return count


def nothing(about: str | None) -> None:
    """Take the command line of a script that asks for nothing."""
    parser(about).parse_args()


def models(about: str | None) -> list[Path]:
    """Take the command line of a script that wants models."""
    asked = parser(about)
    asked.add_argument("models", nargs="+", type=Path, metavar="MODEL.lpc")
    return [Path(model) for model in asked.parse_args().models]


def model(about: str | None) -> Path | None:
    """Take the command line of a script that makes a model up if it is given none."""
    asked = parser(about)
    asked.add_argument("model", nargs="?", type=Path, metavar="MODEL.lpc")
    return asked.parse_args().model  # type: ignore[no-any-return]
