"""The disk cache: one sparse file for each build of each host, bounded in bytes, least recently used models first out.

::

    DIR/addresses/<hash of an address>          the build id that stood there last
    DIR/<build id>-<hash of the host>/model.lpc            and its map (stores/sparse.py)

The build id is in the key, so ranges of an old build can never be mixed with those of a new one. The host is in it too:
that header and pages belong to a build id is proven only when all of them are here, and until then one host could
pass its own pages for another's model. Deleting the folder, or any part of it, at any time is safe.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from .stores.sparse import SparseFile, map_path

if TYPE_CHECKING:
    from pathlib import Path

    from lpc.header import Header

LIMIT = 4 << 30
MODEL = "model.lpc"
_DIGEST = re.compile(r"[0-9a-f]{32}")


class Cache:
    """A folder of models, whole or in part. Several processes may use one at a time.

    Parameters
    ----------
    folder : Path
        Made when the first model is kept.
    limit : int
        Bytes on the disk, at most. A single model stops growing there.
    """

    def __init__(self, folder: Path, *, limit: int = LIMIT) -> None:
        self.folder, self.limit = folder, limit

    def __repr__(self) -> str:
        return f"<Cache {self.folder}>"

    def __str__(self) -> str:
        return f"the cache {self.folder}"

    def last_build(self, address: str) -> str | None:
        """Return the build id that stood at an address when it was last read."""
        try:
            digest = self._address(address).read_text("ascii")
        except (OSError, ValueError):
            return None
        return digest if _DIGEST.fullmatch(digest) else None

    def remember(self, address: str, digest: str) -> None:
        """Note the build id that stands at an address.

        Raises
        ------
        OSError
        """
        if self.last_build(address) == digest:
            return
        place = self._address(address)
        place.parent.mkdir(parents=True, exist_ok=True)
        fresh = place.with_name(f"{place.name}.{os.getpid()}")
        fresh.write_text(digest, "ascii")
        fresh.replace(place)

    def find(self, address: str, digest: str) -> Path | None:
        """Return the file of a build, if anything of it is here."""
        path = self._entry(address, digest) / MODEL
        return path if path.is_file() else None

    def open(self, address: str, header: Header) -> SparseFile:
        """Open the file of a build, made if it is not there, and count it as used now.

        Raises
        ------
        OSError
        """
        entry = self._entry(address, header.digest)
        entry.mkdir(parents=True, exist_ok=True)
        os.utime(entry)
        return SparseFile(entry / MODEL, length=header.bytes, tag=header.tag)

    def room(self, keep: Path, size: int) -> int:
        """Clear away what was used least recently until there is room for `size` bytes; return the bytes free then.

        Parameters
        ----------
        keep : Path
            The file in use: never cleared.
        size : int
        """
        sizes, ages = {}, {}
        with contextlib.suppress(OSError):
            for entry in self.folder.iterdir():
                if entry.name != "addresses":
                    with contextlib.suppress(OSError):
                        sizes[entry], ages[entry] = _bytes_on_disk(entry), entry.stat().st_mtime
        total = sum(sizes.values())
        for entry in sorted(sizes, key=ages.__getitem__):
            if total + size <= self.limit:
                break
            if entry != keep.parent and self.clear(entry):
                total -= sizes[entry]
        return self.limit - total

    def clear(self, entry: Path) -> bool:
        """Clear an entry away; False if the system does not let us."""
        # Renamed first: whoever opens it meanwhile finds all of it or nothing.
        gone = entry.with_name(f"cleared-{os.getpid()}-{entry.name}")
        try:
            entry.rename(gone)
        except OSError:
            return False
        shutil.rmtree(gone, ignore_errors=True)
        return True

    def _entry(self, address: str, digest: str) -> Path:
        parts = urlsplit(address)
        return self.folder / f"{digest}-{_hash(f'{parts.scheme}://{parts.netloc}', 8)}"

    def _address(self, address: str) -> Path:
        return self.folder / "addresses" / _hash(address, 16)  # hashed: addresses may carry signatures


def _bytes_on_disk(entry: Path) -> int:
    total = 0
    for path in (entry / MODEL, map_path(entry / MODEL)):
        with contextlib.suppress(FileNotFoundError):
            facts = path.stat()
            total += facts.st_blocks * 512 if hasattr(facts, "st_blocks") else facts.st_size
    return total


def _hash(text: str, size: int) -> str:
    return hashlib.blake2b(text.encode(), digest_size=size).hexdigest()
