"""From an index tree, a camera and what is resident to what to draw and what to ask for (LPC section 4).

A *cut* is the set of nodes to draw: closed under parents, because a node's cloud only adds to those of its ancestors.
The traversal is LPC's, coarse to fine and stateless, but takes a level of the tree at a time: a level's frontier is an
array of node numbers and every test below is one numpy expression over it.

1. A node outside the frustum, whose normals all point away from the eye, or that was found hidden behind others
   (`occlusion`), is dropped with its branch.
2. Its *projected spacing* is the apparent size, in pixels, of a sphere of diameter r_j at the point of its bounding
   sphere nearest to the eye; infinite where the eye is inside. Below the tolerance the node is fine enough.
3. Otherwise its children refine it: one whose record is unknown makes its page wanted; one that is not resident is
   wanted itself; one that is resident is visited. A node with a visible child that cannot be drawn yet is *starved*.
4. Splats show the spacing of the deepest drawn node at their place (`places`), or less where that does (`snug`): no
   holes where data is missing, and no fat beside it. LPC's plain rule, one size a cloud, is there for comparison.

Nothing here does I/O or reads a clock; equal arguments give equal cuts.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from .places import Places, places
from .snug import snug
from .splats import CLOSING, LARGEST
from .uneven import look_below
from .urgency import removed_per_byte

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lpc.index import IndexTree

    from .camera import Camera

Nodes = NDArray[np.int64]
Priority = Literal["index", "error"]
SplatRule = Literal["place", "paper"]
Value = TypeVar("Value", bound=np.generic)

FEW = 64
"""Wants that may not fill a round trip: up to here what follows them is looked for."""

LEVELS_AHEAD = 3
"""Levels below the wants that are looked at."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Culled:
    """Branches dropped by the traversal, by reason."""

    frustum: int = 0
    backface: int = 0
    occluded: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Cut:
    """What one frame draws and what it misses.

    Parameters
    ----------
    nodes : (n,) int64
        Nodes to draw, ascending: coarse to fine, and near in space when near in the array.
    spacing : (n,) float32
        Largest spacing that splats of the node must close, model units.
    splat_px : (n,) float32
        Side of a splat at the point of the node's sphere nearest to the eye, pixels; samples further away get less.
    starved : (n,) bool
        Nodes drawn grown because a visible child is missing.
    wants : (m,) int64
        Nodes that would refine the picture, most urgent first; those that are not known yet stand for their page.
    ahead : (k,) int64
        Nodes that will be wanted once `wants` are here, nearest levels first: they keep the link busy for a round trip
        in which nothing else is wanted. Empty where the wants alone do that.
    pages : (p,) int64
        Pages of the wants that are not known yet, most urgent first.
    culled : Culled
    splats : int
        Samples in the clouds of `nodes`.
    max_spacing_px : float
        Largest projected spacing of a node that is not refined, pixels, at most the larger side of the picture: how
        coarse the picture is at its worst place. 0 for an empty cut.
    places : Places or None
        Spacing at each place; None: all splats of a node close its `spacing`.
    depth_range : (near, far)
        Depths between which all samples in front of the eye lie, 0 < near < far; far follows from the nodes, near is at
        least a millionth of it.
    """

    nodes: Nodes
    spacing: NDArray[np.float32]
    splat_px: NDArray[np.float32]
    starved: NDArray[np.bool_]
    wants: Nodes
    pages: Nodes
    culled: Culled
    splats: int
    max_spacing_px: float
    places: Places | None
    depth_range: tuple[float, float]
    ahead: Nodes = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    @property
    def asks(self) -> Nodes:
        """What to ask the access layer for: the wants, then what follows them."""
        return np.concatenate([self.wants, self.ahead])


@dataclass(frozen=True, slots=True)
class _Level:
    """The drawn nodes of one level, and what became of their children."""

    nodes: Nodes
    spacing_px: NDArray[np.float64]
    children: Nodes  # (n, 2); -1 where there is none or the node is fine enough
    drawn: NDArray[np.bool_]  # (n, 2)
    missing: NDArray[np.bool_]  # (n, 2): visible or unknown, and not resident
    child_spacing_px: NDArray[np.float64]  # (n, 2); NaN where unknown


@dataclass(slots=True)
class _Sieve:
    """Culling and projected spacing for one camera; counts what it drops."""

    index: IndexTree
    camera: Camera
    cull_backfaces: bool
    hidden: NDArray[np.bool_] | None = None
    frustum: int = 0
    backface: int = 0
    occluded: int = 0
    eye: NDArray[np.float64] = field(init=False)
    planes: NDArray[np.float64] = field(init=False)
    focal: float = field(init=False)

    def __post_init__(self) -> None:
        camera = self.camera  # once, and not for every level
        self.eye, self.planes, self.focal = np.array(camera.eye), camera.frustum_planes(), camera.focal

    def look(self, nodes: Nodes) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Return which nodes are visible, and the projected spacing of all, pixels."""
        index = self.index
        radius = index.radius[nodes]
        offset = index.center[nodes] - self.eye
        visible = (self.planes @ offset.T).min(axis=0) >= -radius
        self.frustum += len(nodes) - int(np.count_nonzero(visible))
        distance = np.sqrt(np.einsum("ij,ij->i", offset, offset))
        gap = distance - radius
        outside = gap > 0
        if self.cull_backfaces:
            # Every sample is seen within asin(radius / distance) of the centre's direction and has its normal within
            # the cone's half angle of the axis: all point away if the three angles together stay below a right angle.
            along = np.einsum("ij,ij->i", index.cone_axis[nodes], offset)
            away = visible & outside & (along > 0)
            some = np.flatnonzero(away)
            spread = index.cone_angle[nodes[some]] + np.arcsin(radius[some] / distance[some])
            away[some] = (spread < np.pi / 2) & (along[some] > distance[some] * np.sin(spread))
            self.backface += int(np.count_nonzero(away))
            visible &= ~away
        visible &= self.uncovered(nodes, visible)
        spacing_px = np.full(len(nodes), np.inf)
        np.divide(index.density.coarseness[nodes] * self.focal, gap, out=spacing_px, where=outside)
        return visible, spacing_px

    def uncovered(self, nodes: Nodes, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which nodes were not found hidden, and count those of `among` that were."""
        if self.hidden is None:
            return np.ones(nodes.shape, dtype=bool)
        hidden = self.hidden[nodes]
        self.occluded += int(np.count_nonzero(hidden & among))
        return ~hidden


def _descend(sieve: _Sieve, tolerance: float, resident: NDArray[np.bool_]) -> Iterator[_Level]:
    """Traverse the resident part of the tree, a level at a time."""
    index = sieve.index
    nodes = np.zeros(1, dtype=np.int64)
    visible, spacing_px = sieve.look(nodes)
    nodes, spacing_px = nodes[visible], spacing_px[visible]
    while len(nodes):
        children = index.children[nodes].astype(np.int64)
        children[spacing_px < tolerance] = -1
        exists = children >= 0
        below = children[exists]
        known = index.known[below]
        visible, missing = np.zeros(len(below), dtype=bool), ~known
        child_spacing_px = np.full(len(below), np.nan)
        visible[known], child_spacing_px[known] = sieve.look(below[known])
        missing &= sieve.uncovered(below, missing)
        here = visible & resident[below]
        missing |= visible & ~here
        yield _Level(
            nodes,
            spacing_px,
            children,
            _spread(here, exists, False),
            _spread(missing, exists, False),
            _spread(child_spacing_px, exists, np.nan),
        )
        nodes, spacing_px = below[here], child_spacing_px[here]


def _spread(values: NDArray[Value], where: NDArray[np.bool_], otherwise: float) -> NDArray[Value]:
    """Put values to where they belong in an array."""
    spread = np.full(where.shape, otherwise, dtype=values.dtype)
    spread[where] = values
    return spread


def refine(
    index: IndexTree,
    camera: Camera,
    tolerance: float,
    resident: NDArray[np.bool_],
    *,
    priority: Priority = "index",
    cull_backfaces: bool = True,
    splat_rule: SplatRule = "place",
    hidden: NDArray[np.bool_] | None = None,
    contrast: NDArray[np.float64] | None = None,
) -> Cut:
    """Compute the cut of one frame.

    Parameters
    ----------
    tolerance : float
        Projected spacing at which refinement stops, pixels, > 0.
    resident : (n_nodes,) bool
        Nodes whose clouds can be drawn now.
    priority : {"index", "error"}
        Order of `Cut.wants`: by node number (LPC 4: coarse first, then neighbours), or by the screen error that a byte
        removes.
    cull_backfaces : bool
        False where the normals cannot be trusted to point outward.
    splat_rule : {"place", "paper"}
        What a splat's size follows: the deepest drawn node at its place, or, as in LPC 4, the cloud: the spacing of its
        node where that is starved or fine enough, the tolerance where it is refined.
    hidden : (n_nodes,) bool, optional
        Nodes that `occlusion` found to be behind others: neither drawn nor refined nor wanted.
    contrast : (n_nodes,) float64, optional
        What the last picture shows in the nodes' cells (`urgency.Contrast`), from which that error is estimated.

    Notes
    -----
    Cost is proportional to the visited nodes: the cut and the children of its refined nodes.
    """
    if not index.known[0]:
        return _empty(wants=[0], pages=[0], culled=Culled())
    sieve = _Sieve(index, camera, cull_backfaces, hidden)
    if not resident[0]:
        visible, _ = sieve.look(np.zeros(1, dtype=np.int64))
        return _empty(wants=[0] if visible[0] else [], pages=[], culled=_culled(sieve))
    levels = list(_descend(sieve, tolerance, resident))
    if not levels:
        return _empty(wants=[], pages=[], culled=_culled(sieve))

    nodes = np.concatenate([level.nodes for level in levels])
    spacing_px = np.concatenate([level.spacing_px for level in levels])
    drawn, missing = (
        np.concatenate(parts) for parts in zip(*((level.drawn, level.missing) for level in levels), strict=True)
    )
    starts = [0, *accumulate(len(level.nodes) for level in levels)]
    own, coarseness = index.spacing[nodes], index.density.coarseness[nodes]
    starved = _either(missing)
    fine = ~_either(np.concatenate([level.children for level in levels]) >= 0)
    ends = starved | fine
    if splat_rule == "paper":
        spacing = np.where(ends, own, np.minimum(coarseness * (tolerance / spacing_px), own))
        laid_out = None
    else:
        own = own * snug(index, nodes, spacing_px)
        below = look_below(index, camera, nodes, drawn, missing)
        spacing = _shown_spacing(starts, drawn, np.where(ends, own, 0.0), below.spacing[: len(nodes)])
        alone = np.sqrt(index.density.own[nodes])
        laid_out = places(index.header, starts, drawn, missing, own, spacing, below, alone)
    # A splat at the nearest point of the sphere; without bound but the largest where the eye is inside it.
    splat_px = np.ones(len(nodes))
    grown = spacing > 0
    splat_px[grown] = CLOSING * spacing_px[grown] * (spacing[grown] / coarseness[grown])
    wants, pages = _missing(index, camera, tolerance, levels, priority, contrast)
    ahead = _ahead(replace(sieve), tolerance, levels, resident) if 0 < len(wants) <= FEW else wants[:0]
    return Cut(
        nodes=nodes,
        spacing=spacing.astype(np.float32),
        splat_px=np.clip(splat_px, 1.0, LARGEST).astype(np.float32),
        starved=starved,
        wants=wants,
        pages=pages,
        culled=_culled(sieve),
        splats=int(index.samples[nodes].sum()),
        max_spacing_px=min(float(np.max(spacing_px[ends], initial=0.0)), float(max(camera.width, camera.height))),
        places=laid_out,
        depth_range=camera.depth_range(index.center[nodes], index.radius[nodes]),
        ahead=ahead,
    )


def _shown_spacing(
    starts: list[int], drawn: NDArray[np.bool_], own: NDArray[np.float64], ends: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Largest spacing of the drawn regions around each node's samples, bottom up, model units.

    Parameters
    ----------
    own : (n,) float64
        Spacing of the nodes that regions end at. 0 for refined ones: with all children culled, such a node keeps stray
        samples at the rim, and these get the smallest splat.
    ends : (n, 2) float64
        What the index says of the halves without a drawn node (`Below.spacing`): parts of an uneven cell are coarser
        than the whole, drawn or not.
    """
    thin = np.abs(ends)
    shown = np.fmax(own, np.fmax(thin[:, 0], thin[:, 1]))
    parent = np.nonzero(drawn)[0]
    for start, stop in zip(starts[-2:0:-1], starts[:1:-1], strict=True):
        np.maximum.at(shown, parent[start - 1 : stop - 1], shown[start:stop])
    return shown


def _either(halves: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which rows of an (n, 2) array hold anything; `any` takes ten times as long along so short an axis."""
    return halves[:, 0] | halves[:, 1]


def _missing(
    index: IndexTree,
    camera: Camera,
    tolerance: float,
    levels: list[_Level],
    priority: Priority,
    contrast: NDArray[np.float64] | None,
) -> tuple[Nodes, Nodes]:
    """Wanted nodes and wanted pages, most urgent first."""
    nodes = np.concatenate([level.children[level.missing] for level in levels])
    if len(nodes) == 0:
        return nodes, nodes
    if priority == "error":
        nodes = nodes[np.lexsort((nodes, -removed_per_byte(index, camera, tolerance, nodes, contrast)))]
    pages = nodes[~index.known[nodes]] // index.header.page_nodes
    _, first = np.unique(pages, return_index=True)
    return nodes, pages[np.sort(first)]


def _ahead(sieve: _Sieve, tolerance: float, levels: list[_Level], resident: NDArray[np.bool_]) -> Nodes:
    """Nodes below the missing ones that the view will refine to, as far as the index is known.

    Found by the tests of `_descend`, so nothing is asked for that the finished cut would not draw. `sieve` is a copy:
    what it drops here is not counted.
    """
    index = sieve.index
    nodes = np.concatenate([level.children[level.missing] for level in levels])
    spacing_px = np.concatenate([level.child_spacing_px[level.missing] for level in levels])
    found: list[Nodes] = []
    for _ in range(LEVELS_AHEAD):
        children = index.children[nodes[index.known[nodes] & (spacing_px >= tolerance)]].astype(np.int64).ravel()
        children = np.sort(children[children >= 0])
        known = index.known[children]
        visible, child_spacing_px = sieve.look(children[known])
        unknown = children[~known]
        unknown = unknown[sieve.uncovered(unknown, np.ones(len(unknown), dtype=bool))]
        nodes, spacing_px = children[known][visible], child_spacing_px[visible]
        found.append(np.sort(np.concatenate([nodes[~resident[nodes]], unknown])))
    return np.concatenate(found)


def _culled(sieve: _Sieve) -> Culled:
    return Culled(frustum=sieve.frustum, backface=sieve.backface, occluded=sieve.occluded)


def _empty(*, wants: list[int], pages: list[int], culled: Culled) -> Cut:
    return Cut(
        nodes=np.empty(0, dtype=np.int64),
        spacing=np.empty(0, dtype=np.float32),
        splat_px=np.empty(0, dtype=np.float32),
        starved=np.empty(0, dtype=bool),
        wants=np.array(wants, dtype=np.int64),
        pages=np.array(pages, dtype=np.int64),
        culled=culled,
        splats=0,
        max_spacing_px=0.0,
        places=None,
        depth_range=(1.0, 2.0),
    )
