"""The partition of LPC 5, out of core: spool in, nodes and rows sorted by node out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from .areas import Probing
from .assemble import Nodes, assemble
from .bucket import BucketTree, partition
from .pile import check_piles, partition_pile
from .plan import Plan, make_plan
from .rows import row_dtype
from .scatter import Candidates, Regions, Scattered, gather, scatter
from .spacing import model_spacing
from .upper import Upper, candidate_limits, share_out

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from lpc.attributes import Schema

    from .cells import Cells
    from .folder import Folder
    from .frame import Frame
    from .progress import Progress
    from .rows import Rows
    from .spool import Block, Spool
    from .work import Crew

SLACK = 8.0
"""Standard deviations that candidates of the upper tree may be off; a shortfall looks through the rows for more."""

GATHERED = 1 << 16
"""Rows looked through at a time."""


@dataclass(frozen=True, slots=True)
class Division:
    """The tree, r of the whole model, both in lattice steps, and the rows sorted by node."""

    nodes: Nodes
    spacing: float
    rows: Rows


def divide(
    spool: Spool,
    frame: Frame,
    regions: Regions,
    schema: Schema,
    *,
    owned: bool,
    cloud_size: int,
    seed: int,
    bucket_samples: int,
    folder: Folder,
    crew: Crew,
    progress: Progress,
    slack: float = SLACK,
) -> Division:
    """Distribute the spooled samples over nodes.

    Parameters
    ----------
    spool, frame
        The samples, which are used up, and their lattice.
    regions : Regions
        Gets the rows.
    schema : Schema
        The attributes that rows carry.
    owned : bool
        Samples say which cloud of an older model they were in.
    cloud_size, seed : int
        M, and what the priorities hash.
    bucket_samples : int
        Samples sorted in memory at a time; more where a region of `areas` asks for it.
    folder : Folder
        Keeps the journals of what is done.
    crew, progress
        Threads, and who is told.
    slack : float
        See `SLACK`.
    """
    probing, cells = Probing.of(spool.samples, cloud_size), frame.cells
    most = max(bucket_samples, probing.region)
    plan = _count(spool, frame, cells, most, folder, crew, progress)
    check_piles(plan.buckets)
    regions.lay_out(row_dtype(schema, short=frame.short, owned=owned), [bucket.count for bucket in plan.buckets])
    limits = candidate_limits(plan, cloud_size, slack)
    candidates = _scatter(spool, frame, plan, limits, seed, schema, regions, folder, crew, progress)
    gathered = folder.journal("gather")
    known = iter(gathered)
    while (upper := share_out(plan, candidates, limits, cloud_size)) is None:
        slack *= 4
        limits = candidate_limits(plan, cloud_size, slack)
        recalled = next(known, None)
        candidates = gather(regions, limits, seed, GATHERED) if recalled is None else Candidates(*recalled)
        if recalled is None:
            gathered.add(candidates.priority, candidates.bucket)
    rows = crew.share(regions, folder)
    trees = _partition(plan, upper, cells, probing, most, cloud_size, seed, schema, rows, folder, crew, progress)
    spacing = model_spacing(
        np.concatenate([tree.spacing for tree in trees]), np.concatenate([tree.weight for tree in trees])
    )
    return Division(assemble(plan, upper, trees), spacing, rows.replaced())


def _count(spool: Spool, frame: Frame, cells: Cells, most: int, folder: Folder, crew: Crew, progress: Progress) -> Plan:
    if spool.samples > most:
        progress.stage("count", spool.samples)

    def positions(number: int) -> NDArray[np.float64]:
        return frame.places(spool.read(spool.blocks[number], ("xyz",))["xyz"])

    blocks, journal = len(spool.blocks), folder.journal("count")
    return make_plan(cells, spool.samples, most, positions, blocks, crew, progress, journal)


def _scatter(
    spool: Spool,
    frame: Frame,
    plan: Plan,
    limits: NDArray[np.uint64],
    seed: int,
    schema: Schema,
    regions: Regions,
    folder: Folder,
    crew: Crew,
    progress: Progress,
) -> Candidates:
    progress.stage("scatter", spool.samples)

    def one(block: Block) -> Scattered:
        return scatter(block, spool, frame, plan, limits, seed, schema, regions.dtype)

    def placed(blocks: Iterable[Block]) -> Iterator[tuple[Block, Scattered, NDArray[np.int64]]]:
        for block, part in crew.map(one, blocks):
            yield block, part, regions.reserve(part.counts)

    def write(entry: tuple[Block, Scattered, NDArray[np.int64]]) -> None:
        _, part, places = entry
        regions.place(part.rows, part.counts, places)

    journal = folder.journal("scatter")
    waiting = spool.blocks[::-1]  # from the end of the spool, which makes room for the rows
    found = []
    for counts, priority, bucket in journal:
        regions.skip(counts)
        found.append(Candidates(priority, bucket))
        progress.advance(waiting.pop(0).samples)
    for (block, part, _), _ in crew.map(write, placed(waiting)):
        found.append(part.candidates)
        journal.add(part.counts, part.candidates.priority, part.candidates.bucket)
        spool.cut(block)
        progress.advance(block.samples)
    return Candidates(
        np.concatenate([part.priority for part in found]), np.concatenate([part.bucket for part in found])
    )


def _partition(
    plan: Plan,
    upper: Upper,
    cells: Cells,
    probing: Probing,
    most: int,
    cloud_size: int,
    seed: int,
    schema: Schema,
    rows: Rows,
    folder: Folder,
    crew: Crew,
    progress: Progress,
) -> list[BucketTree]:
    progress.stage("partition", int(rows.first[-1]))
    one = partial(
        _partition_bucket,
        plan=plan,
        upper=upper,
        most=most,
        cells=cells,
        probing=probing,
        cloud_size=cloud_size,
        seed=seed,
        regions=rows,
        normal_bits=next((attribute.bits for attribute in schema if attribute.kind == "normal"), 0),
    )
    journal = folder.journal("partition")
    trees: list[BucketTree] = []
    for arrays in journal:
        progress.advance(plan.buckets[len(trees)].count)
        trees.append(BucketTree.from_arrays(arrays))
    for number, tree in crew.spread(one, range(len(trees), len(plan.buckets))):
        trees.append(tree)
        journal.add(*tree.arrays())
        rows.settle(number)
        progress.advance(plan.buckets[number].count)
    return trees


def _partition_bucket(number: int, *, plan: Plan, upper: Upper, regions: Rows, most: int, **shared: Any) -> BucketTree:
    bucket, above, shares = plan.buckets[number], upper.above(number), upper.shares[number]
    first = int(regions.first[number])
    if bucket.coincident:
        return partition_pile(first, bucket, above, shares, most=most, regions=regions, **shared)
    return partition(first, bucket, above, shares, regions=regions, **shared)
