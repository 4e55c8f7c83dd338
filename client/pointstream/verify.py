"""Is a model whole, sound, and exactly its scans? Every page and every cloud is looked at."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from lpc.codec import cloud_to_points
from lpc.errors import Corrupt
from lpc.header import compute_digest
from lpc.info import counted
from lpc.octahedral import max_error_degrees
from lpc.page import PAGE_HEADER

from .lineage import Untold
from .matching import Matcher, MatchReport

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from lpc.header import Header
    from lpc.index import IndexTree
    from lpc.points import PointBatch

    from .reading import Reader

SCAN_BATCH = 1 << 18
MOST_PROBLEMS = 50
SLACK = 1e-6
"""Relative; spheres and cones are stored as float32 and 16 bits, rounded outwards."""


class ScanInfo(Protocol):
    """What is used of a scan's description."""

    @property
    def attributes(self) -> Mapping[str, np.dtype[Any]]:
        """Names and dtypes of what every batch has."""


class Scan(Protocol):
    """What is used of a scan; readers come from the entry point group ``pointstream.readers``."""

    @property
    def info(self) -> ScanInfo:
        """What is known before reading."""

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Read all samples in batches."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VerifyReport:
    """The answer.

    Parameters
    ----------
    clouds, clouds_checked : int
        Of the model, and those that were here.
    complete : bool
        The file is not cut short.
    problems : tuple of str
        Empty if all is well.
    match : MatchReport or None
        With scans to compare.
    """

    clouds: int
    clouds_checked: int
    complete: bool
    problems: tuple[str, ...]
    match: MatchReport | None = None

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems

    def to_json(self) -> dict[str, Any]:
        """Give what ``pointstream verify --json`` prints."""
        entry: dict[str, Any] = {
            "ok": self.ok,
            "complete": self.complete,
            "clouds": self.clouds,
            "clouds_checked": self.clouds_checked,
            "problems": list(self.problems),
        }
        if self.match is not None:
            match = self.match
            entry |= {
                "samples_in": match.samples_in,
                "samples_out": match.samples_out,
                "missing": match.missing,
                "surplus": match.surplus,
                "max_position_error": match.max_position_error,
                "max_normal_error_degrees": match.max_normal_error_degrees,
                "max_color_error": match.max_color_error,
                "attributes_differing": dict(match.differing),
                "not_compared": dict(match.not_compared),
            }
        return entry


async def verify(
    reader: Reader, scans: Sequence[Scan] = (), *, advance: Callable[[int], None] = lambda _: None
) -> VerifyReport:
    """Check a model, and its samples against the scans it was built from.

    Parameters
    ----------
    reader : Reader
    scans : sequence of Scan
        All of them, or none.
    advance : callable
        Called with the number of clouds just checked.

    Raises
    ------
    StoreError, ScanError
        If model or scans cannot be read at all; damage is a problem in the report.
    """
    problems = _Problems()
    header = reader.index.header
    await _load_all_pages(reader, problems)
    index, complete = reader.index, reader.complete
    nodes = np.flatnonzero(index.known & reader.reaches(index.offset, index.offset + index.size))
    if not complete:
        what = (
            "is a partial copy"
            if reader.store.partial
            else f"is cut short: {reader.length} of {header.bytes} bytes are here"
        )
        problems.add(f"the file {what}, {header.nodes - len(nodes)} of {counted(header.nodes, 'cloud')} are missing")
    elif reader.index.page_loaded.all():
        await _check_digest(reader, problems)
    compared, not_compared = _comparable(header, scans)
    with (
        tempfile.TemporaryDirectory(prefix="pointstream-") as folder,
        Matcher(header, compared, Path(folder)) as matcher,
    ):
        samples = untold = lost = 0
        async for node, cloud in reader.clouds(nodes):
            advance(1)
            if isinstance(cloud, Untold):
                untold, lost = untold + 1, lost + int(index.samples[node])
                continue
            if isinstance(cloud, Corrupt):
                problems.add(str(cloud))
                continue
            points = cloud_to_points(cloud, header)
            samples += len(points)
            _check_node(reader.index, node, points, problems)
            if scans:
                matcher.add_out(cloud.lattice(), points.attributes)
        if untold:
            problems.add(
                f"{counted(untold, 'sound cloud')} of {counted(lost, 'sample')} cannot be decoded: they are told from "
                "clouds that are damaged or missing"
            )
        if complete and samples != header.samples:
            problems.add(f"the clouds hold {samples} samples, the header says {header.samples}")
        matcher.report.not_compared = not_compared
        match = _match(matcher, scans, header, problems) if scans else None
    return VerifyReport(
        clouds=header.nodes, clouds_checked=len(nodes), complete=complete, problems=problems.texts, match=match
    )


class _Problems:
    """The first `MOST_PROBLEMS` problems, and how many more there were."""

    def __init__(self) -> None:
        self._texts: list[str] = []
        self._count = 0

    def add(self, text: str) -> None:
        self._count += 1
        if len(self._texts) < MOST_PROBLEMS:
            self._texts.append(text)

    @property
    def texts(self) -> tuple[str, ...]:
        more = self._count - len(self._texts)
        return (*self._texts, *([f"and {more} more problems"] if more else []))


async def _load_all_pages(reader: Reader, problems: _Problems) -> None:
    """Read all pages that can be found; a damaged one hides what only it leads to, and nothing else."""
    index = reader.index
    first_nodes = np.arange(len(index.page_loaded), dtype=np.int64) * index.header.page_nodes
    damaged: set[int] = set()
    before = -1
    while int(index.page_loaded.sum()) > before:
        before = int(index.page_loaded.sum())
        pages = [page for page in index.missing_pages(first_nodes).tolist() if page not in damaged]
        try:
            await reader.load_pages(first_nodes[pages])
        except Corrupt:
            for page in pages:
                try:
                    await reader.load_pages(first_nodes[[page]])
                except Corrupt as error:
                    damaged.add(page)
                    problems.add(str(error))
    if damaged:
        hidden = index.header.nodes - int(index.known.sum())
        clouds, behind = counted(index.header.nodes, "cloud"), counted(len(damaged), "damaged page")
        problems.add(f"{hidden} of {clouds} cannot be found behind {behind}")


async def _check_digest(reader: Reader, problems: _Problems) -> None:
    pages = range(len(reader.index.page_loaded))
    records = [(await reader.read(reader.index.page_range(page)))[PAGE_HEADER:] for page in pages]
    digest = compute_digest(reader.index.header, records)
    if digest != reader.index.header.digest:
        problems.add(f"the build id is {reader.index.header.digest}, header and records give {digest}")


def _check_node(index: IndexTree, node: int, points: PointBatch, problems: _Problems) -> None:
    """Check that the spheres and cones of a node and its ancestors hold its samples."""
    line = [node]
    while index.parent[line[-1]] >= 0:
        line.append(int(index.parent[line[-1]]))
    center, radius = index.center[line], index.radius[line]
    reach = np.sqrt(((points.xyz[None] - center[:, None]) ** 2).sum(axis=2).max(axis=1))
    room = radius * (1 + SLACK) + 1e-12 * np.abs(center).max()
    if (reach > room).any():
        worst = line[int(np.argmax(reach - room))]
        problems.add(f"cloud {node}: samples stand outside the sphere of node {worst}")
    header = index.header
    low, high = np.array(header.bounds[:3]), np.array(header.bounds[3:])
    slack = header.position_error + 1e-12 * np.abs(header.bounds).max()
    if (points.xyz < low - slack).any() or (points.xyz > high + slack).any():
        problems.add(f"cloud {node}: samples stand outside the bounds of the model")
    if points.normal is not None and len(points):
        _check_cones(index, node, line, points.normal.astype(np.float64), problems)


def _check_cones(
    index: IndexTree, node: int, line: list[int], normals: NDArray[np.float64], problems: _Problems
) -> None:
    coned = [above for above in line if index.cone_angle[above] < np.pi]
    bits = next((item.bits for item in index.header.attributes if item.kind == "normal"), 0)
    if not coned or not bits:
        return
    normals = normals[normals.any(axis=1)]
    chord = np.sqrt(((normals[None] - index.cone_axis[coned][:, None].astype(np.float64)) ** 2).sum(axis=2))
    angle = 2 * np.arcsin(np.minimum(chord.max(axis=1, initial=0.0) / 2, 1))
    # Cones may be made before the normals are rounded to their codes.
    room = index.cone_angle[coned].astype(np.float64) + np.radians(max_error_degrees(bits)) + SLACK
    if (angle > room).any():
        worst = coned[int(np.argmax(angle - room))]
        problems.add(f"cloud {node}: normals stand outside the cone of node {worst}")


def _comparable(header: Header, scans: Sequence[Scan]) -> tuple[list[str], dict[str, str]]:
    """Attributes of the model that every scan has in the model's dtype, and why the others are not compared."""
    names, others = [], {}
    dtypes = {item.name: np.dtype(item.dtype) for item in header.attributes}
    dtypes |= {name: np.dtype(constant.dtype) for name, constant in header.constants.items()}
    for name, dtype in dtypes.items():
        found = [scan.info.attributes[name] for scan in scans if name in scan.info.attributes]
        theirs = {item.newbyteorder("=").name for item in found}
        if len(found) < len(scans):
            others[name] = "not in all of the scans" if theirs else "not in the scans"
        elif theirs == {dtype.name}:
            names.append(name)
        else:
            others[name] = f"{dtype} in the model, {' and '.join(sorted(theirs))} in the scans"
    return names, others


def _match(matcher: Matcher, scans: Sequence[Scan], header: Header, problems: _Problems) -> MatchReport:
    for scan in scans:
        for batch in scan.batches(SCAN_BATCH):
            kept = batch.take(np.flatnonzero(np.isfinite(batch.xyz).all(axis=1)))
            matcher.add_in(kept.xyz, kept.attributes)
    match = matcher.match()
    if match.missing:
        problems.add(f"{match.missing} of {match.samples_in} samples of the scans are not in the model")
    if match.surplus:
        problems.add(f"{match.surplus} of {match.samples_out} samples of the model are not in the scans")
    if match.max_position_error > header.position_error * (1 + SLACK):
        problems.add(f"a sample is {match.max_position_error:g} away, more than the bound {header.position_error:g}")
    bits = next((item.bits for item in header.attributes if item.kind == "normal"), 0)
    worst = match.max_normal_error_degrees
    if worst is not None and bits and worst > max_error_degrees(bits) + 1e-3:
        problems.add(f"a normal is {worst:.3f} degrees off, more than the bound {max_error_degrees(bits):.3f}")
    for name, count in match.differing.items():
        if count:
            allowed = next((item.max_error for item in header.attributes if item.name == name), 0)
            beyond = f" by more than the {allowed} that are allowed" if allowed else ""
            problems.add(f"{name} differs in {count} samples{beyond}")
    return match
