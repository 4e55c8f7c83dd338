"""A build whose machines share an S3 store: s3fs and the server of moto, which are not among the tools of the tests.

pip install s3fs moto flask flask-cors
"""

from __future__ import annotations

import logging
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING

import fsspec
import numpy as np
import pytest
from oracles import surfaces
from support.workers import Dask

from pointbuild import BuildOptions, build_model
from pointbuild.cluster import dask_cluster
from pointbuild.progress import Silent

pytest.importorskip("s3fs")
moto = pytest.importorskip("moto.server")

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

OPTIONS = BuildOptions(cloud_size=128, threads=1, bucket_samples=700, block_samples=2000)


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """An empty bucket ``scans``; how to reach it."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    reached = {"endpoint_url": f"http://{host}:{port}", "key": "someone", "secret": "anything"}
    monkeypatch.setitem(fsspec.config.conf, "s3", reached)
    fsspec.filesystem("s3").mkdir("scans")
    yield reached
    server.stop()


class Killing(Silent):
    """Kills a worker when two buckets are sorted."""

    def __init__(self, dask: Dask) -> None:
        self._dask, self._steps, self._now = dask, 0, ""

    def stage(self, name: str, total: int | None) -> None:
        self._now = name

    def advance(self, samples: int) -> None:
        self._steps += self._now == "partition"
        if self._steps == 2:
            self._dask.workers[0].kill()


def test_workers_that_share_a_bucket_of_which_one_dies(store: dict[str, str], tmp_path: Path) -> None:
    points = surfaces.bumpy(9000, seed=1, color=True)
    scan = tmp_path / "scan.npz"
    np.savez(scan, xyz=points.xyz, **points.attributes)
    build_model([scan], tmp_path / "plain.lpc", OPTIONS, clock=time.monotonic)
    (tmp_path / "dask").mkdir()
    with ExitStack() as stack:
        dask = Dask(tmp_path / "dask", stack, {f"FSSPEC_S3_{name.upper()}": value for name, value in store.items()})
        with dask_cluster(dask.address, "s3://scans/builds") as workers:
            build_model([scan], tmp_path / "m.lpc", OPTIONS, Killing(dask), clock=time.monotonic, cluster=workers)
        assert dask.workers[0].wait() == -9
        assert dask.workers[1].poll() is None
    assert (tmp_path / "m.lpc").read_bytes() == (tmp_path / "plain.lpc").read_bytes()
    store_now = fsspec.filesystem("s3")
    store_now.invalidate_cache()
    assert store_now.find("scans") == []
