"""Is a model inside out? A hint for people, from the root's samples, which are a uniform sample of the whole model.

By the divergence theorem the normals n of a closed surface, weighed by area, sum to zero, and n . (p - c) to three
times the volume that it encloses, whatever the point c: positive where normals point outwards. Uniform samples weigh by
area themselves. Open surfaces, terrain above all, are left alone: their normals do not balance.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lpc.codec import cloud_to_points, decode_cloud
from lpc.index import IndexTree

if TYPE_CHECKING:
    from pathlib import Path

    from lpc.header import Header
    from lpc.points import PointBatch

INWARD = -0.2
"""Sum of n . (p - c) over that of |p - c|: 1 for a sphere, 0.28 to 0.67 for statues, -0.39 for an inverted one."""
BALANCED = 0.25
"""Length of the mean normal of a closed surface, at most: up to 0.17 for statues, 0.28 to 1 for views from one side."""
FEWEST = 256
"""Samples with normals that a judgement takes."""

HINT = (
    "its normals point inwards, so its inside is what is shown, as is right for a room: for an object, use --two-sided "
    "('both sides' in the window), or turn the normals of the scan around"
)


def is_inside_out(points: PointBatch) -> bool:
    """Whether samples of a closed surface have normals that point inwards on the whole."""
    if points.normal is None:
        return False
    has = points.normal.any(axis=1)
    normal, place = points.normal[has].astype(np.float64), points.xyz[has]
    if len(place) < FEWEST or np.linalg.norm(normal.mean(axis=0)) > BALANCED:
        return False
    place = place - place.mean(axis=0)
    return bool((normal * place).sum() < INWARD * np.linalg.norm(place, axis=1).sum())


def root_samples(path: Path, header: Header) -> PointBatch:
    """Read the root of a model that was just written."""
    index = IndexTree(header)
    with path.open("rb") as file:
        page = index.page_range(0)
        file.seek(page.start)
        index.add_page(0, file.read(page.size))
        cloud = index.cloud_range(0)
        file.seek(cloud.start)
        frame = file.read(cloud.size)
    return cloud_to_points(decode_cloud(frame, samples=int(index.samples[0]), schema=header.attributes), header)
