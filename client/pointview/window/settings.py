"""What the panel edits: how the next frames look, and how well."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from pointview.render import Splat, Style

if TYPE_CHECKING:
    from pointview.colouring import Mode

TOLERANCES = (0.5, 32.0)
"""Range of the slider, pixels."""

BUDGETS = (50_000, 20_000_000)
"""Range of the slider, splats."""


@dataclass(slots=True, kw_only=True)
class Settings:
    """Changed by panel and keys, read by the frame loop.

    Parameters
    ----------
    tolerance : float
        Pixels.
    budget : int
        Most splats.
    limited : bool
        Whether the budget counts.
    steady : bool
        Raise the tolerance while frames take longer than `frame_seconds`.
    frame_seconds : float
    mode : Mode
    tint : bool
        Starved pixels in yellow.
    splat : Splat
    occlusion : bool
        Leave out what is hidden, where that pays.
    two_sided, close_holes : bool
        See `Style`.
    edl_strength : float
    fly : bool
        Dragging turns the head instead of the model.
    speed : float
        Of flying, sizes of the model a second.
    up : {"y", "z"}, optional
        The model's vertical; by its header if not given.
    panel, help, marks : bool
        What is shown; the marks are axes and scale bar.
    """

    tolerance: float = 1.0
    budget: int = 3_000_000
    limited: bool = False
    steady: bool = True
    frame_seconds: float = 0.05
    mode: Mode = "color"
    tint: bool = False
    occlusion: bool = True
    splat: Splat = Style().splat
    two_sided: bool = False
    close_holes: bool = True
    edl_strength: float = Style().edl_strength
    fly: bool = False
    speed: float = 0.25
    up: Literal["y", "z"] | None = None
    panel: bool = True
    marks: bool = True
    help: bool = False

    def style(self) -> Style:
        """Return the renderer's part."""
        return Style(
            two_sided=self.two_sided,
            splat=self.splat,
            close_holes=self.close_holes,
            edl_strength=self.edl_strength,
        )
