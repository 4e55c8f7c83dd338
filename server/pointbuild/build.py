"""From scans to a model: the stages in order.

    survey     decode once into a spool; bounding box, attributes             samples in input order
    count      samples per cell: which cells become buckets                   a sweep or a few over the spool
    scatter    every sample to its bucket                                     block by block
    partition  each bucket's tree; its rows sorted by node                    bucket by bucket
    encode     frames, spheres, cones                                         node by node, in the order of the file
    write      header, pages, clouds

Each stage needs its own input and the results of those before it, nothing else, and works on blocks, buckets or nodes
that do not know of each other. Which thread takes which, and how large blocks and buckets are, leaves no trace in
the bytes.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lpc.points import PointBatch

from . import disk, memory
from .arrays import ArrayScan
from .cells import Cells
from .divide import divide
from .encode import kernels_are_loaded
from .inputs import Inputs, Source, open_inputs
from .options import BuildOptions
from .progress import Progress, Silent
from .publish import publish
from .scatter import Regions
from .spool import Spool
from .survey import columns_of, survey
from .work import Crew

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from lpc.header import Header

    from .readers import Scan


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildReport:
    """What a build made, and what it took.

    Parameters
    ----------
    header : Header
        Of the model.
    seconds : float
        Wall time.
    peak_rss_bytes : int
        Peak resident size of the process so far.
    """

    header: Header
    seconds: float
    peak_rss_bytes: int

    @property
    def samples_per_second(self) -> float:
        """Samples of the model by wall time."""
        return self.header.samples / self.seconds if self.seconds > 0 else 0.0


def build_model(
    sources: Sequence[Source],
    out: Path,
    options: BuildOptions,
    progress: Progress | None = None,
    *,
    clock: Callable[[], float],
) -> BuildReport:
    """Build one model of some scans.

    Parameters
    ----------
    sources : sequence of paths and scans
        One after another they are the input.
    out : Path
        The model; what stood there before stays until the new one is complete.
    options : BuildOptions
    progress : Progress, optional
    clock : callable
        Seconds, monotonic.

    Raises
    ------
    ScanError
        If a scan cannot be read or holds nothing.
    BuildError
        If the build cannot go on: options, disk, memory, or samples that cannot be one model.
    """
    began = clock()
    out = Path(out)
    disk.check_target(out)
    progress = progress or Silent()
    with disk.translated(out), disk.scratch_folder(options.scratch or out.parent, out.name) as scratch:
        estimate = partial(_estimate, scratch=scratch, options=options)
        inputs = open_inputs(sources, options, estimate)
        if not kernels_are_loaded():
            _warm(scratch)
        header = _build(inputs, out, scratch, options, progress)
    return BuildReport(header=header, seconds=clock() - began, peak_rss_bytes=memory.peak_bytes())


def _estimate(scan: Scan, *, scratch: Path, options: BuildOptions) -> Scan:
    from . import normals  # scipy is wanted only here

    return normals.estimate(scan, scratch, options.memory_bytes)


def _warm(scratch: Path) -> None:
    """Build a small model, so that all kernels are compiled or loaded before the memory that is left is measured."""
    xyz = np.random.default_rng(0).random((600, 3))
    points = PointBatch(xyz, {"normal": xyz.astype(np.float32), "color": (xyz * 255).astype(np.uint8)})
    options = BuildOptions(cloud_size=64, bucket_samples=256, block_samples=400, memory_bytes=1 << 40, threads=1)
    _build(open_inputs([ArrayScan(points)], options), scratch / "warm.lpc", scratch, options, Silent())


def _build(inputs: Inputs, out: Path, scratch: Path, options: BuildOptions, progress: Progress) -> Header:
    columns = columns_of(inputs.attributes)
    spool_bytes = sum(column.itemsize for column in columns)
    row_bytes = -(-(spool_bytes + 8) // 8) * 8  # with a priority, in whole words; codes are never wider than values
    samples = inputs.samples_at_most
    disk.check_space(samples, scratch, out, spool_bytes, row_bytes)
    sizes = memory.choose_sizes(options, samples, row_bytes, memory.resident_bytes())
    spool_path = scratch / "spool"
    # The crew comes last and goes first: no thread may hold a file that is closed.
    with (
        closing(Spool(spool_path, columns)) as spool,
        closing(Regions(scratch / "rows")) as regions,
        Crew(sizes.threads) as crew,
    ):
        progress.stage("read", inputs.samples_hint)
        found = survey(inputs.batches(sizes.block), spool, crew, progress)
        division = divide(
            spool,
            Cells.over(found.low, found.high),
            regions,
            found.schema,
            cloud_size=options.cloud_size,
            seed=options.seed,
            bucket_samples=sizes.bucket,
            crew=crew,
            progress=progress,
        )
        spool.close()
        spool_path.unlink()  # its room is the model's
        return publish(
            division,
            found,
            inputs,
            regions,
            options,
            clouds_path=scratch / "clouds",
            out=out,
            crew=crew,
            progress=progress,
        )
