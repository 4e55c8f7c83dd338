"""What every test may use."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings

if TYPE_CHECKING:
    from collections.abc import Callable

# Fixed seeds, and no clock in the verdict: a busy machine must not turn a test red.
settings.register_profile("pointstream", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("pointstream")

# A shell that runs tests in the background has them, and all that they start, ignore interrupts: some tests send them.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(autouse=True)
def _no_cache_of_the_user(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the commands keep of a model goes to a folder of the test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture
def scan_path() -> Callable[[str], Path]:
    """Return a real scan by file name; the test is skipped only where the folder of scans is absent."""

    def find(name: str) -> Path:
        if not SHARED_DATA.is_dir():
            pytest.skip("the folder of sample scans is not beside this checkout")
        return SHARED_DATA / name

    return find
