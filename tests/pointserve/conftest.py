from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from support.shelf import make_model

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture
def models(tmp_path: Path) -> Path:
    folder = tmp_path / "models"
    folder.mkdir()
    return folder


@pytest.fixture
def model(models: Path) -> Callable[..., bytes]:
    """Write ``models/NAME`` and return its bytes."""

    def write(name: str = "david.lpc", size: int = 10_000, seed: int = 0) -> bytes:
        return make_model(models / name, size, seed)

    return write
