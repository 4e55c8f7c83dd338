"""The board in the words of Prometheus: what ``/metrics`` answers, whichever worker is asked."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.registry import Collector

from . import board as figures

if TYPE_CHECKING:
    from collections.abc import Iterator

    from .board import Board

MEDIA_TYPE = CONTENT_TYPE_PLAIN_0_0_4


class _BoardCollector(Collector):
    def __init__(self, board: Board, models: int) -> None:
        self._sums = board.rows[:, : figures.FIRST_PEER].sum(axis=0)
        self._workers = len(board.rows)
        self._models = models

    def collect(self) -> Iterator[Metric]:
        sums = self._sums
        yield GaugeMetricFamily("pointserve_models", "Models in the folder", self._models)
        yield GaugeMetricFamily("pointserve_workers", "Worker processes", self._workers)
        yield GaugeMetricFamily("pointserve_connections", "Open connections", sums[figures.CONNECTIONS])
        for name, text, column in (
            ("pointserve_refused_connections", "Connections beyond the limits, sent away", figures.REFUSED),
            ("pointserve_refused_requests", "Requests without a token or signature that admits", figures.ADMISSION),
            ("pointserve_sent_bytes", "Bytes of bodies sent", figures.SENT),
            ("pointserve_cut_replies", "Replies that ended before their last byte", figures.CUT),
        ):
            yield CounterMetricFamily(name, text, sums[column])
        requests = CounterMetricFamily("pointserve_requests", "Requests answered", labels=["status"])
        for place, status in enumerate(figures.STATUSES):
            requests.add_metric([str(status)], sums[figures.FIRST_STATUS + place])
        requests.add_metric(["other"], sums[figures.OTHER_STATUS])
        yield requests
        counts = np.cumsum(sums[figures.FIRST_SECONDS : figures.SECONDS_SUM])
        edges = [*map(str, figures.SECONDS), "+Inf"]
        buckets = [(edge, float(count)) for edge, count in zip(edges, counts, strict=True)]
        yield HistogramMetricFamily(
            "pointserve_reply_seconds", "From the head of a request to the last byte handed to the kernel",
            buckets=buckets, sum_value=float(sums[figures.SECONDS_SUM]),
        )  # fmt: skip


def exposition(board: Board, models: int) -> bytes:
    """Return the figures of all workers in Prometheus' text format."""
    registry = CollectorRegistry()
    registry.register(_BoardCollector(board, models))
    return generate_latest(registry)
