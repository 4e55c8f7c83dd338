"""From rows sorted by node to the finished file: encode, index, write."""

from __future__ import annotations

import os
from functools import partial
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from lpc.errors import BuildError
from lpc.header import Header
from lpc.lattice import EPSILON, SLACK, position_error_bound, position_step

from .costs import cloud_costs, seal_with_costs
from .encode import Geometry, Records, Run, encode_run
from .spacing import node_spacings
from .write import write_model

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from lpc.attributes import Schema
    from lpc.codec import Effort

    from .assemble import Nodes
    from .divide import Division
    from .folder import Folder
    from .inputs import Inputs
    from .journal import Journal
    from .options import BuildOptions
    from .progress import Progress
    from .rows import Rows
    from .survey import Survey
    from .work import Crew

GENERATOR = "pointstream 0.1"

RUN_SAMPLES = 1 << 15
"""Encoded at a time by one thread."""

COSTED_CLOUDS = 256
"""Clouds, evenly over the tree, that say what each kind of number costs."""


def publish(
    division: Division,
    found: Survey,
    inputs: Inputs,
    options: BuildOptions,
    *,
    folder: Folder,
    out: Path,
    crew: Crew,
    progress: Progress,
) -> Header:
    """Write the model and give its header.

    Parameters
    ----------
    division, found, inputs
        The tree, what the survey found, and what is known of the scans.
    options : BuildOptions
    folder : Folder
        Keeps the clouds until they are all there, and the journal of them.
    out : Path
        The model.
    crew, progress
        Threads, and who is told.

    Raises
    ------
    BuildError
        If no lattice can hold the samples within the wanted error.
    """
    nodes = division.nodes
    extent = float((found.high - found.low).max())
    far = float(np.abs([found.low, found.high]).max())
    step = choose_step(division.spacing, extent, options.position_error, far=far)
    geometry = Geometry.of(nodes, found.low, found.high, step)
    spacing, ratio = node_spacings(nodes, division.spacing, step)
    progress.stage("encode", int(nodes.subtree[0]))
    path = folder.path / "clouds"
    path.touch()
    with path.open("r+b") as clouds:
        records = Records(nodes, geometry, spacing)
        costs = _encode(records, clouds, folder.journal("encode"), division.rows, found, options.effort, crew, progress)
        division.rows.remove()  # their room is the model's
        header = Header(
            bytes=2**53,
            samples=int(nodes.subtree[0]),
            nodes=len(nodes),
            levels=int(nodes.depth.max()) + 1,
            cloud_size=options.cloud_size,
            page_nodes=options.page_nodes,
            origin=_triple(found.low),
            step=step,
            side=geometry.side,
            bounds=(*_triple(found.low), *_triple(found.high)),
            spacing=division.spacing,
            position_error=position_error_bound(step, found.low, extent),
            attributes=found.schema,
            constants=found.constants,
            crs=inputs.crs,
            left_out={**inputs.left_out, **found.left_out},
            rejected=found.rejected,
            spacing_ratio=ratio,
            seed=options.seed,
            generator=GENERATOR,
        )
        finished = records.finish()
        header = seal_with_costs(header, finished, costs, clouds.tell())
        progress.stage("write", header.samples)
        write_model(out, folder.part_of(out), header, finished, clouds)
    progress.advance(header.samples)
    return header


def choose_step(spacing: float, extent: float, position_error: float | None, *, far: float = 0.0) -> float:
    """Edge of a lattice cell.

    Samples that all coincide are the lattice's origin, whatever its step: it is what float64 tells apart at the
    largest coordinate, `far`.

    Raises
    ------
    BuildError
        If half the spacing as a bound takes more bits than a coordinate has, or the wanted error does.
    """
    if position_error is None and extent == 0.0:
        return EPSILON * (far or 1.0)
    step = position_step(spacing, extent, position_error)
    if position_error is None and spacing > 0 and step > SLACK * spacing:
        raise BuildError(
            f"the samples are {spacing:g} apart but spread over {extent:g}, more than 48 bits a coordinate can tell: "
            "remove the outliers, or allow a larger --position-error"
        )
    return step


def _encode(
    records: Records,
    clouds: BinaryIO,
    journal: Journal,
    regions: Rows,
    found: Survey,
    effort: Effort,
    crew: Crew,
    progress: Progress,
) -> NDArray[np.float64]:
    """Write all clouds in order and fill the records; what positions and attributes cost in some of them."""
    nodes, geometry = records.nodes, records.geometry
    costed = np.unique(np.linspace(0, len(nodes) - 1, COSTED_CLOUDS).astype(int))
    schema = found.schema
    one = partial(
        _encode_run, costed=costed, nodes=nodes, geometry=geometry, regions=regions, schema=schema, effort=effort
    )
    costs = np.zeros(1 + len(found.schema))
    waiting = runs(nodes, RUN_SAMPLES)
    for sizes, checks, reach, spread, part in journal:
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
        journal.add(run.sizes, run.checks, run.reach, run.spread, part)
        progress.advance(int(nodes.samples[first:stop].sum()))
    return costs


def _encode_run(
    run: tuple[int, int], *, costed: NDArray[np.int64], nodes: Nodes, schema: Schema, **shared: Any
) -> tuple[Run, NDArray[np.float64]]:
    """Encode a run of nodes; and the `cloud_costs` of those of its clouds that are `costed`."""
    first, stop = run
    encoded = encode_run(first, stop, nodes=nodes, schema=schema, **shared)
    costs = np.zeros(1 + len(schema))
    for node in costed[(costed >= first) & (costed < stop)].tolist():
        costs += cloud_costs(encoded.frames[node - first], int(nodes.samples[node]), schema)
    return encoded, costs


def runs(nodes: Nodes, samples: int) -> list[tuple[int, int]]:
    """Cut the nodes into runs of about so many samples."""
    run = np.cumsum(nodes.samples) // samples
    starts = np.flatnonzero(np.diff(run, prepend=-1)).tolist()
    return list(zip(starts, [*starts[1:], len(nodes)], strict=True))


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
