"""Several scans as one input: which attributes all of them have, and one coordinate system."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lpc.attributes import MAX_ATTRIBUTES
from lpc.errors import BuildError
from lpc.points import PointBatch

from .extend import OWNER, OldModel
from .readers import Scan, open_scan
from .readers.detect import SUFFIXES
from .readers.directory import scan_files
from .readers.scan import DEFAULT_ATTRIBUTES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from .options import BuildOptions

Source = Scan | Path | str

MOST_SCALES = 4
"""Named in a note."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """Scans one after another; a sample's place in the input runs through all of them.

    Parameters
    ----------
    scans : tuple of Scan
    attributes : dict of str to dtype
        What every scan has and the options ask for.
    left_out : dict of str to str
        What some scan has and the model will not have, and why.
    crs : str or None
    notes : tuple of str
        How the scans differ and what became of it, a sentence each.
    """

    scans: tuple[Scan, ...]
    attributes: dict[str, np.dtype[Any]]
    left_out: dict[str, str]
    crs: str | None
    notes: tuple[str, ...] = ()

    @property
    def samples_hint(self) -> int | None:
        """Records in all scans, where each of them says how many it has."""
        hints = [scan.info.samples_hint for scan in self.scans]
        return None if None in hints else sum(hint for hint in hints if hint is not None)

    @property
    def samples_at_most(self) -> int:
        """`samples_hint`, or a number that the files' lengths hardly allow to exceed."""
        shortest = 16  # bytes of a record
        return sum(
            scan.info.raw_bytes // shortest if scan.info.samples_hint is None else scan.info.samples_hint
            for scan in self.scans
        )

    def to_json(self) -> dict[str, Any]:
        """Give what is still of interest when the samples have been read."""
        dtypes = {name: dtype.str for name, dtype in self.attributes.items()}
        return {"attributes": dtypes, "left_out": self.left_out, "crs": self.crs}

    @classmethod
    def from_json(cls, entry: dict[str, Any]) -> Inputs:
        """Inverse of `to_json`: inputs without scans."""
        dtypes = {name: np.dtype(dtype) for name, dtype in entry["attributes"].items()}
        return cls((), dtypes, entry["left_out"], entry["crs"])

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Yield the samples of all scans with the common attributes only; after a model's, with `OWNER`."""
        owned = isinstance(self.scans[0], OldModel)
        for scan in self.scans:
            for batch in scan.batches(size):
                values = {name: batch.attributes[name] for name in self.attributes}
                if owned:
                    values[OWNER] = batch.attributes.get(OWNER, np.zeros(len(batch), np.uint32))
                yield PointBatch(batch.xyz, values)


def expand(sources: Sequence[Source]) -> list[Source]:
    """Put the scan files of a directory, in the order of their names, in its place.

    Raises
    ------
    ScanError
        If a directory holds none.
    """
    found: list[Source] = []
    for source in sources:
        if isinstance(source, str | Path) and Path(source).is_dir():
            found.extend(scan_files(Path(source), SUFFIXES))
        else:
            found.append(source)
    return found


def open_inputs(
    sources: Sequence[Source], options: BuildOptions, estimate: Callable[[Scan], Scan] | None = None
) -> Inputs:
    """Open what is a path, and find out what the scans have in common.

    Parameters
    ----------
    sources : sequence of paths and scans
    options : BuildOptions
    estimate : callable, optional
        Gives a scan with normals for a scan without; used where the options ask for it.

    Raises
    ------
    ScanError
        If a file cannot be read.
    BuildError
        If there is no scan, the coordinate systems differ, or a named attribute is nowhere.
    """
    if not sources:
        raise BuildError("no scan is given")
    wanted = options.attributes
    everything = wanted is not None and not set(wanted) <= set(DEFAULT_ATTRIBUTES)
    scans = tuple(
        open_scan(source, normals=options.normals, attributes="all" if everything else "default")
        if isinstance(source, str | Path)
        else source
        for source in sources
    )
    if options.normals == "estimate" and estimate is not None:
        scans = tuple(estimate(scan) for scan in scans)
    first = scans[0].info
    for scan in scans[1:]:
        if scan.info.crs != first.crs:
            with_one = [path for path, crs in ((first.path, first.crs), (scan.info.path, scan.info.crs)) if crs]
            why = (
                f"only {with_one[0]} of them says which one it has" if len(with_one) == 1 else "they say different ones"
            )
            raise BuildError(
                f"{first.path} and {scan.info.path} have different coordinate systems ({why}): "
                "bring them into one, then build them together"
            )
    left_out: dict[str, str] = {}
    for scan in scans:
        left_out.update(scan.info.left_out)
    attributes = _common(scans, left_out)
    notes = tuple(_differences(scans, left_out))
    if wanted is not None and "all" not in wanted:
        absent = sorted(set(wanted) - set(attributes) - set(left_out))
        if absent:
            found = ", ".join(attributes) or "none"
            raise BuildError(f"no attribute {absent[0]!r} in the scans: those that all have are {found}")
        for name in attributes.keys() - set(wanted):
            left_out[name] = "not asked for (--attributes)"
    if options.normals == "drop" and "normal" in attributes:
        left_out["normal"] = "dropped (--normals drop)"
    attributes = {name: dtype for name, dtype in attributes.items() if name not in left_out}
    if len(attributes) > MAX_ATTRIBUTES:
        raise BuildError(f"{len(attributes)} attributes are too many: name at most {MAX_ATTRIBUTES} with --attributes")
    # In an order of their own, whatever that of the files.
    ordered = sorted(attributes, key=lambda name: (name != "normal", name != "color", name))
    return Inputs(scans, {name: attributes[name] for name in ordered}, left_out, first.crs, notes)


def _differences(scans: tuple[Scan, ...], left_out: dict[str, str]) -> Iterator[str]:
    """Say how scans differ: nothing is merged in silence."""
    if len(scans) == 1:
        return
    some = {name for scan in scans for name in scan.info.attributes}
    for name in sorted(some & left_out.keys()):
        yield f"{name} is left out: {left_out[name]}"
    scales = {scan.info.scale: scan.info.path.name for scan in reversed(scans) if scan.info.scale is not None}
    if len(scales) > 1:
        shown = list(scales.items())[:MOST_SCALES]
        named = ", ".join(f"{'/'.join(f'{part:g}' for part in scale)} in {name}" for scale, name in shown)
        yield f"the scans state positions at {len(scales)} scales, and each keeps its own: {named}"


def _common(scans: tuple[Scan, ...], left_out: dict[str, str]) -> dict[str, np.dtype[Any]]:
    """Attributes that every scan has with one dtype; the reasons of the others go to `left_out`."""
    names = dict.fromkeys(name for scan in scans for name in scan.info.attributes)
    common = {}
    for name in names:
        dtypes = [scan.info.attributes[name] for scan in scans if name in scan.info.attributes]
        without = [scan.info.path.name for scan in scans if name not in scan.info.attributes]
        if without:
            more = f" and {len(without) - 1} more" if len(without) > 1 else ""
            left_out[name] = f"missing in {without[0]}{more} of {len(scans)} scans"
        elif len(set(dtypes)) > 1:
            left_out[name] = f"its type differs between the scans ({dtypes[0]} and others)"
        else:
            left_out.pop(name, None)
            common[name] = np.dtype(dtypes[0])
    return common
