"""Builds in children that die by SIGKILL at their n-th call of the system that may change a file.

Whichever thread makes the call. So moments are spread over the whole build, and the same in every run of one thread.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]

_CHILDREN = """
import json, os, pathlib, signal, sys, time
from pointbuild import BuildOptions, build_model
from pointbuild import build

calls = moment = 0

def dying(function):
    def call(*arguments, **named):
        global calls
        calls += 1
        if calls == moment:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **named)
    return call

build.kernels_are_loaded = lambda: True  # no small build before: its calls would be counted
for place, names in (
    (os, ("pwrite", "truncate", "rename", "replace", "unlink", "fsync", "mkdir")),
    (pathlib.Path, ("open", "rename", "replace", "unlink", "mkdir")),
):
    for name in names:
        setattr(place, name, dying(getattr(place, name)))
for entry in json.load(sys.stdin):
    told, tell = os.pipe()
    child = os.fork()
    if not child:
        moment = entry["moment"]
        out = pathlib.Path(entry["out"])
        options = BuildOptions(**entry["options"])
        build_model([entry["scan"]], out, options, clock=time.monotonic, append=out if entry["append"] else None)
        os.write(tell, str(calls).encode())
        os._exit(0)
    os.close(tell)
    print(os.waitpid(child, 0)[1], os.read(told, 99).decode() or 0, flush=True)
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class DyingBuild:
    """One child.

    Parameters
    ----------
    scan, out : str
    options : dict
        Of `BuildOptions`.
    moment : int
        The call that it dies at; 0: never.
    append : bool
        The scan is added to the model that is there.
    """

    scan: str
    out: str
    options: dict[str, Any] = field(default_factory=dict)
    moment: int = 0
    append: bool = False


def run_dying(builds: list[DyingBuild]) -> list[tuple[int, int]]:
    """Run one after another; return exit status, and calls made if it ended (0: killed), of each."""
    paths = os.pathsep.join(str(REPOSITORY / part) for part in ("common", "server"))
    done = subprocess.run(
        [sys.executable, "-c", _CHILDREN],
        input=json.dumps([asdict(build) for build in builds]),
        env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return [(int(status), int(calls)) for status, calls in map(str.split, done.stdout.splitlines())]
