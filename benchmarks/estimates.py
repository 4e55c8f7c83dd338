"""What a build of so many samples takes, from what one was measured to take: linear, on top of a fixed memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

BASE = 450e6
"""Resident bytes of a build of two threads besides the tree."""

NODE = 800.0
"""Resident bytes a node while the trees are joined."""

CANDIDATE = 0.2
"""Resident bytes a sample while thresholds are found: of one in 260 the priority and the bucket, and their order."""


@dataclass(frozen=True, slots=True)
class Prices:
    """Of a core for an hour, and of a GB for a month: published, and as scratch."""

    core_hour: float
    gb_month: float
    scratch_gb_month: float


@dataclass(frozen=True, slots=True)
class Costs:
    """What a sample takes: CPU seconds, of them those of the stages that a cluster shares, and bytes.

    `node` are the samples of a node.
    """

    cpu: float
    shared_cpu: float
    model: float
    scratch: float
    node: float

    @classmethod
    def of(cls, built: dict[str, Any]) -> Costs:
        """Those of a build that `scale.py` measured."""
        samples = built["samples"]
        shared = sum(cpu for name, cpu, _ in built["stages"] if name in ("partition", "encode"))
        return cls(
            built["cpu"] / samples,
            shared / samples,
            built["bytes"] / samples,
            built["disk"] / samples,
            samples / built["clouds"],
        )


@dataclass(frozen=True, slots=True)
class Estimate:
    """What a build takes.

    Parameters
    ----------
    core_hours, hours : float
        CPU, and time on two cores that are busy for five sixths of it.
    cluster_hours : float
        Where partition and encode run on 64 more cores.
    memory, scratch, model : float
        GB.
    build, month : float
        Money once, and for a month of the model on line.
    """

    core_hours: float
    hours: float
    cluster_hours: float
    memory: float
    scratch: float
    model: float
    build: float
    month: float


BUSY = 5 / 6
CLUSTER_CORES = 64


def estimate(samples: float, costs: Costs, prices: Prices) -> Estimate:
    """Scale the costs."""
    core_hours = samples * costs.cpu / 3600
    hours = core_hours / (2 * BUSY)
    here = samples * (costs.cpu - costs.shared_cpu) / 3600 / (2 * BUSY)
    cluster_hours = here + samples * costs.shared_cpu / 3600 / (CLUSTER_CORES * BUSY)
    scratch, model = samples * costs.scratch / 1e9, samples * costs.model / 1e9
    return Estimate(
        core_hours=core_hours,
        hours=hours,
        cluster_hours=cluster_hours,
        memory=(BASE + samples * (NODE / costs.node + CANDIDATE)) / 1e9,
        scratch=scratch,
        model=model,
        build=core_hours / BUSY * prices.core_hour + scratch * prices.scratch_gb_month * hours / 730,
        month=model * prices.gb_month,
    )


def print_estimates(costs: Costs, prices: Prices) -> None:
    print(
        f"\n{'samples':>8}{'core h':>9}{'2 cores':>9}{'2 + 64':>9}{'memory GB':>11}{'scratch GB':>12}{'model GB':>10}"
        f"{'build':>8}{'a month':>9}"
    )
    for billions in (1, 10, 100):
        found = estimate(billions * 1e9, costs, prices)
        print(
            f"{billions:>7}G{found.core_hours:>9.2f}{found.hours:>8.1f}h{found.cluster_hours:>8.1f}h{found.memory:>11.1f}"
            f"{found.scratch:>12.0f}{found.model:>10.1f}{found.build:>8.2f}{found.month:>9.2f}"
        )
