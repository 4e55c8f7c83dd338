"""Bounding spheres and normal cones of subtrees: built from segments, merged bottom-up, quantised conservatively.

Everything works on all nodes at once. *Segments* are the clouds of many nodes in one array: cloud i is the rows
`starts[i]` to `starts[i + 1] - 1`, never empty. `parent` numbers nodes breadth-first, -1 for the root, as in
`lpc.spacing`; a forest (several roots first) is welcome too, as long as parents come before their children.

A cone is a unit axis and a half angle: every normal is at most that far from the axis. Half angle pi means that
there is no cone: a sample has no normal, or they point everywhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .octahedral import decode_normals, encode_normals
from .page import NO_CONE

_UNITS = 65534  # of pi, in the record
_TINY = 1e-7  # rounding of float32 axes and of arccos near 0, in radians
_GROW = 1 + 1e-12  # rounding of float64 distances

F8 = NDArray[np.float64]


def segment_boxes(xyz: F8, starts: ArrayLike) -> tuple[F8, F8]:
    """Tight boxes (low, high), each (n, 3), of the samples of n clouds."""
    first = np.asarray(starts)[:-1]
    return np.minimum.reduceat(xyz, first, axis=0), np.maximum.reduceat(xyz, first, axis=0)


def merge_boxes(low: F8, high: F8, parent: NDArray[np.integer]) -> tuple[F8, F8]:
    """Boxes of whole subtrees from the boxes of the nodes' own clouds."""
    low, high = low.copy(), high.copy()
    for nodes in _levels_up(parent):
        np.minimum.at(low, parent[nodes], low[nodes])
        np.maximum.at(high, parent[nodes], high[nodes])
    return low, high


def segment_radii(xyz: F8, starts: ArrayLike, center: F8) -> F8:
    """Largest distance of each cloud's own samples to a given centre, (n,)."""
    starts = np.asarray(starts)
    apart = xyz - np.repeat(center, np.diff(starts), axis=0)
    squared = np.einsum("ij,ij->i", apart, apart)
    radius: F8 = np.sqrt(np.maximum.reduceat(squared, starts[:-1])) * _GROW
    return radius


def merge_radii(center: F8, own: F8, low: F8, high: F8, parent: NDArray[np.integer]) -> F8:
    """Radii about `center` that hold whole subtrees.

    The smaller of two bounds: half the diagonal of the subtree's box, and the largest of the node's own radius and
    its children's spheres. A builder that still has a subtree's samples together can do better with
    `segment_radii` over all of them.

    Parameters
    ----------
    center : ndarray, (n, 3)
        Centres of the subtrees' boxes.
    own : ndarray, (n,)
        Radii of the nodes' own clouds about them.
    low, high : ndarray, (n, 3)
        Boxes of the subtrees.
    parent : ndarray, (n,) int
    """
    radius = own.copy()
    corner = np.sqrt((np.maximum(high - center, center - low) ** 2).sum(axis=1)) * _GROW
    for nodes in _levels_up(parent):
        radius[nodes] = np.minimum(radius[nodes], corner[nodes])
        above = parent[nodes]
        reach = np.sqrt(((center[nodes] - center[above]) ** 2).sum(axis=1)) * _GROW + radius[nodes]
        np.maximum.at(radius, above, reach)
    return np.minimum(radius, corner)


def bounding_spheres(xyz: F8, starts: ArrayLike, parent: NDArray[np.integer]) -> tuple[F8, F8]:
    """Centre (n, 3) and radius (n,) of a sphere around each node's samples and those of all its descendants.

    The centre is that of the subtree's tight box, so it lies in the node's cell, and the order of centres along the
    Morton curve is the breadth-first order.
    """
    low, high = merge_boxes(*segment_boxes(xyz, starts), parent)
    center = low + (high - low) / 2
    return center, merge_radii(center, segment_radii(xyz, starts, center), low, high, parent)


def quantise_spheres(
    center: F8, radius: F8, origin: ArrayLike, side: float, position_error: float
) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
    """Fields `center` and `radius` of records, such that the decoded sphere holds the decoded samples too.

    Parameters
    ----------
    center, radius : ndarray, (n, 3) and (n,)
        Spheres around the input samples.
    origin, side
        The fixed-point box of the header.
    position_error : float
        How far a decoded sample may be from its input sample.
    """
    units = np.rint((center - np.asarray(origin, dtype=np.float64)) * (2.0**32 / side))
    codes = np.clip(units, 0, 2**32 - 1).astype(np.uint32)
    decoded = decode_centers(codes, origin, side)
    moved = np.sqrt(((decoded - center) ** 2).sum(axis=1))
    rounding = 4 * np.finfo(np.float64).eps * np.abs(decoded).max(axis=1, initial=0)
    grown = (radius + moved + position_error) * _GROW + rounding
    rounded = grown.astype(np.float32)
    upwards: NDArray[np.float32] = np.where(rounded < grown, np.nextafter(rounded, np.float32(np.inf)), rounded)
    return codes, upwards


def decode_centers(codes: NDArray[np.uint32], origin: ArrayLike, side: float) -> F8:
    """Centres in model units, (n, 3) float64, from the field `center` of records."""
    centers: F8 = codes.astype(np.float64) * (side * 2.0**-32) + np.asarray(origin, dtype=np.float64)
    return centers


def normal_cone(normals: NDArray[np.floating]) -> tuple[F8, float]:
    """Axis (3,) and half angle of a cone around normals (n, 3); see `normal_cones`."""
    axis, angle = normal_cones(normals, [0, len(normals)])
    return axis[0], float(angle[0])


def normal_cones(normals: NDArray[np.floating], starts: ArrayLike) -> tuple[F8, F8]:
    """Cones around the normals of n clouds: axis (n, 3) is their normalised mean, half angle (n,) the widest from it.

    A cloud with a zero normal has no cone.
    """
    starts = np.asarray(starts)
    first, counts = starts[:-1], np.diff(starts)
    wide = normals.T.astype(np.float64, order="C")  # reductions over rows of (3, m) are several times quicker
    length = np.sqrt((wide**2).sum(axis=0))
    whole = np.minimum.reduceat(length, first) > 0
    wide /= np.where(length > 0, length, 1)
    axis = np.add.reduceat(wide, first, axis=1)
    size = np.sqrt((axis**2).sum(axis=0))
    whole &= size > 1e-9 * counts
    axis = np.where(whole, axis / np.where(whole, size, 1), [[0.0], [0.0], [1.0]])
    # The chord keeps its digits for narrow cones, where arccos of the dot product loses half of them.
    wide -= np.repeat(axis, counts, axis=1)
    chord = np.sqrt(np.maximum.reduceat((wide**2).sum(axis=0), first))
    angle = 2 * np.arcsin(np.minimum(chord / 2, 1)) + _TINY
    return np.ascontiguousarray(axis.T), np.where(whole, np.minimum(angle, np.pi), np.pi)


def merge_cones(axis: F8, angle: F8, parent: NDArray[np.integer]) -> tuple[F8, F8]:
    """Cones of whole subtrees from the cones of the nodes' own clouds: no cone below, no cone above."""
    axis, angle = axis.copy(), angle.copy()
    for nodes in _levels_up(parent):
        above = parent[nodes]
        # Children of a node are neighbours of each other, so one pass takes the first and the next the second.
        second = np.concatenate([[False], above[1:] == above[:-1]])
        for turn in (nodes[~second], nodes[second]):
            up = parent[turn]
            axis[up], angle[up] = join_cones(axis[up], angle[up], axis[turn], angle[turn])
    return axis, angle


def join_cones(axis_a: F8, angle_a: F8, axis_b: F8, angle_b: F8) -> tuple[F8, F8]:
    """Smallest cones (n, 3), (n,) around pairs of cones."""
    between = 2 * np.arcsin(np.minimum(np.sqrt(((axis_a - axis_b) ** 2).sum(axis=1)) / 2, 1))
    joined = (between + angle_a + angle_b) / 2 + _TINY
    # Turn axis a towards axis b by joined - angle_a; the part of b across a gives the direction.
    across = axis_b - (axis_a * axis_b).sum(axis=1)[:, None] * axis_a
    size = np.sqrt((across**2).sum(axis=1))
    turn = (joined - angle_a)[:, None]
    axis = np.cos(turn) * axis_a + np.sin(turn) * across / np.where(size > 0, size, 1)[:, None]
    axis /= np.sqrt((axis**2).sum(axis=1))[:, None]
    a_holds = between + angle_b <= angle_a
    b_holds = between + angle_a <= angle_b
    none = ~(a_holds | b_holds) & ((joined >= np.pi) | (size < 1e-9))
    axis = np.where((a_holds | none)[:, None], axis_a, np.where(b_holds[:, None], axis_b, axis))
    angle = np.where(a_holds, angle_a, np.where(b_holds, angle_b, joined))
    return axis, np.where(none, np.pi, angle)


def quantise_cones(axis: F8, angle: F8, normal_error: float = 0.0) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Fields `cone_axis` and `cone_angle` of records, such that the decoded cone holds the decoded normals too.

    Parameters
    ----------
    axis, angle : ndarray, (n, 3) and (n,)
        Cones around the input normals.
    normal_error : float
        How far a decoded normal may be from its input normal, radians (`octahedral.max_error_degrees`).
    """
    codes = encode_normals(axis.astype(np.float32), bits=8)
    decoded = decode_normals(codes, bits=8).astype(np.float64)
    moved = 2 * np.arcsin(np.minimum(np.sqrt(((decoded - axis) ** 2).sum(axis=1)) / 2, 1))
    units = np.ceil((angle + moved + normal_error + _TINY) * (_UNITS / np.pi))
    none = (angle >= np.pi) | (units > _UNITS)
    fields = np.where(none, NO_CONE, units).astype(np.uint16)
    return np.where(none[:, None], 0, codes).astype(np.uint8), fields


def decode_cones(
    codes: NDArray[np.uint8], units: NDArray[np.uint16]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Axis (n, 3) and half angle (n,) from the fields `cone_axis` and `cone_angle` of records; pi: no cone."""
    angle = np.where(units == NO_CONE, np.pi, units * (np.pi / _UNITS)).astype(np.float32)
    return decode_normals(codes, bits=8).astype(np.float32), angle


def backfacing(center: F8, radius: ArrayLike, axis: ArrayLike, angle: ArrayLike, eye: ArrayLike) -> NDArray[np.bool_]:
    """Whether every sample in a sphere with a normal in a cone faces away from the eye (LPC 4).

    Proof. Sample p with normal n faces away when dot(n, e - p) < 0. With d = e - c, the largest value over the
    sphere is dot(n, d) + radius, as n has length 1; over the cone, dot(n, d) is at most |d| cos(max(0, phi - angle))
    with phi the angle between axis and d. All face away exactly when |d| cos(phi - angle) < -radius and
    phi > angle. As cos is below 0 only beyond pi / 2, no cone of pi / 2 or wider ever passes.

    Parameters
    ----------
    center, radius : ndarray, (n, 3) and (n,)
        Spheres, in the same frame as `eye`.
    axis, angle : ndarray, (n, 3) and (n,)
        Cones; half angle pi: none.
    eye : array_like, (3,)

    Returns
    -------
    ndarray, (n,) bool
    """
    angle = np.asarray(angle, dtype=np.float64)
    towards = np.asarray(eye, dtype=np.float64) - center
    distance = np.sqrt(np.einsum("ij,ij->i", towards, towards))
    along = np.einsum("ij,ij->i", np.asarray(axis, dtype=np.float64), towards)
    across = np.sqrt(np.maximum(distance**2 - along**2, 0))
    # |d| cos(phi - angle), where phi > pi / 2 (along < 0) and angle < pi / 2 make phi > angle.
    highest = along * np.cos(angle) + across * np.sin(angle)
    return (angle < np.pi / 2) & (along < 0) & (highest < -np.asarray(radius) - _TINY * distance)


def _levels_up(parent: NDArray[np.integer]) -> list[NDArray[np.int64]]:
    """Nodes of each level but the first, deepest level first."""
    numbers = np.arange(len(parent))
    if (parent >= numbers).any():
        raise ValueError("a child comes before its parent")
    depth = np.zeros(len(parent), dtype=np.int64)
    nodes = numbers[parent >= 0]
    above = parent[nodes]
    while len(nodes):  # one step up a turn: every node counts its ancestors
        depth[nodes] += 1
        up = parent[above] >= 0
        nodes, above = nodes[up], parent[above[up]]
    order = np.argsort(depth, kind="stable")
    cuts = np.searchsorted(depth[order], np.arange(1, depth.max(initial=0) + 1))
    return np.split(order, cuts)[:0:-1]
