"""The rows of a suite as a table: what was asked and on what it was measured, beside the figures, one a line."""

from collections.abc import Sequence

from kronc_ns.benchmark.suites.rows import Measured
from kronc_ns.benchmark.tables.rendering import Table

_VERDICTS = {True: "reached", False: "missed", None: "measured"}
_STYLES = {True: "green", False: "red", None: ""}


def overview(suite: str, rows: Sequence[Measured]) -> Table:
    """All rows of a suite, and how many of them are as was asked."""
    asked = [row for row in rows if row.passed is not None]
    return Table(
        f"{suite}: {sum(bool(row.passed) for row in asked)} of {len(asked)} rows reached",
        ("what", "figures", "value"),
        [
            (_described(row), "\n".join(row.reached), "\n".join(f"{value:.4g}" for value in row.reached.values()))
            for row in rows
        ],
        styles=[_STYLES[row.passed] for row in rows],
    )


def in_a_line(row: Measured) -> str:
    """A row as soon as it is measured."""
    figures = ", ".join(f"{name} {value:.4g}" for name, value in row.reached.items())
    return f"{_VERDICTS[row.passed]}: {row.name} ({row.seconds:.1f} s): {figures}"


def _described(row: Measured) -> str:
    seeds = f"seed {row.seeds[0]}" if len(row.seeds) == 1 else f"seeds {row.seeds[0]} to {row.seeds[-1]}"
    lines = [f"{row.name}: {_VERDICTS[row.passed]}"]
    lines += [f"asked: {row.asked}"] if row.asked else []
    lines += [f"{row.note}; {seeds}; {row.seconds:.1f} s"]
    lines += [f"seed {seed} failed: {reason}" for seed, reason in row.failures.items()]
    return "\n".join(lines)
