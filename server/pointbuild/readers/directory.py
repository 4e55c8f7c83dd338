"""A directory of scan files: tiles, in the order of their names, as one scan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lpc.errors import ScanError
from lpc.points import PointBatch

from .scan import Scan, ScanInfo

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path


def scan_files(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    """Files of a directory that a reader takes, hidden ones and directories in it left aside.

    Raises
    ------
    ScanError
        If there is none.
    """
    files = sorted(folder.iterdir(), key=lambda path: path.name)
    found = [path for path in files if path.suffix.lower() in suffixes and path.name[0] != "." and path.is_file()]
    if not found:
        raise ScanError(f"the directory {folder} holds no scan; name one that does, or files")
    return found


class DirectoryScan:
    """Scans one after another, with the attributes that all have with one dtype.

    Parameters
    ----------
    folder : Path
    scans : sequence of Scan
    """

    def __init__(self, folder: Path, scans: Sequence[Scan]) -> None:
        self._scans = tuple(scans)
        infos = [scan.info for scan in scans]
        attributes = {
            name: np.dtype(dtype)
            for name, dtype in infos[0].attributes.items()
            if all(info.attributes.get(name) == dtype for info in infos)
        }
        hints = [info.samples_hint for info in infos]
        self.info = ScanInfo(
            path=folder,
            samples_hint=None if None in hints else sum(hint for hint in hints if hint is not None),
            crs=infos[0].crs,
            attributes=attributes,
            raw_bytes=sum(info.raw_bytes for info in infos),
        )

    def batches(self, size: int) -> Iterator[PointBatch]:
        """Read the scans in turn; see `Scan.batches`."""
        for scan in self._scans:
            for batch in scan.batches(size):
                yield PointBatch(batch.xyz, {name: batch.attributes[name] for name in self.info.attributes})
