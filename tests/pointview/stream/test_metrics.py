"""PSNR and SSIM over the covered pixels, against values by hand and by the definition."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pointview.stream.metrics import psnr_db, ssim

EVERYWHERE = np.ones((16, 20), dtype=bool)


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (16, 20, 3), dtype=np.uint8)


def test_psnr_by_hand():
    black, other = np.zeros((16, 20, 3), np.uint8), np.zeros((16, 20, 3), np.uint8)
    other[0, 0] = [51, 0, 0]  # a fifth of 255, in one channel of one pixel
    covered = np.zeros((16, 20), dtype=bool)
    covered[0, :2] = True
    # mean square over two pixels of three channels: 51^2 / 6; 255^2 over it is 150
    assert psnr_db(other, black, covered) == pytest.approx(10 * math.log10(150))
    assert psnr_db(black, other, covered) == pytest.approx(10 * math.log10(150))
    assert psnr_db(other, black, ~covered) is None
    assert psnr_db(other, black, np.zeros_like(covered)) is None
    white = np.full_like(black, 255)
    assert psnr_db(white, black, EVERYWHERE) == pytest.approx(0.0)


def test_the_background_flatters_no_picture():
    reference, shown = np.zeros((64, 64, 3), np.uint8), np.zeros((64, 64, 3), np.uint8)
    covered = np.zeros((64, 64), dtype=bool)
    covered[:4, :4] = True
    reference[covered], shown[covered] = 200, 100
    assert psnr_db(shown, reference, covered) == pytest.approx(10 * math.log10(255**2 / 100**2))


def test_ssim_by_its_definition():
    first, second = picture(1), picture(2)
    covered = np.zeros((16, 20), dtype=bool)
    covered[8, 9] = True
    values = []
    for channel in range(3):
        x = first[5:12, 6:13, channel].astype(float).ravel()  # the window of 7 pixels about (8, 9)
        y = second[5:12, 6:13, channel].astype(float).ravel()
        xy = np.cov(x, y)
        c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
        values.append(
            (2 * x.mean() * y.mean() + c1) * (2 * xy[0, 1] + c2)
            / ((x.mean() ** 2 + y.mean() ** 2 + c1) * (xy[0, 0] + xy[1, 1] + c2))
        )  # fmt: skip
    assert ssim(first, second, covered) == pytest.approx(np.mean(values))


def test_ssim_of_equal_and_of_tiny_pictures():
    first = picture(1)
    assert ssim(first, first, EVERYWHERE) == pytest.approx(1.0)
    assert ssim(first[:5], first[:5], EVERYWHERE[:5]) == 1.0
    assert ssim(first[:5], picture(2)[:5], EVERYWHERE[:5]) == 0.0
    assert ssim(first, picture(2), EVERYWHERE) < 0.2
    assert ssim(first, first, np.zeros_like(EVERYWHERE)) == 1.0
