"""From scans to a model: the stages in order.

    survey     decode once into a spool; bounding box, attributes             samples in input order
    count      samples per cell: which cells become buckets                   a sweep or a few over the spool
    scatter    every sample to its bucket                                     block by block
    partition  each bucket's tree; its rows sorted by node                    bucket by bucket
    encode     frames, spheres, cones                                         node by node, in the order of the file
    write      header, pages, clouds

Each stage needs its own input and the results of those before it, nothing else, and works on blocks, buckets or nodes
that do not know of each other. Which thread takes which, and how large blocks and buckets are, leaves no trace in
the bytes. Each keeps a journal of what it has done, from which a build that was killed goes on (`folder`).
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict, astuple, dataclass
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
from .folder import Folder, manifest_of, work_folder
from .inputs import Inputs, Source, expand, open_inputs
from .journal import as_array, from_array
from .options import BuildOptions
from .progress import Progress, Silent
from .publish import GENERATOR, publish
from .rows import row_start, whole_words
from .scatter import Regions
from .spool import Block, Spool
from .survey import Survey, columns_of, survey
from .work import Crew

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from lpc.header import Header

    from .cluster import Cluster
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
    tell: Callable[[str], None] = lambda _: None,
    cluster: Cluster | None = None,
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
    tell : callable
        Gets a sentence where a build that was killed left files, and where the scans differ.
    cluster : Cluster, optional
        Workers that sort and encode; without them threads do.

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
    sources = expand(sources)
    manifest = manifest_of(sources, options, GENERATOR)
    if manifest and cluster:
        manifest["cluster"] = cluster.url
    with disk.translated(out), work_folder(options.scratch or out.parent, out, manifest, tell) as folder:
        if not kernels_are_loaded():
            _warm(folder)
        header = _build(sources, out, folder, options, progress, cluster, tell)
    return BuildReport(header=header, seconds=clock() - began, peak_rss_bytes=memory.peak_bytes())


def _warm(folder: Folder) -> None:
    """Build a small model, so that all kernels are compiled or loaded before the memory that is left is measured."""
    xyz = np.random.default_rng(0).random((600, 3))
    points = PointBatch(xyz, {"normal": xyz.astype(np.float32), "color": (xyz * 255).astype(np.uint8)})
    options = BuildOptions(cloud_size=64, bucket_samples=256, block_samples=400, memory_bytes=1 << 40, threads=1)
    folder.remove("warm")
    path = folder.path / "warm"
    path.mkdir()
    _build([ArrayScan(points)], path / "warm.lpc", Folder(path), options, Silent())
    folder.remove("warm")


def _build(
    sources: Sequence[Source],
    out: Path,
    folder: Folder,
    options: BuildOptions,
    progress: Progress,
    cluster: Cluster | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> Header:
    """Go through the stages; what the folder's journals know is not done again."""
    journal = folder.journal("survey")
    recalled = next(iter(journal), None)
    if recalled is None:
        folder.remove("normals-*")
        inputs = open_inputs(sources, options, partial(_estimate, scratch=folder.path, options=options))
        for note in inputs.notes:
            tell(note)
        sizes, blocks = _sizes(inputs, out, folder, options), None
    else:
        told = from_array(recalled[0])
        inputs, sizes = Inputs.from_json(told["inputs"]), memory.Sizes(**told["sizes"])
        blocks = [Block(*block) for block in recalled[1].tolist()]
    # The crew comes last and goes first: no thread may hold a file that is closed.
    with (
        closing(Spool(folder.path / "spool", columns_of(inputs.attributes, options.precision), blocks)) as spool,
        closing(Regions(folder.path / "rows")) as regions,
        cluster.crew(sizes.threads, folder) if cluster else Crew(sizes.threads) as crew,
    ):
        progress.stage("read", spool.samples or inputs.samples_hint)
        if recalled is None:
            found = survey(inputs.batches(sizes.block), spool, crew, progress, options.precision)
            told = {"inputs": inputs.to_json(), "sizes": asdict(sizes), "found": found.to_json()}
            journal.add(as_array(told), np.array([astuple(block) for block in spool.blocks], np.int64))
            folder.remove("normals-*")
        else:
            found = Survey.from_json(told["found"])
            progress.advance(spool.samples)
        division = divide(
            spool,
            Cells.over(found.low, found.high),
            regions,
            found.schema,
            single=found.single,
            cloud_size=options.cloud_size,
            seed=options.seed,
            bucket_samples=sizes.bucket,
            folder=folder,
            crew=crew,
            progress=progress,
        )
        return publish(division, found, inputs, options, folder=folder, out=out, crew=crew, progress=progress)


def _estimate(scan: Scan, *, scratch: Path, options: BuildOptions) -> Scan:
    from . import normals  # scipy is wanted only here

    return normals.estimate(scan, scratch, options.memory_bytes)


def _sizes(inputs: Inputs, out: Path, folder: Folder, options: BuildOptions) -> memory.Sizes:
    """Check the disk, and share out the memory."""
    spool_bytes = sum(column.itemsize for column in columns_of(inputs.attributes, options.precision))
    attribute_bytes = spool_bytes - 24  # codes are never wider than values
    samples = inputs.samples_at_most
    row_bytes = whole_words(row_start(single=False) + attribute_bytes)
    sizes = memory.choose_sizes(options, samples, row_bytes, memory.resident_bytes())
    stored = whole_words(row_start(single=inputs.single) + attribute_bytes)
    disk.check_space(
        disk.predict(samples, stored, attribute_bytes, (sizes.threads + 2) * sizes.bucket),
        folder.path,
        folder.used_bytes(),
        out,
    )
    return sizes
