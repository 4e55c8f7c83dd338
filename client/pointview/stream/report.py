"""What a run leaves on disk: report.json by the contract, the pictures, and a plot of error against run time."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from lpc.errors import StoreError
from pointview.render.picture import save_picture, tint_starved

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from .session import Moment

PICTURE_TIMES = (1.0, 10.0, 20.0, 30.0)
"""Seconds; those of LPC figure 5."""

INK, FIRST, SECOND, THIRD = "#333333", "#1f6feb", "#d97706", "#6b7280"


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """The figures of one run; field names are those of report.json, see docs/streaming.md."""

    model: str
    link: str
    clock: str
    priority: str
    splat_rule: str
    occlusion: str
    prefetch: str
    occluded: int
    left_out: dict[str, str]
    size: tuple[int, int]
    seconds: float
    samples: int
    bytes: int
    requests: int
    link_utilisation: float | None
    first_picture_s: float | None
    settled_s: float | None
    tolerance: float
    model_samples: int
    model_bytes: int
    payload_bytes: int
    speculative_bytes: int
    idle_bytes: int
    wasted_bytes: int
    wanted_s: float
    frames: int
    errors: tuple[str, ...]
    curve: tuple[dict[str, Any], ...]


def prepare_folder(folder: Path) -> None:
    """Make the report's folder and take the pictures of an earlier run out of it.

    Raises
    ------
    StoreError
        If the folder cannot be made or written: better known before a run than after it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for old in (
            folder / "report.json",
            folder / "curve.png",
            *folder.glob("frame-[0-9]*s.png"),
            *folder.glob("frame-[0-9]*s-starved.png"),
        ):
            old.unlink(missing_ok=True)
        trial = folder / "report.json"
        trial.touch()
        trial.unlink()
    except OSError as error:
        raise _cannot_write(folder, error) from error


def _cannot_write(folder: Path, error: OSError) -> StoreError:
    return StoreError(f"{folder}: the report cannot be written there: {error.strerror or error}")


def write_report(folder: Path, report: Report, moments: Sequence[Moment]) -> list[Path]:
    """Write report.json, the pictures and curve.png into a folder, made if need be.

    Returns
    -------
    list of Path
        What was written, report.json first.

    Raises
    ------
    StoreError
        If the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written = [folder / "report.json"]
        written[0].write_text(json.dumps(asdict(report), indent=1, allow_nan=False) + "\n", encoding="utf-8")
        for stem, moment in _pictured(moments, report.seconds).items():
            picture = moment.picture()
            for path, rgb in (
                (folder / f"{stem}.png", picture.rgb),
                (folder / f"{stem}-starved.png", tint_starved(picture)),
            ):
                save_picture(rgb, path)
                written.append(path)
        written.append(folder / "curve.png")
        plot_curve(written[-1], report)
    except OSError as error:
        raise _cannot_write(folder, error) from error
    return written


def _pictured(moments: Sequence[Moment], seconds: float) -> dict[str, Moment]:
    """Return the moments nearest to the picture times within the run and to its end, by the names of their files.

    A real clock may be some milliseconds late; the names are those of the asked times.
    """
    return {
        f"frame-{wanted:06.1f}s": min(moments, key=lambda moment: abs(moment.t - wanted))
        for wanted in (*(t for t in PICTURE_TIMES if t <= seconds), seconds)
    }


def plot_curve(path: Path, report: Report) -> None:
    """Plot error, and bytes, against run time."""
    with mpl.rc_context({"font.size": 9, "axes.edgecolor": INK, "axes.labelcolor": INK}):
        figure = Figure(figsize=(7.2, 6.4), layout="constrained")
        quality, shape, traffic = figure.subplots(3, 1, sharex=True)
        t = np.array([entry["t"] for entry in report.curve])
        psnr = np.array([np.nan if e["psnr_db"] is None else e["psnr_db"] for e in report.curve])
        quality.plot(t, psnr, color=FIRST, marker=".", markersize=3, linewidth=1.2)
        quality.set_ylabel("PSNR to the full model, dB", color=FIRST)
        equal = np.isnan(psnr)
        if equal.any():
            quality.axvspan(t[np.argmax(equal)], t[-1], color=FIRST, alpha=0.08, linewidth=0)
            quality.annotate("equal", (t[np.argmax(equal)], 0.05), xycoords=("data", "axes fraction"), color=FIRST)
        similarity = quality.twinx()
        similarity.plot(t, [entry["ssim"] for entry in report.curve], color=SECOND, linewidth=1.2)
        similarity.set_ylabel("SSIM", color=SECOND)
        similarity.set_ylim(top=1.0)

        shape.plot(t, [100.0 * entry["starved_fraction"] for entry in report.curve], color=SECOND, linewidth=1.2)
        shape.set_ylabel("starved area, %", color=SECOND)
        shape.set_ylim(bottom=0.0)
        spacing = shape.twinx()
        widest = [entry["max_spacing_px"] if entry["splats"] else np.nan for entry in report.curve]
        spacing.plot(t, widest, color=FIRST, linewidth=1.2)
        spacing.axhline(report.tolerance, color=THIRD, linewidth=0.8, linestyle=":")
        spacing.set_yscale("log")
        spacing.set_ylabel("widest spacing, pixels", color=FIRST)

        traffic.plot(t, np.array([entry["bytes"] for entry in report.curve]) / 1e6, color=FIRST, linewidth=1.2)
        traffic.set_ylabel("received, MB", color=FIRST)
        traffic.set_xlabel("seconds since the connection was opened")
        traffic.set_ylim(bottom=0.0)
        for axis in (quality, shape, traffic):
            axis.grid(visible=True, linewidth=0.3)
            if report.first_picture_s is not None:
                axis.axvline(report.first_picture_s, color=THIRD, linewidth=0.8, linestyle="--")
        figure.suptitle(f"{report.model} over {report.link}, tolerance {report.tolerance:g} px, {report.clock} clock")
        figure.savefig(path, dpi=120)
