"""A scan without normals as a scan with estimated ones, out of core."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lpc.errors import BuildError, ScanError
from lpc.points import PointBatch
from pointbuild.readers.scan import Scan, ScanInfo, finite_rows

from .blocks import Blocks, CoarseSample
from .field import OrientationField, block_normals
from .fit import NEIGHBOURS

BLOCK = 1 << 19  # samples; their neighbours, edges and order take some 400 bytes each
COARSE = 1 << 17
_BATCH = 1 << 18
_BASE_BYTES, _BYTES_A_SAMPLE = 160 << 20, 400


def estimate(
    scan: Scan,
    scratch: Path,
    memory_bytes: int = 2 << 30,
    *,
    neighbours: int = NEIGHBOURS,
    block: int = BLOCK,
    coarse: int = COARSE,
) -> EstimatedScan:
    """Estimate the normals of a scan.

    Two passes over the scan: one takes a coarse sample of it, which is oriented as a whole (`OrientationField`), one
    deals the samples out to blocks on disk. Every block is then estimated by itself and appended to one file. About
    4 us CPU a sample and, whatever the length of the scan, 350 MB of memory with the interpreter.

    Parameters
    ----------
    scan : Scan
        Its own normals, if it has any, are replaced.
    scratch : Path
        An existing directory for the samples with their normals, in a directory of their own; the caller removes it
        when done with the scan.
    memory_bytes : int
        Ceiling on the resident size of the process. What is estimated does not depend on it.
    neighbours : int
        k of the fit.
    block, coarse : int
        Samples in memory at a time, and of the orientation field.

    Returns
    -------
    EstimatedScan
        The same samples with ``normal``, **in another order**: block by block, the same in every run; records that
        are not finite come last, with zero normals.

    Raises
    ------
    ScanError
        If the scan cannot be read.
    BuildError
        If the scratch directory cannot be written, or the memory does not suffice.
    """
    needed = _BASE_BYTES + _BYTES_A_SAMPLE * max(block, coarse)
    if memory_bytes < needed:
        raise BuildError(f"estimating normals takes {needed >> 20} MiB of memory; allow as much with --memory")
    sample = CoarseSample(coarse)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for batch in scan.batches(_BATCH):
        xyz = batch.xyz[finite_rows(batch.xyz)]
        low, high = np.minimum(low, xyz.min(0, initial=np.inf)), np.maximum(high, xyz.max(0, initial=-np.inf))
        sample.add(xyz)
    if not sample.seen:
        raise ScanError(f"{scan.info.path}: no sample has a finite position; there is nothing to build")
    field = OrientationField.build(sample.xyz, up=scan.info.crs is not None, k=neighbours)
    blocks = Blocks(sample.xyz, field.reach, neighbours, sample.seen, block)
    try:
        folder = Path(tempfile.mkdtemp(prefix="normals-", dir=scratch))
        return _spool(scan, folder, blocks, field, neighbours, (*map(float, low), *map(float, high)))
    except OSError as error:
        if isinstance(error, ScanError):
            raise
        raise BuildError(f"{scratch}: {error.strerror or error}; free some space or name another directory") from error


def _spool(
    scan: Scan, folder: Path, blocks: Blocks, field: OrientationField, neighbours: int, bounds: tuple[float, ...]
) -> EstimatedScan:
    plain = {name: dtype for name, dtype in scan.info.attributes.items() if name != "normal"}
    row = _row(plain)
    samples = 0
    files = [(folder / f"{block}.core", folder / f"{block}.halo") for block in range(blocks.count)]
    rejected = folder / "rejected"
    for batch in scan.batches(_BATCH):
        records = _pack(batch, row)
        samples += len(records)
        good = finite_rows(batch.xyz)
        _append(rejected, records[~good])
        records, xyz = records[good], batch.xyz[good]
        for block, core, halo in blocks.parts(xyz):
            _append(files[block][0], records[core])
            _append(files[block][1], xyz[halo])
    target = folder / "samples"
    with target.open("wb") as out:
        for core_path, halo_path in files:
            records, around = _take(core_path, row), _take(halo_path, np.dtype((np.float64, 3)))
            if len(records):
                xyz = np.concatenate([records["xyz"], around])
                records["normal"] = block_normals(xyz, len(records), field, neighbours)
                _write(out, records)
        _write(out, _take(rejected, row))
    info = replace(
        scan.info,
        samples_hint=samples,
        bounds_hint=bounds,  # type: ignore[arg-type]
        attributes={**plain, "normal": np.dtype(np.float32)},
        left_out={name: why for name, why in scan.info.left_out.items() if name != "normal"},
    )
    return EstimatedScan(info, target, row)


class EstimatedScan:
    """Samples with estimated normals, read back from the scratch directory; made by `estimate`."""

    def __init__(self, info: ScanInfo, path: Path, row: np.dtype[Any]) -> None:
        self.info = info
        self._path, self._row = path, row

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Read the samples; see `Scan.batches`."""
        with self._path.open("rb") as file:
            while len(records := np.fromfile(file, self._row, size)):
                attributes = {name: np.ascontiguousarray(records[name]) for name in self.info.attributes}
                yield PointBatch(np.ascontiguousarray(records["xyz"]), attributes)


def _row(attributes: dict[str, np.dtype[Any]]) -> np.dtype[Any]:
    fields: list[Any] = [("xyz", np.float64, 3), ("normal", np.float32, 3)]
    return np.dtype(
        fields + [(name, dtype, 3) if name == "color" else (name, dtype) for name, dtype in attributes.items()]
    )


def _pack(batch: PointBatch, row: np.dtype[Any]) -> NDArray[Any]:
    records = np.zeros(len(batch), row)
    records["xyz"] = batch.xyz
    for name in row.names or ():
        if name not in ("xyz", "normal"):
            records[name] = batch.attributes[name]
    return records


def _append(path: Path, rows: NDArray[Any]) -> None:
    # Opened anew each time: a long scan has more blocks than a process may have open files.
    if len(rows):
        with path.open("ab") as file:
            _write(file, rows)


def _write(file: BinaryIO, rows: NDArray[Any]) -> None:
    file.write(np.ascontiguousarray(rows).data if len(rows) else b"")


def _take(path: Path, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Read a block's file and remove it; empty if there is none."""
    if not path.exists():
        return np.empty((0,), dtype)
    rows = np.fromfile(path, dtype)
    path.unlink()
    return rows
