"""Clouds to frames, and the spheres and cones that hold what a reader will decode.

Boxes and sums of normals of whole subtrees are known before, so every node has its centre and axis. Each cloud is
then compared once with all its ancestors: radii and half angles are exact for the samples as they are decoded,
and a maximum does not depend on who comes first.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from lpc.bounds import decode_centers, quantise_cones, quantise_spheres
from lpc.codec import CloudWriter, Effort
from lpc.context import ANCESTORS, line_of, takes_context, with_ancestors
from lpc.octahedral import decode_normals, encode_normals
from lpc.octahedral_compiled import unit_vectors
from lpc.page import RECORD

from .ancestry import Ancestor, Ancestry
from .extend import OWNER
from .rows import copy_places

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from lpc.attributes import Schema
    from lpc.cloud import Cloud
    from lpc.payload import Placed

    from .assemble import Nodes
    from .extend import OldClouds
    from .frame import Frame
    from .rows import Rows


RUN_SAMPLES = 1 << 16
"""Encoded at a time by one thread, ancestors included."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """What all clouds of a model share, and the centre and axis of each node.

    Parameters
    ----------
    origin : ndarray, (3,) float64
    step, side : float
        Of the lattice, and of the fixed-point box of centres.
    center : ndarray, (n, 3) float64
        As it is decoded.
    axis : ndarray, (n, 3) float32
        As it is decoded; zero: no cone.
    """

    origin: NDArray[np.float64]
    step: float
    side: float
    center: NDArray[np.float64]
    axis: NDArray[np.float32]

    @classmethod
    def of(cls, nodes: Nodes, frame: Frame) -> Geometry:
        """Choose centres and axes."""
        origin, step = frame.origin, frame.step
        top = np.maximum(frame.high, nodes.box[0, 3:] * step + origin)
        side = float((top - origin).max()) * (1 + 2.0**-20) or 1.0
        center = (nodes.box[:, :3] + nodes.box[:, 3:]) * (step / 2) + origin
        codes = np.clip(np.rint((center - origin) * (2.0**32 / side)), 0, 2**32 - 1).astype(np.uint32)
        length = np.sqrt((nodes.normals.astype(np.float64) ** 2).sum(axis=1))
        whole = (nodes.bare == 0) & (length > 0)
        mean = nodes.normals / np.where(whole, length, 1)[:, None]
        axis = decode_normals(encode_normals(np.where(whole[:, None], mean, 0.0)))
        return cls(origin, step, side, decode_centers(codes, origin, side), axis)


@dataclass(frozen=True, slots=True)
class Run:
    """Frames of consecutive nodes from `first` on, their sizes and checksums; a recalled run has no frames.

    `reach` and `spread` (k, levels): the largest squared distance of a cloud's samples to the centre of its ancestor
    at each level, itself included, and of its normals to the ancestor's axis. `kept`: clouds of an older model.
    """

    first: int
    frames: list[bytes]
    sizes: NDArray[np.uint32]
    checks: NDArray[np.uint32]
    reach: NDArray[np.float64]
    spread: NDArray[np.float64]
    kept: int = 0


def encode_run(
    first: int,
    stop: int,
    *,
    nodes: Nodes,
    geometry: Geometry,
    regions: Rows,
    schema: Schema,
    effort: Effort,
    ancestry: Ancestry,
    old: OldClouds | None = None,
) -> Run:
    """Encode nodes `first` to `stop - 1`, but for those that are clouds of an older model."""
    generations = ANCESTORS if takes_context(schema, effort) else 0
    family = with_ancestors(np.arange(first, stop), nodes.parent, generations)
    known = ancestry.find(family[family < first].tolist())
    family = family[[node not in known for node in family.tolist()]]
    bounds = np.concatenate([[0], np.cumsum(nodes.samples[family])])
    lattice, owner, codes = _read(family, bounds, nodes, regions, schema)
    writer = CloudWriter(lattice, codes, bounds, schema, effort=effort)
    found = np.full(len(family), -1) if old is None else old.find(owner, bounds)
    clouds = _Clouds(writer, dict(zip(family.tolist(), found.tolist(), strict=True)), known)
    frames, kept = [], 0
    for node in range(first, stop):
        line = line_of(node, nodes.parent) if generations else []
        if old and old.stays(clouds.old(node), [clouds.old(above) for above in line]):
            frames.append(old.frame(clouds.old(node)))
            kept += 1
            continue
        frames.append(writer.frame(clouds.placed(node), [clouds.cloud(above) for above in line]))
        if generations and nodes.subtree[node] > nodes.samples[node]:
            clouds.cloud(node)
    ancestry.keep(clouds.made, nodes.depth, int(nodes.depth[first]))
    before = len(family) - (stop - first)
    own = int(bounds[before])
    lattice, bounds = lattice[own:], bounds[before:] - own
    shape = (stop - first, int(nodes.depth[first:stop].max()) + 1)
    reach, spread = np.zeros(shape), np.zeros(shape)
    _reach(lattice, bounds, first, nodes.parent, nodes.depth, geometry.origin, geometry.step, geometry.center, reach)
    for attribute in schema:
        if attribute.kind == "normal":
            normals = unit_vectors(codes[attribute.name][own:], attribute.bits)
            _spread(normals, bounds, first, nodes.parent, nodes.depth, geometry.axis, spread)
    sizes = np.array([len(frame) for frame in frames], np.uint32)
    return Run(first, frames, sizes, np.array([zlib.crc32(frame) for frame in frames], np.uint32), reach, spread, kept)


class _Clouds:
    """The clouds of a run, and those of their ancestors.

    Parameters
    ----------
    writer : CloudWriter
    found : dict of int to int
        By node what the writer has, in its order: the cloud of an older model that it is, or -1.
    known : mapping of int to Ancestor
        All other ancestors.
    """

    def __init__(self, writer: CloudWriter, found: dict[int, int], known: Mapping[int, Ancestor]) -> None:
        self._writer, self._found, self._known = writer, found, known
        self._number = {node: number for number, node in enumerate(found)}
        self._placed: dict[int, Placed] = {}
        self._clouds = {node: ancestor.cloud for node, ancestor in known.items()}

    def old(self, node: int) -> int:
        """Cloud of the older model that has the samples of a node, and no others; -1: none."""
        return self._found[node] if node in self._found else self._known[node].old

    def placed(self, node: int) -> Placed:
        """Put the samples of a node that the writer has in order, once."""
        if node not in self._placed:
            self._placed[node] = self._writer.place(self._number[node])
        return self._placed[node]

    @property
    def made(self) -> dict[int, Ancestor]:
        """All of these whose clouds were asked for."""
        return {node: Ancestor(cloud, self.old(node)) for node, cloud in self._clouds.items()}

    def cloud(self, node: int) -> Cloud:
        """Cloud of a node, as it will be decoded."""
        if node not in self._clouds:
            self._clouds[node] = self._writer.cloud(self.placed(node))
        return self._clouds[node]


def _read(
    family: NDArray[np.int64], bounds: NDArray[np.int64], nodes: Nodes, regions: Rows, schema: Schema
) -> tuple[NDArray[np.int64], NDArray[np.uint32], dict[str, NDArray[Any]]]:
    """Lattice points, owners and codes of the samples of some nodes; whole rows are here for one run of them only."""
    names = [attribute.name for attribute in schema]
    columns = {name: np.empty((bounds[-1], *regions.dtype[name].shape), regions.dtype[name].base) for name in names}
    lattice = np.empty((bounds[-1], 3), np.int64)
    owner = np.zeros(bounds[-1], np.uint32)
    known = OWNER in (regions.dtype.names or ())
    at = 0
    for node in family.tolist():
        for run in range(nodes.run_start[node], nodes.run_start[node + 1]):
            rows = np.empty(int(nodes.run_count[run]), regions.dtype)
            regions.read(int(nodes.run_first[run]), rows)
            to = slice(at, at + len(rows))
            copy_places(rows["xyz"], lattice[to])
            if known:
                owner[to] = rows[OWNER]
            for name in names:
                columns[name][to] = rows[name]
            at = to.stop
    return lattice, owner, columns


def kernels_are_loaded() -> bool:
    """Whether this process has encoded a model with normals before."""
    return bool(_spread.signatures)


class Records:
    """The index records, as far as runs have come in."""

    def __init__(self, nodes: Nodes, geometry: Geometry, spacing: NDArray[np.float32]) -> None:
        self.nodes, self.geometry = nodes, geometry
        self.records = np.zeros(len(nodes), RECORD)
        self.records["spacing"] = spacing
        self.records["samples"] = nodes.samples
        self.records["subtree"] = nodes.subtree
        inner = nodes.parent >= 0
        np.add.at(self.records["children"], nodes.parent[inner], (1 << nodes.half[inner]).astype(np.uint8))
        self._reach = np.zeros(len(nodes))
        self._spread = np.zeros(len(nodes))

    def add(self, run: Run) -> None:
        """Take in sizes and checksums, and what ancestors must hold."""
        stop = run.first + len(run.sizes)
        self.records["size"][run.first : stop] = run.sizes
        self.records["crc"][run.first : stop] = run.checks
        _raise(run.reach, run.first, self.nodes.parent, self.nodes.depth, self._reach)
        _raise(run.spread, run.first, self.nodes.parent, self.nodes.depth, self._spread)

    def finish(self) -> NDArray[Any]:
        """All records, spheres and cones included."""
        geometry = self.geometry
        self.records["center"], self.records["radius"] = quantise_spheres(
            geometry.center, np.sqrt(self._reach), geometry.origin, geometry.side, 0.0
        )
        axis = geometry.axis.astype(np.float64)
        angle = 2 * np.arcsin(np.minimum(np.sqrt(self._spread) / 2, 1))
        # Wider than a half space never culls (`lpc.bounds.backfacing`), and chords measure badly there.
        angle[~axis.any(axis=1) | (angle > np.pi / 2)] = np.pi
        axis[~axis.any(axis=1)] = (0, 0, 1)
        self.records["cone_axis"], self.records["cone_angle"] = quantise_cones(axis, angle)
        return self.records


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def _reach(
    lattice: Any, bounds: Any, first: int, parent: Any, depth: Any, origin: Any, step: float, center: Any, out: Any
) -> None:
    for cloud in range(len(bounds) - 1):
        begin, end = bounds[cloud], bounds[cloud + 1]
        x, y, z = np.empty(end - begin), np.empty(end - begin), np.empty(end - begin)
        for i in range(end - begin):
            x[i] = lattice[begin + i, 0] * step + origin[0]
            y[i] = lattice[begin + i, 1] * step + origin[1]
            z[i] = lattice[begin + i, 2] * step + origin[2]
        node = first + cloud
        while node >= 0:
            px, py, pz = center[node]
            largest = 0.0
            for i in range(len(x)):
                dx, dy, dz = x[i] - px, y[i] - py, z[i] - pz
                largest = max(largest, dx * dx + dy * dy + dz * dz)
            out[cloud, depth[node]] = largest
            node = parent[node]


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def _spread(normals: Any, bounds: Any, first: int, parent: Any, depth: Any, axis: Any, out: Any) -> None:
    for cloud in range(len(bounds) - 1):
        begin, end = bounds[cloud], bounds[cloud + 1]
        x, y, z = np.empty(end - begin), np.empty(end - begin), np.empty(end - begin)
        for i in range(end - begin):
            x[i], y[i], z[i] = normals[begin + i, 0], normals[begin + i, 1], normals[begin + i, 2]
        node = first + cloud
        while node >= 0:
            px, py, pz = float(axis[node, 0]), float(axis[node, 1]), float(axis[node, 2])
            largest = 0.0
            for i in range(len(x)):
                dx, dy, dz = x[i] - px, y[i] - py, z[i] - pz
                largest = max(largest, dx * dx + dy * dy + dz * dz)
            out[cloud, depth[node]] = largest
            node = parent[node]


@njit(cache=True, nogil=True)
def _raise(found: Any, first: int, parent: Any, depth: Any, largest: Any) -> None:
    for cloud in range(len(found)):
        node = first + cloud
        while node >= 0:
            largest[node] = max(largest[node], found[cloud, depth[node]])
            node = parent[node]
