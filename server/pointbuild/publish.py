"""From rows sorted by node to the finished file: encode, index, write."""

from __future__ import annotations

import os
from functools import partial
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from lpc.context import ANCESTORS
from lpc.header import Header
from lpc.lattice import position_error_bound

from .ancestry import Ancestry
from .costs import cloud_costs, seal_with_costs
from .encode import RUN_SAMPLES, Geometry, Records, Run, encode_run
from .extend import PACKING, packing_of
from .spacing import node_spacings
from .write import write_model

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from lpc.attributes import Schema

    from .assemble import Nodes
    from .divide import Division
    from .extend import OldClouds
    from .folder import Folder
    from .frame import Frame
    from .inputs import Inputs
    from .journal import Journal
    from .options import BuildOptions
    from .progress import Progress
    from .survey import Survey
    from .work import Crew

GENERATOR = "pointstream 0.1"

COSTED_CLOUDS = 256
"""Clouds, evenly over the tree, that say what each kind of number costs."""


def publish(
    division: Division,
    found: Survey,
    frame: Frame,
    inputs: Inputs,
    options: BuildOptions,
    *,
    folder: Folder,
    out: Path,
    crew: Crew,
    progress: Progress,
    ancestor_bytes: int = 0,
    old: OldClouds | None = None,
) -> tuple[Header, int]:
    """Write the model; its header, and how many clouds of an older model are in it.

    Parameters
    ----------
    division, found, frame, inputs
        The tree, what the survey found, the lattice, and what is known of the scans.
    options : BuildOptions
    folder : Folder
        Keeps the clouds until they are all there, and the journal of them.
    out : Path
        The model.
    crew, progress
        Threads, and who is told.
    ancestor_bytes : int
        Memory for clouds that others are told from.
    old : OldClouds, optional
        Clouds that need not be encoded.
    """
    nodes, step = division.nodes, frame.step
    geometry = Geometry.of(nodes, frame)
    spacing, ratio = node_spacings(nodes, division.spacing, step)
    progress.stage("encode", int(nodes.subtree[0]))
    path = folder.path / "clouds"
    path.touch()
    with path.open("r+b") as clouds:
        records = Records(nodes, geometry, spacing)
        journal = folder.journal("encode")
        one = partial(
            _encode_run, nodes=nodes, geometry=geometry, regions=division.rows, schema=found.schema,
            effort=options.effort, ancestry=Ancestry(ancestor_bytes), old=old,
        )  # fmt: skip
        costs, kept = _encode(records, clouds, journal, one, len(found.schema), crew, progress)
        division.rows.remove()  # their room is the model's
        header = Header(
            bytes=2**53,
            samples=int(nodes.subtree[0]),
            nodes=len(nodes),
            levels=int(nodes.depth.max()) + 1,
            cloud_size=options.cloud_size,
            page_nodes=options.page_nodes,
            origin=_triple(frame.origin),
            step=step,
            side=geometry.side,
            bounds=(*_triple(found.low), *_triple(found.high)),
            spacing=frame.spacing or division.spacing * step,
            position_error=position_error_bound(step, frame.origin, geometry.side),
            attributes=found.schema,
            constants=found.constants,
            crs=inputs.crs,
            left_out={**inputs.left_out, **found.left_out},
            rejected=found.rejected,
            spacing_ratio=ratio,
            seed=options.seed,
            generator=GENERATOR,
            extra={PACKING: packing_of(options)},
        )
        finished = records.finish()
        header = seal_with_costs(header, finished, costs, clouds.tell())
        folder.note_written(header.digest)
        progress.stage("write", header.samples)
        write_model(out, folder.part_of(out), header, finished, clouds)
    progress.advance(header.samples)
    return header, kept


def _encode(
    records: Records,
    clouds: BinaryIO,
    journal: Journal,
    one: Callable[[tuple[int, int]], tuple[Run, NDArray[np.float64]]],
    attributes: int,
    crew: Crew,
    progress: Progress,
) -> tuple[NDArray[np.float64], int]:
    """Write all clouds in order and fill the records; `one` encodes a run.

    Returns what positions and attributes cost in some of the clouds, and how many are old.
    """
    nodes = records.nodes
    costs = np.zeros(1 + attributes)
    waiting, kept = runs(nodes, RUN_SAMPLES), 0
    for sizes, checks, reach, spread, part, same in journal:
        kept += int(same)
        first, stop = waiting.pop(0)
        records.add(Run(first, [], sizes, checks, reach, spread))
        costs += part
        clouds.seek(int(sizes.sum(dtype=np.int64)), os.SEEK_CUR)
        progress.advance(int(nodes.samples[first:stop].sum()))
    clouds.truncate()
    for (first, stop), (run, part) in crew.spread(one, waiting):
        clouds.writelines(run.frames)
        clouds.flush()
        records.add(run)
        costs += part
        kept += run.kept
        journal.add(run.sizes, run.checks, run.reach, run.spread, part, np.array(run.kept))
        progress.advance(int(nodes.samples[first:stop].sum()))
    return costs, kept


def _encode_run(
    run: tuple[int, int], *, nodes: Nodes, schema: Schema, **shared: Any
) -> tuple[Run, NDArray[np.float64]]:
    """Encode a run of nodes; and the `cloud_costs` of some of its clouds, evenly over the tree."""
    first, stop = run
    encoded = encode_run(first, stop, nodes=nodes, schema=schema, **shared)
    costed = np.unique(np.linspace(0, len(nodes) - 1, COSTED_CLOUDS).astype(int))
    costs = np.zeros(1 + len(schema))
    for node in costed[(costed >= first) & (costed < stop)].tolist():
        costs += cloud_costs(encoded.frames[node - first], int(nodes.samples[node]), schema)
    return encoded, costs


def runs(nodes: Nodes, samples: int) -> list[tuple[int, int]]:
    """Cut the nodes into runs of about so many samples, ancestors included that the nodes before do not share."""
    cost, line = nodes.samples.copy(), np.arange(len(nodes))
    for _ in range(ANCESTORS):
        line = np.where(line < 0, -1, nodes.parent[line])
        cost += np.where((line >= 0) & (np.diff(line, prepend=-1) != 0), nodes.samples[line], 0)
    run = np.cumsum(cost) // samples
    starts = np.flatnonzero(np.diff(run, prepend=-1)).tolist()
    return list(zip(starts, [*starts[1:], len(nodes)], strict=True))


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
