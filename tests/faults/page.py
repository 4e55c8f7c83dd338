"""The page docs/faults.md out of the table: PYTHONPATH=common:server:client:tests python -m faults.page."""

from __future__ import annotations

from faults.rows import CACHES, GROUPS, SHOWN

INTRODUCTION = """# Faults, and what comes of them

Every row is a test: `tests/faults/test_faults.py`, on a virtual link, with the real HTTP stack. In all of them no
sample is drawn that is not the model's, other clouds go on loading, each cause is reported in one line (in
`stats.errors`, or as the one error of opening), and at the end no task, connection or request is left. Reports are
given as patterns. `tests/faults/page.py` writes this page.
"""


def page() -> str:
    """The page."""
    parts = [INTRODUCTION]
    for group, rows in GROUPS.items():
        parts += [f"\n## {group.capitalize()}\n", "| fault | shown | reported |", "|---|---|---|"]
        for row in rows:
            report = "nothing" if row.report is None else f"`{row.report}`".replace("|", "\\|")
            parts.append(f"| {row.name} | {SHOWN[row.shown]} | {report} |")
    parts += ["\n## Disk cache\n", "| fault | shown | reported |", "|---|---|---|"]
    for name, report in CACHES.items():
        parts.append(f"| {name} | {SHOWN['everything']} | {'nothing' if report is None else f'`{report}`'} |")
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    print(page(), end="")
