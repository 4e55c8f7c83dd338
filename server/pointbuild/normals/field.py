"""Which way is out: a coarse field of oriented normals over the whole model, and blocks that follow it.

Signs that travel from neighbour to neighbour need all samples in memory. Here they travel over a coarse sample of the
model, which fits; then every block stands alone: its smooth patches agree within, and each takes the sign that most
of its samples see in the coarse field around them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .fit import NEIGHBOURS, agree, find_neighbours, fit_normals
from .kernels import vote

_GUIDES = 4
_PATCH_DOUBT = 0.2
_VOTERS = 4  # in a large patch every fourth sample votes


@dataclass(frozen=True, slots=True)
class OrientationField:
    """Oriented normals at coarse samples of the model; see `build`."""

    xyz: NDArray[np.float64]
    normals: NDArray[np.float32]
    reach: NDArray[np.float64]
    tree: cKDTree

    @classmethod
    def build(cls, xyz: NDArray[np.float64], *, up: bool = False, k: int = NEIGHBOURS) -> OrientationField:
        """Orient coarse samples.

        Signs agree along a minimum spanning forest. The sign of each tree is free: it is chosen so that the mean of
        normal times way from the centre is positive (by the divergence theorem that is outward on any evenly sampled
        closed surface), or so that most normals point up.

        Parameters
        ----------
        xyz : ndarray, (n, 3) float64
            Samples from all over the model.
        up : bool
            For land: +z instead of outward.
        k : int
            Neighbours of a fit.
        """
        neighbours, reach = find_neighbours(xyz, k)
        normals = fit_normals(xyz, neighbours)
        flip, tree = agree(xyz, normals, neighbours)
        normals[flip] *= -1
        count = np.maximum(np.bincount(tree, minlength=len(xyz)), 1)[:, None]
        centre = np.stack([np.bincount(tree, xyz[:, axis], len(xyz)) for axis in range(3)], axis=1) / count
        outward = normals[:, 2] if up else np.einsum("ij,ij->i", normals, xyz - centre[tree])
        normals[np.bincount(tree, outward, len(xyz))[tree] < 0] *= -1
        return cls(xyz, normals, reach, cKDTree(xyz))

    def votes(self, xyz: NDArray[np.float64], normals: NDArray[np.float32]) -> NDArray[np.float32]:
        """How far normals (n, 3) at `xyz` agree with the field there, -1 to 1."""
        out = np.empty(len(xyz), np.float32)
        nearest = self.tree.query(xyz, np.arange(1, min(_GUIDES, len(self.xyz)) + 1))[1]
        vote(xyz, normals, self.xyz, self.normals, nearest, out)
        return out

    def orient(
        self, xyz: NDArray[np.float64], normals: NDArray[np.float32], patch: NDArray[np.int32] | None = None
    ) -> NDArray[np.float32]:
        """Turn normals to agree with the field, patch by patch, or one by one without patches.

        Parameters
        ----------
        xyz, normals : ndarray, (n, 3)
            Samples; signs agree within a patch.
        patch : ndarray, (n,) int32, or None
            As `fit.agree` gives them.
        """
        if patch is None:
            return np.where(self.votes(xyz, normals)[:, None] < 0, -normals, normals)
        voters = np.flatnonzero(
            (np.bincount(patch, minlength=len(xyz))[patch] < 64) | (np.arange(len(xyz)) % _VOTERS == 0)
        )
        sums = np.bincount(patch[voters], self.votes(xyz[voters], normals[voters]), len(xyz))
        return np.where(sums[patch][:, None] < 0, -normals, normals)


def block_normals(
    xyz: NDArray[np.float64], core: int, field: OrientationField, k: int = NEIGHBOURS
) -> NDArray[np.float32]:
    """Estimate the normals of one block.

    Parameters
    ----------
    xyz : ndarray, (n, 3) float64
        The samples of the block, then those around it that its outer ones need as neighbours.
    core : int
        Number of the former.
    field : OrientationField
        Which way is out.
    k : int
        Neighbours of a fit.

    Returns
    -------
    ndarray, (core, 3) float32
        Unit normals; zero where the neighbours stand on a line.
    """
    neighbours, _ = find_neighbours(xyz, k)
    normals = fit_normals(xyz, neighbours)
    flip, patch = agree(xyz, normals, neighbours, _PATCH_DOUBT)
    normals[flip] *= -1
    return field.orient(xyz, normals, patch)[:core]
