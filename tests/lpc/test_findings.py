"""What the fuzzer (scripts/fuzz) ever found, and the seeds it starts from."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.fuzzing import TARGETS, run_one, seeds

FINDINGS = Path(__file__).with_name("findings")


@pytest.mark.parametrize("name", sorted(path.name for path in FINDINGS.glob("*-*")))
def test_a_finding_of_the_fuzzer_stays_mended(name: str) -> None:
    run_one(name.partition("-")[0], (FINDINGS / name).read_bytes())


@pytest.mark.parametrize("target", TARGETS)
def test_the_seeds_are_accepted_by_the_readers(target: str) -> None:
    for seed in seeds(target):
        TARGETS[target](seed)


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("data", [b"", b"\0", b"\xff" * 5000], ids=["empty", "zero", "ones"])
def test_no_bytes_are_too_strange(target: str, data: bytes) -> None:
    run_one(target, data)
