"""The folder of a build's temporary files: whose it is, whether it can be gone on with, and that it goes.

It is hidden, stands beside the output (or in --scratch) and is named after it. However a build ends, it goes, except by
SIGKILL or a crash: then the next build of the same output finds its journals. It goes on from them if the *manifest* is
the one that it would write itself: same inputs, same options, same program, and the system was not restarted since
(what had not reached the disk then is unknown). A lock on the folder keeps a second build out.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import platform
import shutil
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import zstandard

from lpc.errors import BuildError

from .journal import Journal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from .options import BuildOptions

LAYOUT = 4
"""Of the folder's files; a change of any of them makes it another."""

_ENDS = 1 << 16  # bytes hashed at both ends of an input
_MANIFEST = "manifest.json"
_WRITTEN = "written"


@dataclass(frozen=True, slots=True)
class Folder:
    """A build's temporary files.

    Parameters
    ----------
    path : Path
    recalled : bool
        They are those of a build that was killed.
    """

    path: Path
    recalled: bool = False

    def journal(self, name: str) -> Journal:
        """Open the journal of a stage."""
        return Journal(self.path / f"{name}.journal")

    def note_written(self, digest: str) -> None:
        """Say which model is about to take its name; see `was_written`."""
        file = self.path / _MANIFEST
        if file.exists():
            told = {"digest": digest, "build": _without_first(json.loads(file.read_bytes()))}
            (self.path / _WRITTEN).write_text(json.dumps(told))

    def part_of(self, out: Path) -> Path:
        """Name of the unfinished model: in the folder, or beside the model if that is on another disk."""
        if self.path.stat().st_dev == out.parent.stat().st_dev:
            return self.path / "model"
        name = hashlib.blake2b(os.fsencode(self.path.resolve()), digest_size=4).hexdigest()
        return out.with_name(f".{out.name}.{name}.part")

    def used_bytes(self) -> int:
        """Disk that the files take."""
        return sum(path.stat().st_blocks * 512 for path in self.path.rglob("*"))

    def remove(self, pattern: str) -> None:
        """Remove files and folders that are not needed any more."""
        for path in self.path.glob(pattern):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


def manifest_of(sources: Sequence[object], options: BuildOptions, generator: str) -> dict[str, Any] | None:
    """Everything that the temporary files depend on; None if some source is no file, so that nothing can be said."""
    inputs = []
    for source in sources:
        if not isinstance(source, str | Path):
            return None
        try:
            inputs.append(_fingerprint(Path(source)))
        except OSError:
            return None  # whoever reads it says why
    chosen = {name: value for name, value in asdict(options).items() if name != "scratch"}
    chosen["threads"] = options.workers
    versions = {
        "layout": LAYOUT,
        "generator": generator,
        "machine": platform.machine(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
        "zstd": ".".join(map(str, zstandard.ZSTD_VERSION)),
    }
    found: dict[str, Any] = json.loads(
        json.dumps({"inputs": inputs, "options": chosen, "versions": versions, "started": _system_start()})
    )
    return found


def _fingerprint(path: Path) -> list[Any]:
    facts = path.stat()
    digest = hashlib.blake2b(digest_size=16)
    with path.open("rb") as file:
        digest.update(file.read(_ENDS))
        file.seek(max(facts.st_size - _ENDS, 0))
        digest.update(file.read(_ENDS))
    return [os.fspath(path.resolve()), facts.st_size, facts.st_mtime_ns, digest.hexdigest()]


def _system_start() -> str:
    """Name the current run of the operating system; empty where it has no name."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


@contextmanager
def work_folder(
    parent: Path, out: Path, manifest: dict[str, Any] | None, tell: Callable[[str], None]
) -> Iterator[Folder]:
    """Make or find the folder for the build of `out`; it is removed however the block ends.

    Parameters
    ----------
    parent : Path
        Where it is.
    out : Path
        The model.
    manifest : dict or None
        Of `manifest_of`; None: nothing can be gone on with.
    tell : callable
        Is told what became of files that were there.

    Raises
    ------
    BuildError
        If `parent` is no directory, or another build of the same model runs.
    """
    if not parent.is_dir():
        raise BuildError(f"there is no directory {parent} for temporary files; make it first")
    path = _path_of(parent, out)
    lock = _lock(path, out)
    try:
        yield Folder(path, _recall(path, manifest, tell))
    finally:
        (path / _MANIFEST).unlink(missing_ok=True)  # first: what is half removed must not be recalled
        Folder(path).remove(f"[!{_WRITTEN[0]}]*")  # last: what was written must not be built on
        shutil.rmtree(path, ignore_errors=True)
        os.close(lock)


def _path_of(parent: Path, out: Path) -> Path:
    if parent.resolve() == out.parent.resolve():
        return parent / f".{out.name}.build"
    # Models of one name in several places may share --scratch.
    return parent / f".{out.name}.{hashlib.blake2b(os.fsencode(out.resolve()), digest_size=4).hexdigest()}.build"


def was_written(parent: Path, out: Path, manifest: dict[str, Any], digest: str) -> bool:
    """Whether the build of a manifest was killed when it had written the model of a digest, but not yet tidied up.

    The first input does not count: where scans are added to a model, it is the model itself.
    """
    try:
        found = json.loads((_path_of(parent, out) / _WRITTEN).read_bytes())
    except (OSError, ValueError):
        return False
    return bool(found == {"digest": digest, "build": _without_first(manifest)})


def _without_first(manifest: dict[str, Any]) -> dict[str, Any]:
    return {**manifest, "inputs": manifest["inputs"][1:]}


def _lock(path: Path, out: Path) -> int:
    """Make the folder and lock it; the open descriptor holds the lock."""
    while True:
        try:
            path.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise BuildError(f"{path}: {error.strerror or error}; choose another output or --scratch") from error
        try:
            lock = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            continue  # the build that held it has just removed it
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(lock)
            raise BuildError(f"another build of {out} is running: wait for it, or choose another output") from error
        except OSError:
            return lock  # a file system without locks: two builds at once are their owner's care
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(lock), path.stat()):
                return lock
        os.close(lock)  # of a folder that is gone


def _recall(path: Path, manifest: dict[str, Any] | None, tell: Callable[[str], None]) -> bool:
    """Whether what is in the folder can be gone on with; it is emptied if not."""
    file = path / _MANIFEST
    try:
        found = json.loads(file.read_bytes())
    except (OSError, ValueError):
        found = None
    if found is not None and manifest is not None and found == manifest and manifest["started"]:
        tell(f"going on with the build that was stopped; its files are in {path}")
        return True
    if found is not None:
        tell(f"the files of a stopped build in {path} are of other inputs, options or versions: starting over")
    file.unlink(missing_ok=True)
    Folder(path).remove("*")
    if manifest is not None:
        fresh = path / f"{_MANIFEST}.new"
        fresh.write_text(json.dumps(manifest, indent=1, sort_keys=True))
        fresh.replace(file)
    return False
