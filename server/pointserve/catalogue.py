"""The models of a folder, as they are now.

The folder is walked at most once in `recheck` seconds, and only files that changed are read again, each no further
than its header. A file that is no model, or not yet one, is listed with the reason and hides no other.
"""

from __future__ import annotations

import asyncio
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lpc.errors import FormatError
from lpc.header import HEADER_PROBE, PART_SUFFIX, Header, parse_header

from .files import names_inside
from .paths import MAX_DEPTH, MODEL_SUFFIX, is_plain_name, url_path

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

MAX_MODELS = 100_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One file of the catalogue.

    Parameters
    ----------
    names : tuple of str
        Folders and file below the served folder.
    size : int
        Bytes of the file.
    header : Header or None
        None where the file is broken.
    problem : str or None
        What is wrong with it, one line.
    picture : bool
        Whether a picture stands beside it, its name plus ``.png``.
    """

    names: tuple[str, ...]
    size: int
    header: Header | None = None
    problem: str | None = None
    picture: bool = False

    @property
    def path(self) -> str:
        """Path of its URL."""
        return url_path(self.names)

    @property
    def complete(self) -> bool:
        """Whether the whole file is here; a shorter one is a coarser model."""
        return self.header is not None and self.size >= self.header.bytes

    def to_json(self) -> dict[str, Any]:
        """As it stands in ``/catalogue.json``; the keys are those of `pointstream info` where both have them."""
        head: dict[str, Any] = {"name": "/".join(self.names), "path": self.path, "bytes": self.size}
        if self.picture:
            head["picture"] = self.path + ".png"
        if self.header is None:
            return {**head, "problem": self.problem}
        header = self.header
        return {
            **head,
            "complete": self.complete,
            "samples": header.samples,
            "clouds": header.nodes,
            "levels": header.levels,
            "bits_per_sample": dict(header.bits_per_sample),
            "spacing": header.spacing,
            "position_error": header.position_error,
            "bounds": list(header.bounds),
            "attributes": [attribute.name for attribute in header.attributes] + sorted(header.constants),
            "crs": header.crs,
            "digest": header.digest,
        }


class Catalogue:
    """The models below a folder.

    Parameters
    ----------
    root : Path
        The served folder.
    clock : callable of float
        Monotonic seconds.
    recheck : float
        Seconds for which the last walk is believed.
    """

    def __init__(self, root: Path, *, clock: Callable[[], float], recheck: float = 1.0) -> None:
        self._root = root.resolve()
        self._clock = clock
        self._recheck = recheck
        self._walked: float | None = None
        self._entries: tuple[Entry, ...] = ()
        self._known: dict[tuple[str, ...], tuple[tuple[int, ...], Entry]] = {}
        self._lock = asyncio.Lock()

    async def entries(self) -> tuple[Entry, ...]:
        """Models sorted by name; reading them does not hold up the event loop.

        Raises
        ------
        OSError
            If the served folder itself cannot be read.
        """
        async with self._lock:
            now = self._clock()
            if self._walked is None or now - self._walked >= self._recheck:
                self._entries = await asyncio.get_running_loop().run_in_executor(None, self._walk)
                self._walked = now
            return self._entries

    def _walk(self) -> tuple[Entry, ...]:
        known = {}
        for names, status in _model_files(self._root):
            picture = self._root.joinpath(*names[:-1], names[-1] + ".png").is_file()
            identity = (status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size, picture)
            before = self._known.get(names)
            if before is None or before[0] != identity:
                before = identity, _read_entry(self._root.joinpath(*names), names, status.st_size, picture)
            known[names] = before
        self._known = known
        return tuple(known[names][1] for names in sorted(known))


def _model_files(root: Path) -> Iterator[tuple[tuple[str, ...], os.stat_result]]:
    """Names and status of the models below a folder; folders that cannot be read are passed over, but not the root."""
    found = 0
    folders: list[tuple[str, ...]] = [()]
    while folders:
        names = folders.pop()
        try:
            with os.scandir(root.joinpath(*names)) as listing:
                entries = sorted(listing, key=lambda entry: entry.name)
        except OSError:
            if not names:
                raise
            continue
        here = {entry.name for entry in entries}
        for entry in entries:
            if not is_plain_name(entry.name) or entry.name + PART_SUFFIX in here:
                continue
            try:
                if entry.is_dir(follow_symlinks=False) and len(names) + 2 <= MAX_DEPTH:
                    folders.append((*names, entry.name))
                elif entry.name.endswith(MODEL_SUFFIX) and entry.is_file() and _is_inside(entry, root):
                    yield (*names, entry.name), entry.stat()
                    found += 1
            except OSError:
                continue
            if found >= MAX_MODELS:
                return


def _is_inside(entry: os.DirEntry[str], root: Path) -> bool:
    return not entry.is_symlink() or bool(names_inside(root, Path(entry.path)))


def _read_entry(path: Path, names: tuple[str, ...], size: int, picture: bool) -> Entry:
    try:
        with path.open("rb", buffering=0) as file:
            header = parse_header(file.read(HEADER_PROBE))
    except FormatError as error:
        return Entry(names=names, size=size, problem=str(error), picture=picture)
    except OSError as error:
        return Entry(names=names, size=size, problem=f"cannot be read: {error.strerror}", picture=picture)
    return Entry(names=names, size=size, header=header, picture=picture)
