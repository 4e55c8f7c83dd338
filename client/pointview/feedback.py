"""Tolerance feedback on frame time (LPC 4): coarser when frames take too long, finer when there is time to spare.

The paper adjusts the pixel threshold after every frame. Frame times jump where one threshold steps over many clouds, so
a plain controller swings around such a step for ever. This one remembers, as long as the camera stands still, the
largest tolerance that was too slow and never comes back to it: under a still camera the bracket between *too slow* and
*fast enough* only closes, and the tolerance comes to rest.

Coarser is not always quicker: where large splats lie on one another, as in folded sheets, the pixels take the time and
not the samples. So coarsening is a trial: where it gains too little, the tolerance goes back to where it began, and no
picture is thrown away for nothing. Pure: times are arguments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

SLOW, FAST = 1.15, 0.70
"""Frame times, over the allowed one, above which the tolerance rises and below which it falls."""

LARGEST_STEP = 1.5
"""Factor of the tolerance in one frame."""

CLOSED = 1.03
"""A bracket this narrow is not halved any more."""

COARSEST = 64.0
"""Pixels."""

TRIAL, GAIN = 1.4, 0.85
"""Factor of the tolerance after which coarsening is judged, and frame time over that before that is a gain."""

FORGET, MOST_FORGOTTEN = 1.0, 1.1
"""Share a second, and factor a frame at most, by which a moving camera may again exceed what coarsening was worth."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Feedback:
    """The controller between two frames.

    Parameters
    ----------
    tolerance : float
        Of the next frame, pixels.
    too_slow : float
        Largest tolerance that took too long since the camera stopped; 0: none did.
    began, before : float
        Tolerance and frame time where the present coarsening began; 0: there is none.
    worth : float
        Largest tolerance that coarsening was found to be worth, pixels.
    """

    tolerance: float
    too_slow: float = 0.0
    began: float = 0.0
    before: float = 0.0
    worth: float = COARSEST

    def step(self, seconds: float, *, allowed: float, finest: float, moved: bool) -> Feedback:
        """Take in one frame.

        Parameters
        ----------
        seconds : float
            What it took.
        allowed : float
            What it may take.
        finest : float
            Tolerance that is asked for; never below it.
        moved : bool
            Whether the camera moved since the frame before: what was too slow may not be so any more.
        """
        too_slow = 0.0 if moved else self.too_slow
        worth = self.worth
        if moved:
            worth = min(worth * min(1.0 + FORGET * seconds, MOST_FORGOTTEN), COARSEST)
        began, before = self.began, self.before
        load = seconds / allowed
        tolerance = self.tolerance
        # Splats on the screen go with the inverse square of the spacing, and time about as the splats do.
        change = math.sqrt(load) if load > 0 else 0.0
        if load > SLOW:
            too_slow = max(too_slow, tolerance)
            if began and tolerance >= began * TRIAL and seconds > GAIN * before:
                tolerance = worth = began
                began = 0.0
            elif not began or tolerance >= began * TRIAL:
                began, before = tolerance, seconds
            tolerance = min(tolerance * min(change, LARGEST_STEP), max(worth, tolerance))
        elif load < FAST and tolerance > finest:
            finer = tolerance * max(change, 1 / LARGEST_STEP)
            if finer <= too_slow:
                finer = math.sqrt(too_slow * tolerance) if tolerance > too_slow * CLOSED else tolerance
            tolerance = finer
        if load <= SLOW:
            began = before = 0.0
        tolerance = min(max(tolerance, finest), max(finest, COARSEST))
        return replace(self, tolerance=tolerance, too_slow=too_slow, began=began, before=before, worth=worth)
