"""Who is told how far a build is."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, Self, TextIO

from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as RichProgress

if TYPE_CHECKING:
    from types import TracebackType

    from rich.console import Console

Clock = Callable[[], float]


class Progress(Protocol):
    """Stages come one after another; each counts samples."""

    def stage(self, name: str, total: int | None, /) -> None:
        """Begin a stage of `total` samples (None: not known)."""
        ...

    def advance(self, samples: int, /) -> None:
        """Say that so many more samples of the stage are done."""
        ...


class Silent:
    """Tells nobody."""

    def stage(self, name: str, total: int | None) -> None:
        """Ignore it."""

    def advance(self, samples: int) -> None:
        """Ignore it."""


class Lines:
    """One plain line when a stage ends, for logs.

    Parameters
    ----------
    out : TextIO
    clock : callable
        Seconds, monotonic.
    """

    def __init__(self, out: TextIO, clock: Clock) -> None:
        self._out, self._clock = out, clock
        self._name, self._done, self._began = "", 0, 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._finish() if error is None else None

    def stage(self, name: str, _total: int | None) -> None:
        """End the stage before, begin this one."""
        self._finish()
        self._name, self._done, self._began = name, 0, self._clock()

    def advance(self, samples: int) -> None:
        """Count."""
        self._done += samples

    def _finish(self) -> None:
        if self._name:
            self._out.write(f"{self._name}: {self._done:,} samples, {self._clock() - self._began:.1f} s\n")
            self._out.flush()
            self._name = ""


class Bar:
    """A bar on a terminal."""

    def __init__(self, console: Console) -> None:
        self._rich = RichProgress(
            TextColumn("{task.description:<10}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
        )
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        self._rich.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._rich.stop()

    def stage(self, name: str, total: int | None) -> None:
        """Begin a bar of its own."""
        self._task = self._rich.add_task(name, total=total)

    def advance(self, samples: int) -> None:
        """Move the bar."""
        if self._task is not None:
            self._rich.advance(self._task, samples)
