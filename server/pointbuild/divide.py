"""The partition of LPC 5, out of core: spool in, nodes and rows sorted by node out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .areas import Probing
from .assemble import Nodes, assemble
from .bucket import BucketTree, normal_table, partition
from .plan import Plan, make_plan
from .rows import row_dtype
from .scatter import Candidates, Regions, scatter
from .spacing import model_spacing
from .survey import NORMAL_BITS
from .upper import Upper, candidate_limits, thresholds

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lpc.attributes import Schema

    from .cells import Cells
    from .progress import Progress
    from .spool import Spool
    from .work import Crew

SLACK = 8.0
"""Standard deviations that candidates of the upper tree may be off; a shortfall repeats the scatter with more."""


@dataclass(frozen=True, slots=True)
class Division:
    """The tree, and r of the whole model (model units)."""

    nodes: Nodes
    spacing: float


def divide(
    spool: Spool,
    cells: Cells,
    regions: Regions,
    schema: Schema,
    *,
    cloud_size: int,
    seed: int,
    bucket_samples: int,
    crew: Crew,
    progress: Progress,
    slack: float = SLACK,
) -> Division:
    """Distribute the spooled samples over nodes.

    Parameters
    ----------
    spool, cells
        The samples, and how their box is divided.
    regions : Regions
        Gets the rows, in the end sorted by node.
    schema : Schema
        The attributes that rows carry.
    cloud_size, seed : int
        M, and what the priorities hash.
    bucket_samples : int
        Samples sorted in memory at a time; more where a region of `areas` asks for it.
    crew, progress
        Threads, and who is told.
    slack : float
        See `SLACK`.
    """
    probing = Probing.of(spool.samples, cloud_size)
    most = max(bucket_samples, probing.region)
    plan = _count(spool, cells, most, crew, progress)
    upper = None
    while upper is None:
        limits = candidate_limits(plan, cloud_size, slack)
        candidates = _scatter(spool, cells, plan, limits, seed, schema, regions, crew, progress)
        upper = thresholds(plan, candidates, limits, cloud_size)
        slack *= 4
    trees = _partition(plan, upper, cells, probing, cloud_size, schema, regions, crew, progress)
    spacing = model_spacing(
        np.concatenate([tree.spacing for tree in trees]), np.concatenate([tree.weight for tree in trees])
    )
    return Division(assemble(plan, upper, trees), spacing)


def _count(spool: Spool, cells: Cells, most: int, crew: Crew, progress: Progress) -> Plan:
    if spool.samples > most:
        progress.stage("count", spool.samples)

    def positions(number: int) -> NDArray[np.float64]:
        return spool.read(spool.blocks[number], ("xyz",))["xyz"]

    return make_plan(cells, spool.samples, most, positions, len(spool.blocks), crew, progress)


def _scatter(
    spool: Spool,
    cells: Cells,
    plan: Plan,
    limits: NDArray[np.uint64],
    seed: int,
    schema: Schema,
    regions: Regions,
    crew: Crew,
    progress: Progress,
) -> Candidates:
    progress.stage("scatter", spool.samples)
    regions.lay_out(row_dtype(schema), [bucket.count for bucket in plan.buckets])

    def one(number: int) -> Candidates:
        return scatter(spool.blocks[number], spool, cells, plan, limits, seed, schema, regions)

    found = []
    for number, candidates in crew.map(one, range(len(spool.blocks))):
        found.append(candidates)
        progress.advance(spool.blocks[number].samples)
    return Candidates(
        np.concatenate([part.priority for part in found]), np.concatenate([part.bucket for part in found])
    )


def _partition(
    plan: Plan,
    upper: Upper,
    cells: Cells,
    probing: Probing,
    cloud_size: int,
    schema: Schema,
    regions: Regions,
    crew: Crew,
    progress: Progress,
) -> list[BucketTree]:
    progress.stage("partition", int(regions.first[-1]))
    has_normals = any(attribute.name == "normal" for attribute in schema)
    table = normal_table(NORMAL_BITS) if has_normals else None

    def one(number: int) -> BucketTree:
        above = upper.above(number)
        return partition(
            int(regions.first[number]),
            plan.buckets[number],
            above,
            [upper.nodes[node].threshold for node in above],
            cells=cells,
            probing=probing,
            cloud_size=cloud_size,
            regions=regions,
            normals=table,
        )

    trees = []
    for number, tree in crew.map(one, range(len(plan.buckets))):
        trees.append(tree)
        progress.advance(plan.buckets[number].count)
    return trees
