"""A table as Markdown or on a terminal."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import rich.table


@dataclass(frozen=True)
class Table:
    """Text in rows and columns."""

    title: str
    head: Sequence[str]
    lines: Sequence[Sequence[str]]
    about: str = ""
    """What stands below: on what the figures were taken."""
    styles: Sequence[str] = ()
    """Of each line on a terminal, as rich names them."""

    def markdown(self) -> str:
        """A section of a Markdown document."""
        lines = (self.head, ["---"] * len(self.head), *self.lines)
        rows = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        return f"## {self.title}\n\n{rows}\n\n{self.about}\n"

    def on_terminal(self) -> "rich.table.Table":
        """For `rich`; cells may have several lines, and the first column takes what room there is."""
        from rich import box
        from rich.markup import escape
        from rich.table import Table as RichTable

        table = RichTable(title=escape(self.title), title_justify="left", box=box.SIMPLE, show_lines=True)
        for i, name in enumerate(self.head):
            table.add_column(name, ratio=1 if i == 0 else None, no_wrap=i > 0)
        for line, style in zip(self.lines, self.styles or [""] * len(self.lines), strict=True):
            table.add_row(*map(escape, line), style=style)
        return table


def number(value: float) -> str:
    """Two or three digits; a dash where there is no figure."""
    if not math.isfinite(value):
        return "-"
    return f"{value:.2g}" if 0 < abs(value) < 0.01 else f"{value:.2f}" if value < 100 else f"{value:.0f}"
