"""The threads of a build.

numba kernels, numpy's sort, zstd and file calls all let go of the interpreter, so threads keep all cores busy and
nothing is copied between processes. Work is given out a little ahead and taken back in order.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Self, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from types import TracebackType

    from .folder import Folder
    from .rows import Rows
    from .scatter import Regions

Item = TypeVar("Item")
Result = TypeVar("Result")


class Crew:
    """A fixed number of threads.

    Parameters
    ----------
    threads : int
    """

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="build")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(cancel_futures=True)

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[tuple[Item, Result]]:
        """Yield every item with ``function(item)``, in the order of the items.

        One item more than there are threads is under way or waiting to be yielded, which is what bounds the memory.
        When the caller stops or a call fails, what has not begun is cancelled and what has is waited for.
        """
        return in_order(lambda item: self._pool.submit(function, item), items, self.threads)

    def share(self, regions: Regions, folder: Folder) -> Rows:  # noqa: ARG002, others need the folder
        """Take the scattered rows where all that `spread` runs can reach them: they are there already."""
        return regions

    def spread(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[tuple[Item, Result]]:
        """Do as `map` does, on other machines if there are any; the function and the items can be pickled."""
        return self.map(function, items)


def in_order(
    submit: Callable[[Item], Future[Result]], items: Iterable[Item], ahead: int
) -> Iterator[tuple[Item, Result]]:
    """Yield every item with its result, in the order of the items, while up to `ahead` more are submitted."""
    flying: deque[tuple[Item, Future[Result]]] = deque()
    try:
        for item in items:
            if len(flying) > ahead:
                first, future = flying.popleft()
                yield first, future.result()
            flying.append((item, submit(item)))
        while flying:
            first, future = flying.popleft()
            yield first, future.result()
    finally:
        for _, future in flying:
            future.cancel()
        for _, future in flying:
            if not future.cancelled():
                future.exception()
