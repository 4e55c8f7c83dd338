"""The page of faults is the table."""

from __future__ import annotations

from pathlib import Path

from faults.page import page
from faults.rows import CACHES, ROWS


def test_the_page_is_the_table() -> None:
    assert (Path(__file__).resolve().parents[2] / "docs" / "faults.md").read_text() == page()


def test_there_are_at_least_forty_faults_each_with_a_name_of_its_own() -> None:
    names = [row.name for row in ROWS] + list(CACHES)
    assert len(names) == len(set(names)) >= 40
