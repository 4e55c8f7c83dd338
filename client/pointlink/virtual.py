"""An event loop whose clock is virtual: waiting costs nothing, and every run is the same run.

When no callback is ready, time jumps to the next timer. ``asyncio.sleep``, timeouts, anyio and httpcore work on it
unchanged. Timers of equal deadline fire in the order in which they were set (asyncio's own heap does not promise that),
and work for an executor is done inline, in no virtual time. What this cannot wait for is the real world: sockets are
refused, and threads that are started past :meth:`~VirtualClockLoop.run_in_executor` are never heard.

What stays with the caller, for runs to be identical: random generators with seeds, and no iteration over sets of tasks,
whose order changes from run to run (``asyncio.wait`` returns such sets).
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import selectors
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, TypeVarTuple, Unpack

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping
    from concurrent.futures import Executor
    from contextvars import Context

T = TypeVar("T")
Ts = TypeVarTuple("Ts")


class VirtualDeadlockError(RuntimeError):
    """Every task waits for what nothing scheduled can bring: an error in the program on the clock, not of a user."""


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine to its end on a fresh virtual clock that starts at 0.0 s; return its result.

    Raises
    ------
    VirtualDeadlockError
        The coroutine waits for ever.
    """
    with asyncio.Runner(loop_factory=VirtualClockLoop) as runner:
        return runner.run(main)


class VirtualClockLoop(asyncio.SelectorEventLoop):
    """The loop of :func:`run`; ``loop_factory=VirtualClockLoop`` puts it under an ``asyncio.Runner`` or a test."""

    def __init__(self) -> None:
        self._clock = 0.0
        self._timers: list[_Timer] = []
        self._order = itertools.count()
        super().__init__(_NoSockets(self._jump))

    def time(self) -> float:
        """Return the virtual time in seconds since the loop was made."""
        return self._clock

    def call_later(
        self, delay: float, callback: Callable[[Unpack[Ts]], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """Schedule a callback after ``delay`` virtual seconds."""
        return self.call_at(self._clock + delay, callback, *args, context=context)

    def call_at(
        self, when: float, callback: Callable[[Unpack[Ts]], object], *args: *Ts, context: Context | None = None
    ) -> asyncio.TimerHandle:
        """Schedule a callback at a virtual time; equal times fire in the order of their calls."""
        handle = asyncio.TimerHandle(when, callback, args, self, context)

        def fire() -> None:
            # Between falling due and this turn another callback may have cancelled it.
            if not handle.cancelled():
                callback(*args)

        heapq.heappush(self._timers, _Timer(when, next(self._order), handle, fire, context))
        return handle

    def run_in_executor(
        self, executor: Executor | None, func: Callable[[Unpack[Ts]], T], *args: *Ts
    ) -> asyncio.Future[T]:
        """Call ``func`` here and now; no virtual time passes."""
        del executor
        future: asyncio.Future[T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:
            future.set_exception(error)
        return future

    def _jump(self) -> None:
        """Move time to the next timer and make all that are due then ready (called when no callback is)."""
        self._drop_cancelled()
        if not self._timers:
            raise VirtualDeadlockError(
                f"virtual deadlock at {self._clock:g} s: no timer is set, and {self._waiting_tasks()}"
            )
        self._clock = max(self._clock, self._timers[0].when)
        while self._timers and self._timers[0].when <= self._clock:
            timer = heapq.heappop(self._timers)
            if not timer.handle.cancelled():
                self.call_soon(timer.fire, context=timer.context)

    def _drop_cancelled(self) -> None:
        while self._timers and self._timers[0].handle.cancelled():
            heapq.heappop(self._timers)

    def _waiting_tasks(self) -> str:
        places = []
        for task in asyncio.all_tasks(self):
            frames = task.get_stack()
            where = f"{frames[-1].f_code.co_qualname}:{frames[-1].f_lineno}" if frames else "its end"
            places.append(f"{task.get_name()} ({where})")
        return "these tasks wait for ever: " + ", ".join(sorted(places)) if places else "there is no task"


class _Timer(NamedTuple):
    when: float
    order: int
    handle: asyncio.TimerHandle
    fire: Callable[[], None]
    context: Context | None


class _NoSockets(selectors.BaseSelector):
    """A selector that never waits: it asks the loop to jump. It takes the loop's own wake-up pipe and nothing else."""

    def __init__(self, jump: Callable[[], None]) -> None:
        self._jump = jump
        self._keys: dict[Any, selectors.SelectorKey] = {}

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        if self._keys:
            raise RuntimeError("a virtual clock cannot wait for a real socket: use pointlink.memory or a real loop")
        self._keys[fileobj] = selectors.SelectorKey(fileobj, int(fileobj), events, data)
        return self._keys[fileobj]

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        return self._keys.pop(fileobj)

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        # asyncio knows none of our timers: it gives None exactly when nothing is ready and nobody asked it to stop.
        if timeout is None:
            self._jump()
        return []

    def get_key(self, fileobj: Any) -> selectors.SelectorKey:
        return self._keys[fileobj]

    def get_map(self) -> Mapping[Any, selectors.SelectorKey]:
        return self._keys

    def close(self) -> None:
        self._keys.clear()
