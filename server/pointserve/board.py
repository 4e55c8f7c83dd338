"""Figures that all workers share: each writes its own row, everybody reads all rows.

The rows stand in one piece of anonymous shared memory, made before the workers are forked. Nobody but its owner writes
a row, so there are no locks; what two workers decide in the same instant may exceed a limit by one each.
"""

from __future__ import annotations

import mmap

import numpy as np

CONNECTIONS, REFUSED, ADMISSION, SENT, CUT = range(5)
"""Columns: open connections, connections sent away, requests not admitted, body bytes sent, replies cut short."""

STATUSES = (200, 204, 206, 304, 400, 401, 404, 405, 412, 416, 500, 503)
FIRST_STATUS = 5
OTHER_STATUS = FIRST_STATUS + len(STATUSES)

SECONDS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 60.0)
"""Upper edges of the buckets in which the lengths of replies are counted; one more column beyond them."""

FIRST_SECONDS = OTHER_STATUS + 1
SECONDS_SUM = FIRST_SECONDS + len(SECONDS) + 1

FIRST_PEER = SECONDS_SUM + 1
PEERS = 4096
"""Connections by address, in a table of hashes: two addresses of equal hash count as one."""

COLUMNS = FIRST_PEER + PEERS


class Board:
    """Figures of a number of workers.

    Parameters
    ----------
    workers : int
    """

    def __init__(self, workers: int = 1) -> None:
        memory = mmap.mmap(-1, 8 * COLUMNS * workers)
        self._memory = memoryview(memory).cast("d")
        self.rows = np.frombuffer(memory, dtype=np.float64).reshape(workers, COLUMNS)

    def seat(self, worker: int) -> Seat:
        """Return the place of one worker; what its predecessor left open is forgotten, what it counted stays."""
        self.rows[worker, CONNECTIONS] = 0
        self.rows[worker, FIRST_PEER:] = 0
        return Seat(self, worker, self._memory[worker * COLUMNS : (worker + 1) * COLUMNS])

    def total(self, column: int) -> float:
        """Sum of a figure over all workers."""
        return float(self.rows[:, column].sum())


class Seat:
    """The board as one worker has it.

    Attributes
    ----------
    board : Board
    row : memoryview of float64
        The worker's own figures, to be changed in place.
    """

    def __init__(self, board: Board, worker: int, row: memoryview[float]) -> None:
        self.board = board
        self.worker = worker
        self.row = row
        self._status = {status: FIRST_STATUS + place for place, status in enumerate(STATUSES)}

    def peer(self, address: str) -> int:
        """Column of an address; workers of one supervisor agree on it."""
        return FIRST_PEER + hash(address) % PEERS

    def share(self, address: str) -> float:
        """Part of an address's connections that this worker holds."""
        column = self.peer(address)
        return self.row[column] / max(self.board.total(column), 1.0) if self.row[column] else 1.0

    def count(self, status: int, sent: int, seconds: float) -> None:
        """Take note of a reply."""
        row = self.row
        row[self._status.get(status, OTHER_STATUS)] += 1
        row[SENT] += sent
        row[SECONDS_SUM] += seconds
        place = 0
        while place < len(SECONDS) and seconds > SECONDS[place]:
            place += 1
        row[FIRST_SECONDS + place] += 1
