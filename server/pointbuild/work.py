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
        flying: deque[tuple[Item, Future[Result]]] = deque()
        try:
            for item in items:
                if len(flying) > self.threads:
                    first, future = flying.popleft()
                    yield first, future.result()
                flying.append((item, self._pool.submit(function, item)))
            while flying:
                first, future = flying.popleft()
                yield first, future.result()
        finally:
            for _, future in flying:
                future.cancel()
            for _, future in flying:
                if not future.cancelled():
                    future.exception()
