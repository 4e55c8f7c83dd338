"""Rows of buckets where several machines reach them: whole files that are written once and never changed.

That is what a folder on shared disks and a store of the S3 kind have in common. A bucket's rows are put there as they
were scattered; whoever sorts them puts them beside as another file. So a worker may die at any moment, and two may
do the same work.
"""

from __future__ import annotations

import shutil
import tempfile
import uuid
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from lpc.errors import BuildError

from .rows import in_chunks
from .spool import write_all

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fsspec import AbstractFileSystem
    from numpy.typing import NDArray

    from .scatter import Regions

_PIECE = 1 << 16  # rows, or bytes, copied at a time


@dataclass(frozen=True, slots=True)
class Share:
    """A folder of files by name.

    Parameters
    ----------
    url : str
        A path that is the same on all machines, or an fsspec address such as ``s3://bucket/folder``.
    """

    url: str

    def put(self, name: str, source: BinaryIO) -> None:
        """Copy a file from its start; nobody ever sees half of the copy."""
        source.seek(0)
        with self._files("cannot be written to") as (files, root):
            # A store shows a file when it is complete; a folder would show it before.
            part = f"{name}.{uuid.uuid4().hex}" if _is_folder(files) else name
            with files.open(f"{root}/{part}", "wb") as target:
                shutil.copyfileobj(source, target, _PIECE)
            if part != name:
                Path(root, part).replace(Path(root, name))

    def get(self, name: str, start: int | None = None, stop: int | None = None) -> bytes:
        """Bytes `start` to `stop` of a file."""
        absent = (
            f"does not hold {name}, or a worker does not reach it: name a folder or a store that all machines share"
        )
        with self._files(absent) as (files, root):
            found: bytes = files.cat_file(f"{root}/{name}", start=start, end=stop)  # by name: stores order them unlike
        return found

    def remove(self, name: str) -> None:
        """Remove a file that is there."""
        with self._files("cannot be cleared") as (files, root):
            files.rm_file(f"{root}/{name}")

    def make(self) -> None:
        """Make the folder; in a store, see that what it would be in is there."""
        with self._files("cannot be made") as (files, root), suppress(FileExistsError):
            # Parents in a store are buckets, and a misspelt one is not to be made.
            files.mkdir(root, create_parents=_is_folder(files))

    def clear(self) -> None:
        """Remove everything, the folder too."""
        with self._files("cannot be cleared") as (files, root):
            if files.exists(root):
                files.rm(root, recursive=True)

    @contextmanager
    def _files(self, problem: str) -> Iterator[tuple[AbstractFileSystem, str]]:
        """Give the file system and the folder in it; whatever goes wrong becomes a sentence."""
        from fsspec.core import url_to_fs  # part of the extra "cluster"

        try:
            # Listings that are kept would not know what workers have put there since.
            files, root = url_to_fs(self.url, use_listings_cache=False)
            yield files, str(root)
        except Exception as error:  # every kind of store has exceptions of its own, and few are OSError
            why = " ".join(str(error).split()) or type(error).__name__
            raise BuildError(f"{self.url} {problem} ({why})") from error


def _is_folder(files: AbstractFileSystem) -> bool:
    return "file" in ((files.protocol,) if isinstance(files.protocol, str) else files.protocol)


class SharedRegions:
    """`Regions` whose buckets are files of a share; it may be sent to other processes.

    Parameters
    ----------
    share : Share
    dtype : dtype
        Of a row.
    first : ndarray, (buckets + 1,) int64
        Where each bucket's rows begin.
    kind : str
        Which of a bucket's files `read` reads: as they were ``scattered`` or ``sorted``.
    """

    def __init__(self, share: Share, dtype: np.dtype[Any], first: NDArray[np.int64], kind: str = "scattered") -> None:
        self.share, self.dtype, self.first, self._kind = share, dtype, first, kind

    def take(self, regions: Regions, bucket: int) -> None:
        """Copy a bucket's rows as they were scattered."""
        first, stop = regions.first[bucket : bucket + 2].tolist()
        with tempfile.TemporaryFile() as file:
            for rows in regions.chunks(first, stop - first, _PIECE):
                file.write(rows.view(np.uint8).data)
            self.share.put(f"scattered-{bucket}", file)

    def replaced(self) -> SharedRegions:
        """Give the rows after every bucket was replaced."""
        return SharedRegions(self.share, self.dtype, self.first, "sorted")

    def remove(self) -> None:
        """Remove all files of the share."""
        self.share.clear()

    def read(self, row: int, out: NDArray[Any]) -> None:
        """Fill `out` with rows from number `row` on, all of one bucket."""
        if not len(out):
            return
        bucket = self._bucket(row)
        start = (row - int(self.first[bucket])) * self.dtype.itemsize
        data = self.share.get(f"{self._kind}-{bucket}", start, start + out.nbytes)
        if len(data) != out.nbytes:
            raise BuildError(f"{self.share.url} holds fewer rows than it did: is another program cleaning up?")
        out[:] = np.frombuffer(data, self.dtype)

    def chunks(self, row: int, count: int, most: int) -> Iterator[NDArray[Any]]:
        """Yield `count` rows from number `row` on, at most `most` at a time."""
        return in_chunks(self, row, count, most)

    def replace(self, row: int, rows: NDArray[Any]) -> None:
        """Put all rows of a bucket, which begins at number `row`, in another order."""
        with self.rewriting(row) as file:
            write_all(file, rows, 0)

    @contextmanager
    def rewriting(self, row: int) -> Iterator[int]:
        """Do so with a file that they are to be written to."""
        with tempfile.TemporaryFile() as file:
            yield file.fileno()
            self.share.put(f"sorted-{self._bucket(row)}", file)

    def settle(self, bucket: int) -> None:
        """Remove the rows of a bucket as they were scattered."""
        self.share.remove(f"scattered-{bucket}")

    def _bucket(self, row: int) -> int:
        return int(np.searchsorted(self.first, row, side="right")) - 1
