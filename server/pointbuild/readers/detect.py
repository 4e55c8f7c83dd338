"""Which reader a file takes: by its first bytes where they tell, else by its suffix."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from lpc.errors import LpcError, ScanError
from lpc.points import PointBatch

from .directory import DirectoryScan, scan_files
from .scan import CUT_SHORT, Normals, ReadOptions, Scan, ScanInfo

_KINDS = {
    "PLY": (".ply",),
    "LAS": (".las", ".laz"),
    "E57": (".e57",),
    "PCD": (".pcd",),
    "NPZ": (".npz",),
    "OBJ": (".obj",),
    "text": (".xyz", ".pts", ".csv", ".txt", ".asc", ".xyzrgb", ".xyzn"),
}
_KIND_OF = {suffix: kind for kind, suffixes in _KINDS.items() for suffix in suffixes}
SUFFIXES = frozenset(_KIND_OF)
_HEAD = 1 << 12
_ADDRESS = re.compile(r"([a-z][a-z0-9+]+):/+(.*)")
"""An address, also one that was taken for a path: that makes one slash of two."""


def open_scan(
    path: str | Path, *, normals: Normals = "auto", attributes: Literal["default", "all"] = "default"
) -> Scan:
    """Open a scan file for reading.

    Parameters
    ----------
    path : str or Path
        PLY, LAS, LAZ, E57, PCD, NPZ, OBJ, or text (XYZ, PTS, CSV, TXT, ASC); or a directory of such files.
    normals, attributes
        See `ReadOptions`.

    Raises
    ------
    ScanError
        If the file is missing, empty, of no known kind, or its head cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        files = scan_files(path, SUFFIXES)
        return DirectoryScan(path, [open_scan(file, normals=normals, attributes=attributes) for file in files])
    kind = detect(path)
    try:
        scan = _reader(kind, path, ReadOptions(normals=normals, attributes=attributes))
    except BaseException as error:
        raise _translated(error, path, kind) from error
    if scan.info.samples_hint == 0:
        raise ScanError(f"{path}: holds no samples; there is nothing to build")
    return _CheckedScan(scan, kind)


def detect(path: Path) -> str:
    """Kind of a file, a key of the table of kinds.

    Raises
    ------
    ScanError
        If there is none, or the content is not what the suffix says.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError as error:
        if (address := _ADDRESS.match(str(path))) is not None:
            here = f"{address[1]}://{address[2]}"
            raise ScanError(f"{here}: scans are read from files; fetch it first, and name the file") from error
        raise ScanError(f"{path}: {error.strerror or error}; name a scan file") from error
    if not head:
        raise ScanError(f"{path}: is empty; there is nothing to build")
    by_content = _kind_of(head)
    by_suffix = _KIND_OF.get(path.suffix.lower())
    if by_content is None and by_suffix in ("OBJ", "text") and b"\0" not in head:
        return by_suffix
    if by_content is not None:
        # numbers alone do not tell an OBJ without vertices near its start from text, nor the reverse
        return by_suffix if by_content == "text" and by_suffix == "OBJ" else by_content
    if by_suffix is not None:
        raise ScanError(f"{path}: is no {by_suffix} file, whatever its name says; check where it came from")
    known = ", ".join(suffix for suffixes in _KINDS.values() for suffix in suffixes)
    raise ScanError(f"{path}: is of no kind that can be read; convert it to one of {known}")


def _kind_of(head: bytes) -> str | None:
    for magic, kind in ((b"LASF", "LAS"), (b"ASTM-E57", "E57"), (b"PK\x03\x04", "NPZ")):
        if head.startswith(magic):
            return kind
    if re.match(rb"ply[ \t]*[\r\n]", head):
        return "PLY"
    if b"\0" not in head.split(b"DATA", 1)[0] and re.search(rb"^FIELDS\s", head, re.MULTILINE):
        return "PCD"
    if b"\0" in head:
        return None
    lines = [line.split() for line in re.split(rb"[\r\n]+", head)[:-1] or [head]]
    if any(words[0] == b"v" and len(words) >= 4 for words in lines if words):
        return "OBJ"
    number = rb"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"
    if re.search(rb"^\s*" + number + rb"([\s,;]+" + number + rb"){2}", head, re.MULTILINE):
        return "text"
    return None


def _reader(kind: str, path: Path, options: ReadOptions) -> Scan:
    """Import only the reader that is needed: some of the libraries take longer to load than a small scan."""
    match kind:
        case "PLY":
            from .ply import PlyScan

            return PlyScan(path, options)
        case "LAS":
            from .las import LasScan

            return LasScan(path, options)
        case "E57":
            from .e57 import E57Scan

            return E57Scan(path, options)
        case "PCD":
            from .pcd import PcdScan

            return PcdScan(path, options)
        case "NPZ":
            from .npz import NpzScan

            return NpzScan(path, options)
        case "OBJ":
            from .obj import ObjScan

            return ObjScan(path, options)
        case _:
            from .text import TextScan

            return TextScan(path, options)


def _translated(error: BaseException, path: Path, kind: str) -> BaseException:
    """Turn what the libraries raise into a ScanError of one line."""
    if isinstance(error, LpcError):
        text = str(error)
        return error if text.startswith(str(path)) else ScanError(f"{path}: {text}")
    if isinstance(error, ImportError):
        return ScanError(f"{path}: reading {kind} needs {error.name}; install pointstream[server]")
    # lazrs is written in Rust, whose panics come as a BaseException of their own.
    if isinstance(error, Exception) or type(error).__name__ == "PanicException":
        said = (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
        return ScanError(f"{path}: cannot be read as {kind} ({said}); the file is damaged, copy it again")
    return error


class _CheckedScan:
    """A scan whose foreign exceptions become ScanErrors and whose number of samples is what the file declares."""

    def __init__(self, scan: Scan, kind: str) -> None:
        self._scan, self._kind = scan, kind

    @property
    def info(self) -> ScanInfo:
        return self._scan.info

    def batches(self, size: int) -> Iterator[PointBatch]:
        if size < 1:
            raise ValueError(f"batches of {size} samples")
        info, found = self.info, 0
        batches = self._scan.batches(size)
        while True:
            try:
                batch = next(batches, None)
            except BaseException as error:
                raise self._explained(error, found) from error
            if batch is None:
                break
            found += len(batch)
            yield batch
        if info.samples_hint is not None and found != info.samples_hint:
            raise ScanError(f"{info.path}: declares {info.samples_hint:,} samples, holds {found:,}; {CUT_SHORT}")
        if not found:
            raise ScanError(f"{info.path}: holds no samples; there is nothing to build")

    def _explained(self, error: BaseException, found: int) -> BaseException:
        told = _translated(error, self.info.path, self._kind)
        if isinstance(error, LpcError) or self.info.samples_hint is None or not isinstance(told, ScanError):
            return told
        return ScanError(f"{told} [{found:,} of {self.info.samples_hint:,} declared samples were read]")
