"""Time that jumps: exact, in order, and never waiting for what cannot come."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import anyio
import pytest

from pointlink.virtual import VirtualDeadlockError, run

if TYPE_CHECKING:
    from collections.abc import Callable


def test_a_long_wait_takes_no_real_time_and_exactly_its_virtual_time() -> None:
    async def main() -> float:
        await asyncio.sleep(86_400.125)
        return asyncio.get_running_loop().time()

    assert run(main()) == 86_400.125


def test_equal_deadlines_fire_in_the_order_of_their_calls() -> None:
    async def main() -> list[int]:
        loop = asyncio.get_running_loop()
        fired: list[int] = []
        for number in range(200):
            loop.call_at(1.0 + (number % 3), fired.append, number)
        await asyncio.sleep(10)
        return fired

    assert run(main()) == [number for rest in range(3) for number in range(200) if number % 3 == rest]


def test_a_cancelled_timer_neither_fires_nor_moves_time() -> None:
    async def main() -> tuple[list[str], float]:
        loop = asyncio.get_running_loop()
        fired: list[str] = []
        loop.call_later(5, fired.append, "late").cancel()
        same_moment = loop.call_at(2.0, fired.append, "cancelled by the one before")
        loop.call_at(1.0, same_moment.cancel)
        await asyncio.sleep(3)
        return fired, loop.time()

    assert run(main()) == ([], 3.0)


def test_a_timer_cancelled_in_the_moment_it_falls_due_does_not_fire() -> None:
    async def main() -> list[str]:
        loop = asyncio.get_running_loop()
        fired: list[str] = []
        later: list[asyncio.TimerHandle] = []
        loop.call_at(1.0, lambda: later[0].cancel())
        later.append(loop.call_at(1.0, fired.append, "both were due"))
        await asyncio.sleep(2)
        return fired

    assert run(main()) == []


def test_timeouts_cut_at_their_time() -> None:
    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        cuts = []
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.25):
                await asyncio.sleep(1)
        cuts.append(loop.time())
        with anyio.move_on_after(0.5):
            await anyio.sleep_forever()
        cuts.append(loop.time())
        assert await asyncio.wait_for(asyncio.sleep(0.25, "in time"), 1) == "in time"
        return [*cuts, loop.time()]

    assert run(main()) == [0.25, 0.75, 1.0]


def test_executor_work_is_done_at_once_and_its_errors_come_back() -> None:
    async def main() -> tuple[int, float]:
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(lambda: 1 // 0)
        return await asyncio.to_thread(sum, [1, 2]), asyncio.get_running_loop().time()

    assert run(main()) == (3, 0.0)


def test_waiting_for_ever_is_an_error_that_names_the_task_and_the_place() -> None:
    async def stuck_here() -> None:
        asyncio.get_running_loop().call_later(100, lambda: None).cancel()
        await asyncio.sleep(1.5)
        await asyncio.Event().wait()

    with pytest.raises(VirtualDeadlockError, match=r"virtual deadlock at 1\.5 s.*stuck_here"):
        run(stuck_here())


def test_a_real_socket_is_refused() -> None:
    async def main() -> None:
        await asyncio.open_connection("127.0.0.1", 9)

    with pytest.raises(RuntimeError, match="real socket"):
        run(main())


def test_runs_are_identical() -> None:
    async def main() -> list[tuple[float, int]]:
        trace: list[tuple[float, int]] = []
        lock = asyncio.Lock()

        async def worker(number: int, nap: Callable[[int], float]) -> None:
            for turn in range(20):
                async with lock:
                    await asyncio.sleep(nap(turn))
                trace.append((asyncio.get_running_loop().time(), number))
                await asyncio.sleep(0.1)

        async with asyncio.TaskGroup() as group:
            for number in range(5):
                group.create_task(worker(number, lambda turn, number=number: (turn * 7 + number) % 4 / 10))
        return trace

    assert run(main()) == run(main())
