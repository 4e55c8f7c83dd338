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
from dataclasses import asdict, astuple, dataclass, replace
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
from .estimate import Sketch, estimate_spacing
from .extend import OldModel
from .folder import Folder, manifest_of, was_written, work_folder
from .frame import Frame, choose_step
from .inputs import Inputs, Source, expand, open_inputs
from .inside import HINT, is_inside_out, root_samples
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
    clouds_kept : int
        Of an older model, as they were.
    """

    header: Header
    seconds: float
    peak_rss_bytes: int
    clouds_kept: int = 0

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
    append: Path | None = None,
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
        Gets a sentence where a build that was killed left files, where the scans differ, where normals point inwards.
    cluster : Cluster, optional
        Workers that sort and encode; without them threads do.
    append : Path, optional
        A model that the scans are added to, which may be `out`. It determines the lattice and all options but those
        of memory, threads, places and the normals of the scans.

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
    old = None if append is None else OldModel.open(append)
    if old:
        options = old.options(options)
    manifest = manifest_of(sources if old is None else [old.path, *sources], options, GENERATOR)
    if manifest:
        manifest |= {"cluster": cluster and cluster.url, "append": append is not None}
    place = options.scratch or out.parent
    if old and manifest and was_written(place, out, manifest, old.header.digest):
        tell(f"the scans were added to {out} before the build was stopped: there is nothing left to do")
        with work_folder(place, out, None, lambda _: None):
            pass
        kept = old.header.nodes
        return BuildReport(
            header=old.header, seconds=clock() - began, peak_rss_bytes=memory.peak_bytes(), clouds_kept=kept
        )
    with disk.translated(out), work_folder(place, out, manifest, tell) as folder:
        if not kernels_are_loaded():
            _warm(folder)
        header, kept = _build(sources, out, folder, options, progress, cluster, tell, old)
        if is_inside_out(root_samples(out, header)):
            tell(f"{out}: {HINT}")
    seconds = clock() - began
    return BuildReport(header=header, seconds=seconds, peak_rss_bytes=memory.peak_bytes(), clouds_kept=kept)


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
    old: OldModel | None = None,
) -> tuple[Header, int]:
    """Go through the stages; what the folder's journals know is not done again."""
    journal = folder.journal("survey")
    recalled = next(iter(journal), None)
    if recalled is None:
        folder.remove("normals-*")
        inputs = open_inputs(sources, options, partial(_estimate, scratch=folder.path, options=options))
        for note in inputs.notes:
            tell(note)
        if old:
            inputs = old.join(inputs)
        sizes, blocks = _sizes(inputs, out, folder, options, owned=old is not None), None
    else:
        told = from_array(recalled[0])
        inputs, sizes = Inputs.from_json(told["inputs"]), memory.Sizes(**told["sizes"])
        blocks = [Block(*block) for block in recalled[1].tolist()]
    columns = columns_of(inputs.attributes, options.precision, owned=old is not None)
    # The crew comes last and goes first: no thread may hold a file that is closed.
    with (
        closing(Spool(folder.path / "spool", columns, blocks)) as spool,
        closing(Regions(folder.path / "rows")) as regions,
        cluster.crew(sizes.threads, folder) if cluster else Crew(sizes.threads) as crew,
    ):
        progress.stage("read", spool.samples or inputs.samples_hint)
        if recalled is None:
            sketched = options.position_error is None and options.step is None
            found = survey(inputs.batches(sizes.block), spool, crew, progress, options.precision, sketched=sketched)
            if old:
                found = old.join_survey(found)
            told = {"inputs": inputs.to_json(), "sizes": asdict(sizes), "found": found.to_json()}
            placed = np.array([astuple(block) for block in spool.blocks], np.int64)
            journal.add(as_array(told), placed, *found.sketch.arrays())
            folder.remove("normals-*")
        else:
            found = replace(Survey.from_json(told["found"]), sketch=Sketch.from_arrays(recalled[2:]))
            progress.advance(spool.samples)
        frame = _frame(found, spool, options, folder, crew, progress)
        division = divide(
            spool,
            frame,
            regions,
            found.schema,
            owned=old is not None,
            cloud_size=options.cloud_size,
            seed=options.seed,
            bucket_samples=sizes.bucket,
            folder=folder,
            crew=crew,
            progress=progress,
        )
        # Workers of a cluster may not reach the model.
        clouds = None if old is None or cluster else old.clouds(found, frame, options, GENERATOR)
        return publish(
            division, found, frame, inputs, options,
            folder=folder, out=out, crew=crew, progress=progress, ancestor_bytes=sizes.ancestors, old=clouds,
        )  # fmt: skip


def _frame(found: Survey, spool: Spool, options: BuildOptions, folder: Folder, crew: Crew, progress: Progress) -> Frame:
    """Choose the lattice."""
    cells = Cells.over(found.low, found.high)  # in model units
    journal = folder.journal("frame")
    recalled = next(iter(journal), None)
    if recalled is not None:
        step, spacing = recalled[0].tolist()
    else:
        spacing = 0.0
        if options.position_error is None and options.step is None:
            spacing = estimate_spacing(spool, cells, found.sketch, options.cloud_size, crew, progress)
        step = options.step or choose_step(spacing, found.low, found.high, options.position_error)
        journal.add(np.array([step, spacing]))
    return replace(Frame.over(found.low, found.high, step), spacing=spacing)


def _estimate(scan: Scan, *, scratch: Path, options: BuildOptions) -> Scan:
    from . import normals  # scipy is wanted only here

    return normals.estimate(scan, scratch, options.memory_bytes)


def _sizes(inputs: Inputs, out: Path, folder: Folder, options: BuildOptions, *, owned: bool) -> memory.Sizes:
    """Check the disk, and share out the memory."""
    spool_bytes = sum(column.itemsize for column in columns_of(inputs.attributes, options.precision, owned=owned))
    attribute_bytes = spool_bytes - 24  # codes are never wider than values
    attribute_bytes += 4 if owned else 0  # of a row: the old cloud has a word of its own
    samples = inputs.samples_at_most
    row_bytes = whole_words(row_start(short=False) + attribute_bytes)
    sizes = memory.choose_sizes(options, samples, row_bytes, memory.resident_bytes())
    stored = whole_words(row_start(short=True) + attribute_bytes)  # more only where an outlier is
    disk.check_space(
        disk.predict(samples, stored, attribute_bytes, (sizes.threads + 2) * sizes.bucket),
        folder.path,
        folder.used_bytes(),
        out,
    )
    return sizes
