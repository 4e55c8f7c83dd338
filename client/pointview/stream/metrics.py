"""How far a picture is from the same view fully resident.

Both measures look only at the pixels covered in either picture: an empty background would flatter every
picture of a small object.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from skimage.metrics import structural_similarity

if TYPE_CHECKING:
    from numpy.typing import NDArray

SSIM_WINDOW = 7
"""Pixels, scikit-image's own default for uniform filtering."""


def psnr_db(picture: NDArray[np.uint8], reference: NDArray[np.uint8], covered: NDArray[np.bool_]) -> float | None:
    """Peak signal-to-noise ratio over the covered pixels.

    Parameters
    ----------
    picture, reference : ndarray, (h, w, 3) uint8
    covered : ndarray, (h, w) bool
        Pixels covered in either picture.

    Returns
    -------
    float or None
        Decibels; None where the pictures are equal on those pixels.
    """
    if not covered.any():
        return None
    difference = picture[covered].astype(np.float64) - reference[covered]
    error = float(np.mean(difference * difference))
    return None if error == 0.0 else float(10.0 * np.log10(255.0**2 / error))


def ssim(picture: NDArray[np.uint8], reference: NDArray[np.uint8], covered: NDArray[np.bool_]) -> float:
    """Mean structural similarity over the covered pixels, 1 where the pictures are equal.

    Computed on the whole picture, so that windows at the silhouette see the background, and averaged over
    the covered pixels.
    """
    if not covered.any() or min(picture.shape[:2]) < SSIM_WINDOW:
        return 1.0 if np.array_equal(picture, reference) else 0.0
    _, similarity = structural_similarity(  # type: ignore[no-untyped-call]
        picture, reference, win_size=SSIM_WINDOW, channel_axis=2, data_range=255, full=True
    )
    return float(similarity[covered].mean())
