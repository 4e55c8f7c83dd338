"""A build whose buckets are sorted and whose clouds are encoded by the workers of a cluster.

Reading, counting and scattering are passes over one stream of samples and stay here; they are short. Partition and
encode are most of the work, and their pieces know nothing of each other: a function of a bucket's or a run's number
and of values that all pieces share. Those values, and the rows, go through a `Share`; the executor carries numbers one
way, and trees and frames the other. Any `concurrent.futures.Executor` will do. Dask's gives the pieces of a worker that
died to another.

The bytes of the model are those of a build on one machine. Results are taken in the order of the pieces, and a worker
whose versions differ refuses.
"""

from __future__ import annotations

import hashlib
import io
import pickle
import platform
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import zstandard

from lpc.errors import BuildError
from lpc.header import MAJOR

from .publish import GENERATOR
from .share import Share, SharedRegions
from .work import Crew, Item, Result, in_order

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from concurrent.futures import Executor
    from types import TracebackType

    from .folder import Folder
    from .scatter import Regions

WAIT = 20.0
"""Seconds that a scheduler and its first worker have to answer."""


@dataclass(frozen=True, slots=True)
class Cluster:
    """Where the pieces of a build are worked on.

    Parameters
    ----------
    executor : Executor
    ahead : int
        Pieces given out before the first result is back.
    url : str or None
        Folder that all machines share, by the same path or as an fsspec address; None: the build's temporary folder.
    """

    executor: Executor
    ahead: int
    url: str | None = None

    def crew(self, threads: int, folder: Folder) -> ClusterCrew:
        """Join threads here and the workers; the build gets its own part of what they share."""
        if self.url is None:
            return ClusterCrew(threads, self, Share(str(folder.path.resolve() / "share")))
        own = hashlib.blake2b(f"{platform.node()}:{folder.path.resolve()}".encode(), digest_size=8).hexdigest()
        return ClusterCrew(threads, self, Share(f"{self.url.rstrip('/')}/{own}.build"))


class ClusterCrew(Crew):
    """Threads here, and the workers of a cluster.

    Parameters
    ----------
    threads : int
        Here.
    cluster : Cluster
    share : Share
    """

    def __init__(self, threads: int, cluster: Cluster, share: Share) -> None:
        super().__init__(threads)
        self._cluster, self._share = cluster, share

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        super().__exit__(kind, error, trace)
        try:
            self._share.clear()
        except BuildError:
            if error is None:  # what went wrong before says more
                raise

    def share(self, regions: Regions, folder: Folder) -> SharedRegions:
        """Move the scattered rows to the share."""
        shared = SharedRegions(self._share, regions.dtype, regions.first)
        self._share.make()
        journal = folder.journal("share")
        for bucket in range(journal.entries, len(regions.first) - 1):
            shared.take(regions, bucket)
            journal.add(np.array(bucket))
            regions.settle(bucket)  # its room becomes that of the share
        return shared

    def spread(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[tuple[Item, Result]]:
        """Call a function on the workers."""
        data = pickle.dumps(function)
        name = f"task-{hashlib.blake2b(data, digest_size=16).hexdigest()}"
        self._share.make()  # it is gone if a build that goes on had encoded everything
        self._share.put(name, io.BytesIO(data))
        call = partial(perform, self._share, name, versions())
        return in_order(lambda item: self._cluster.executor.submit(call, item), items, self._cluster.ahead)


def perform(share: Share, name: str, wanted: tuple[str, ...], item: Any) -> Any:
    """Call the function `name` of the share: what a worker does."""
    if versions() != wanted:
        raise BuildError(
            f"a worker has {', '.join(versions())} and the builder {', '.join(wanted)}, which may give other bytes: "
            "install the same versions on all machines"
        )
    return _load(share, name)(item)


@lru_cache(maxsize=2)
def _load(share: Share, name: str) -> Callable[[Any], Any]:
    function: Callable[[Any], Any] = pickle.loads(share.get(name))
    return function


def versions() -> tuple[str, ...]:
    """Everything that the bytes of a model depend on besides its samples and options."""
    zstd = ".".join(map(str, zstandard.ZSTD_VERSION))
    return GENERATOR, f"format {MAJOR}", f"numpy {np.__version__}", f"numba {numba.__version__}", f"zstd {zstd}"


@contextmanager
def dask_cluster(address: str, url: str | None) -> Iterator[Cluster]:
    """Use the workers of a Dask scheduler.

    Parameters
    ----------
    address : str
        Of the scheduler, ``tcp://host:8786``.
    url : str or None
        See `Cluster`.

    Raises
    ------
    BuildError
        If Dask is not installed, no scheduler or worker answers, or workers keep dying.
    """
    try:
        from distributed import Client, KilledWorker
        from distributed.client import FutureCancelledError
        from distributed.comm.core import CommClosedError
    except ImportError as error:
        raise BuildError(f"--dask needs more packages: pip install 'pointstream[cluster]' ({error})") from error
    try:
        client = Client(address, timeout=WAIT, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise BuildError(f"no Dask scheduler answers at {address}: start one, or correct the address") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=WAIT)
        except TimeoutError as error:
            raise BuildError(f"the Dask scheduler at {address} has no workers: start some") from error
        cores = sum(client.nthreads().values())
        try:
            yield Cluster(client.get_executor(), 2 * cores + 2, url)
        except KilledWorker as error:
            raise BuildError(
                "several workers in turn died of the same piece: give each thread of a worker the memory of one "
                "bucket, or let the build choose smaller ones (--memory)"
            ) from error
        except (FutureCancelledError, CommClosedError) as error:
            raise BuildError(f"the Dask scheduler at {address} went away") from error
