"""`kronc fleet`."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from kronc_ns.commands.options import Flag
from kronc_ns.fleet.options import FleetOptions

if TYPE_CHECKING:
    from kronc_ns.fleet.driver import State, Summary

_SAY_EVERY_S = 60.0  # where no terminal shows the live table
_STATUSES = ("converged", "weak", "failed", "error")


@dataclass(kw_only=True)
class Fleet(FleetOptions):
    """Do many captures on many machines, with Ray: each subfolder or video becomes a folder of results."""

    captures: str
    """Folder, or URL that fsspec takes (s3://, gs://, ...): every subfolder or video in it is a capture."""
    output: str
    """New or empty folder or URL; gets a folder for each capture, fleet.parquet and fleet.html."""
    ray: str | None = None
    """A cluster that this machine is part of: HOST:PORT, or auto. Default: a Ray of this machine alone, which ends with
    the command; none: no Ray, one capture after the other."""
    local_cpus: int | None = None
    """CPUs of that Ray of this machine (default: all)."""
    resume: Flag = False
    """Go on with an output that holds a fleet of these captures: what is done and unchanged stays as it is."""
    limit: int | None = None
    """Do the first captures only, by name."""

    def run(self) -> int:
        """Do them, and print what became of them; 0 where all are converged, else 3."""
        from kronc_ns.fleet.driver import run_fleet

        options = FleetOptions(**{f.name: getattr(self, f.name) for f in fields(FleetOptions)})
        with _board() as progress:
            summary = run_fleet(
                self.captures,
                self.output,
                options,
                ray=self.ray,
                resume=self.resume,
                limit=self.limit,
                local_cpus=self.local_cpus,
                progress=progress,
            )
        _tell(summary)
        return 0 if summary.is_solved else 3


def _tell(summary: "Summary") -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title="KRONC fleet", title_justify="left", show_header=False)
    done = f"{summary.captures}"
    if summary.unchanged:
        done += f", {summary.unchanged} of them as they were"
    table.add_row("captures", done)
    for status in _STATUSES:
        if summary.counts.get(status):
            table.add_row(status, str(summary.counts[status]))
    each = f", {summary.seconds / summary.captures:.2f} s each" if summary.captures else ""
    table.add_row("time", f"{summary.seconds:.1f} s{each}")
    table.add_row("page", f"{summary.output}/fleet.html")
    Console().print(table)
    for status, name, reason in summary.doubtful:
        print(f"{status}: {name}: {reason}", file=sys.stderr)
    doubtful = sum(count for status, count in summary.counts.items() if status != "converged")
    if doubtful > len(summary.doubtful):
        print(f"... and {doubtful - len(summary.doubtful)} more, in fleet.parquet", file=sys.stderr)
    print(f"{summary.output}/fleet.parquet")


@contextmanager
def _board() -> Iterator[Callable[["State"], None]]:
    """A live table on stderr; where that is no terminal a line a minute."""
    from rich.console import Console
    from rich.live import Live

    console = Console(stderr=True)
    if not console.is_terminal:
        said = 0.0

        def say(state: "State") -> None:
            nonlocal said
            if state.seconds - said >= _SAY_EVERY_S:
                said = state.seconds
                print(", ".join(f"{value} {name}" for name, value in _shown(state)), file=sys.stderr)

        yield say
        return
    with Live(console=console, transient=True, refresh_per_second=4) as live:
        live.update("starting")
        yield lambda state: live.update(_live_table(state))


def _live_table(state: "State") -> Any:
    from rich.progress_bar import ProgressBar
    from rich.table import Table

    table = Table(title="KRONC fleet", title_justify="left", show_header=False)
    for name, value in _shown(state):
        table.add_row(name, value)
    table.add_row("", ProgressBar(total=state.captures, completed=state.done, width=40))
    return table


def _shown(state: "State") -> list[tuple[str, str]]:
    pace = state.done / state.seconds if state.seconds else 0.0
    left = _duration((state.captures - state.done) / pace) if pace else "?"
    return [
        ("done", f"{state.done} of {state.captures}"),
        *((status, str(state.counts.get(status, 0))) for status in _STATUSES),
        ("tasks", f"{state.tasks} on {state.nodes} nodes"),
        ("captures/s", f"{pace:.2f}"),
        ("left", left),
    ]


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
