"""Normals fitted to the neighbours of each sample, of either sign, and patches of samples whose signs agree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .kernels import fit_planes, join, rate_edges

NEIGHBOURS = 16
_JOINED = 8  # nearest of them along which signs travel
_SLICE = 1 << 16  # samples whose neighbours are searched at a time: bounds the memory of the distances


def find_neighbours(xyz: NDArray[np.float64], k: int = NEIGHBOURS) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Find the k nearest samples of every sample, itself among them.

    Parameters
    ----------
    xyz : ndarray, (n, 3) float64
        At least one sample.
    k : int
        Fewer when there are not as many samples.

    Returns
    -------
    neighbours : ndarray, (n, k) int32
        Indices, nearest first.
    reach : ndarray, (n,) float64
        Distance to the farthest of them.
    """
    k = min(k, len(xyz))
    tree = cKDTree(xyz)
    neighbours = np.empty((len(xyz), k), np.int32)
    reach = np.empty(len(xyz))
    for start in range(0, len(xyz), _SLICE):
        part = slice(start, start + _SLICE)
        distances, indices = tree.query(xyz[part], np.arange(1, k + 1))
        neighbours[part] = indices
        reach[part] = distances[:, -1]
    return neighbours, reach


def fit_normals(xyz: NDArray[np.float64], neighbours: NDArray[np.int32]) -> NDArray[np.float32]:
    """Fit a plane to the neighbours of every sample (Hoppe et al. 1992, section 3.2).

    Returns
    -------
    ndarray, (n, 3) float32
        Unit normals of either sign; zero where the neighbours stand on a line.
    """
    normals = np.empty((len(neighbours), 3), np.float32)
    fit_planes(xyz, neighbours, normals)
    return normals


def agree(
    xyz: NDArray[np.float64], normals: NDArray[np.float32], neighbours: NDArray[np.int32], most_doubt: float = 1.0
) -> tuple[NDArray[np.bool_], NDArray[np.int32]]:
    """Make signs agree along a minimum spanning forest of the neighbour graph (Hoppe et al. 1992, section 3.3).

    Parameters
    ----------
    xyz, normals : ndarray, (n, 3)
        Samples and their normals of either sign.
    neighbours : ndarray, (n, k) int32
        Nearest first.
    most_doubt : float
        Edges more doubtful than this (0 to 1, see `kernels.rate_edges`) join nothing.

    Returns
    -------
    flip : ndarray, (n,) bool
        Normals to turn, so that those of a patch agree.
    patch : ndarray, (n,) int32
        Number of each sample's patch: an index of one of its samples.
    """
    near = np.ascontiguousarray(neighbours[:, 1 : _JOINED + 1])
    doubt, turned = np.empty(near.shape, np.uint16), np.empty(near.shape, bool)
    rate_edges(xyz, normals, near, doubt, turned)
    # A stable sort of 16-bit keys is a radix sort, and the same on every machine.
    order = np.argsort(doubt.ravel(), kind="stable")
    limit = np.uint16(min(65535, round(most_doubt * 65535)))
    order = order[: np.searchsorted(doubt.ravel()[order], limit, side="left")]
    patch, flip = np.arange(len(xyz), dtype=np.int32), np.zeros(len(xyz), bool)
    join(order, near, turned, patch, flip)
    return flip, patch
