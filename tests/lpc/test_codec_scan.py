"""The size that the codec is for, on a real scan (LPC section 6 has 33 to 40 bits a sample)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from plyfile import PlyData

from lpc.attributes import Attribute
from lpc.codec import decode_cloud, encode_clouds
from lpc.lattice import dequantise, position_step, quantise
from lpc.octahedral import decode_normals, encode_normals, max_error_degrees

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SCHEMA = (Attribute(name="normal", kind="normal", dtype="<f4", bits=8),)
CLOUD_SIZE = 2048


@pytest.mark.parametrize("effort", ["default", "best"])
def test_position_and_normal_of_a_scanned_object_take_22_bits(scan_path: Callable[[str], Path], effort: str) -> None:
    ply = PlyData.read(scan_path("ankylosaurus_mesh.ply"))
    vertex = ply["vertex"]
    xyz = np.stack([vertex[name] for name in "xyz"], axis=1).astype(np.float64)
    normals = np.stack([vertex[name] for name in ("nx", "ny", "nz")], axis=1).astype(np.float64)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    a, b, c = (xyz[np.stack(ply["face"]["vertex_indices"])[:, corner]] for corner in range(3))
    spacing = np.sqrt(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 / len(xyz))

    # Random layers by halves of the longest axis, as LPC section 3; without recursion two layers deep is enough.
    order = np.random.default_rng(1).permutation(len(xyz))
    root, rest = order[:CLOUD_SIZE], order[CLOUD_SIZE:]
    rest = rest[np.argsort(xyz[rest, 0], kind="stable")]
    chunks = [root, *np.array_split(rest, len(rest) // CLOUD_SIZE)]
    order = np.concatenate(chunks)
    bounds = np.cumsum([0, *map(len, chunks)])

    origin = xyz.min(axis=0)
    step = position_step(float(spacing), float(np.ptp(xyz, axis=0).max()))
    lattice = quantise(xyz[order], origin, step)
    codes = {"normal": encode_normals(normals[order])}
    frames = encode_clouds(lattice, codes, bounds, SCHEMA, effort=effort)  # type: ignore[arg-type]
    assert 8 * sum(map(len, frames)) / len(xyz) <= 22.0

    for frame, first, stop in zip(frames, bounds, bounds[1:], strict=False):
        cloud = decode_cloud(frame, samples=int(stop - first), schema=SCHEMA)
        key = np.column_stack([cloud.lattice(), cloud.codes["normal"]])
        wanted = np.column_stack([lattice[first:stop], codes["normal"][first:stop]])
        ours, theirs = np.lexsort(key.T), np.lexsort(wanted.T)
        back = dequantise(cloud.lattice()[ours], origin, step)
        assert np.linalg.norm(back - xyz[order[first:stop]][theirs], axis=1).max() <= spacing / 2
        chord = decode_normals(cloud.codes["normal"])[ours].astype(np.float64) - normals[order[first:stop]][theirs]
        angle = 2 * np.arcsin(np.linalg.norm(chord, axis=1) / 2)
        assert np.degrees(angle.max()) <= max_error_degrees(8)
