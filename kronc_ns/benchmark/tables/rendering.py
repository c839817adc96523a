"""Rows on a terminal."""

import math
from collections.abc import Iterable

from rich import box
from rich.markup import escape
from rich.table import Table

from kronc_ns.benchmark.rows import Row

_VERDICTS = {True: "[green]reached[/]", False: "[red]missed[/]", None: "measured"}


def rows_table(rows: Iterable[Row], title: str) -> Table:
    """What was asked and on what it was measured, beside the figures, one a line."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE, show_lines=True)
    table.add_column("what", ratio=1)
    table.add_column("figures", no_wrap=True)
    table.add_column("value", no_wrap=True)
    for row in rows:
        seeds = f"seed {row.seeds[0]}" if len(row.seeds) == 1 else f"seeds {row.seeds[0]} to {row.seeds[-1]}"
        lines = [f"[bold]{escape(row.name)}[/]: {_VERDICTS[row.passed]}"]
        lines += [escape(f"asked: {row.asked}")] if row.asked else []
        lines += [escape(f"{row.note}; {seeds}; {row.seconds:.1f} s")]
        lines += [escape(f"seed {seed} failed: {reason}") for seed, reason in row.failures.items()]
        values = "\n".join(map(_number, row.reached.values()))
        table.add_row("\n".join(lines), "\n".join(row.reached), values)
    return table


def _number(value: float) -> str:
    if value != 0 and math.isfinite(value) and abs(value) < 1e-3:
        return f"{value:.1e}"
    return f"{value:.4g}"
