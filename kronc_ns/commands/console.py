"""What the commands share on a terminal: progress, the table of a solution, errors and exit statuses."""

import errno
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

from kronc_ns.errors import KroncError

if TYPE_CHECKING:
    from rich.table import Table

_LISTED = 8  # failed views named in the table
_METRICS = {"psnr": 2, "ssim": 4, "lpips": 4}  # decimals


@contextmanager
def exit_on_error() -> Iterator[None]:
    """Turn errors a user can cause into one line on stderr and exit status 2; Ctrl-C into 130, SIGTERM into 143.

    Either way everything is left as on an error, so that no child process goes on alone.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, _terminate) if in_main_thread else None
    try:
        yield
    except KroncError as error:
        sys.exit(_fail(str(error), 2))
    except KeyboardInterrupt:
        sys.exit(_fail("interrupted; the same command starts again", 130))
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EACCES, errno.EROFS, errno.EDQUOT):
            sys.exit(_fail(f"{error.filename or 'output'} cannot be written: {error.strerror}", 2))
        if error.errno == errno.ENAMETOOLONG:
            sys.exit(_fail(f"{error.filename}: {error.strerror}: expected a shorter path", 2))
        raise
    finally:
        if in_main_thread:
            signal.signal(signal.SIGTERM, before)


def _terminate(*_: object) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough: let the children be ended
    sys.exit(_fail("terminated; the same command starts again", 143))


def exit_status(report: Mapping[str, Any]) -> int:
    """0 for a trustworthy solution (kronc.json's content), else 3 with the reason on stderr."""
    from kronc_ns.solution import Status

    trusted = report["status"] == Status.CONVERGED.value
    return 0 if trusted else _fail(f"{report['status']}: {report['reason']}", 3)


def _fail(message: str, status: int) -> int:
    print(("error: " if status == 2 else "") + " ".join(message.split()), file=sys.stderr)
    return status


@contextmanager
def solving(description: str = "solving") -> Iterator[Callable[[int, int, float | None], None]]:
    """`progress_bar` of something that solves; says so where the solver is compiled first."""
    from kronc_ns.solve.lm import is_ready

    if not is_ready():
        print("compiling the solver for this machine, once (about 10 s)", file=sys.stderr)
    with progress_bar(description) as progress:
        yield progress


@contextmanager
def progress_bar(description: str) -> Iterator[Callable[[int, int, float | None], None]]:
    """A bar on stderr with time left; the callback takes (step, steps, loss or None)."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}{task.fields[loss]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(description, total=None, loss="", visible=False)

        def advance(step: int, steps: int, loss: float | None) -> None:
            shown = "" if loss is None else f"  loss {loss:.4g}"
            bar.update(task, completed=step, total=steps, loss=shown, visible=True)

        yield advance


def report_table(report: Mapping[str, Any], notes: Sequence[str] = ()) -> "Table":
    """Summary of kronc.json's content: views solved and failed (with reasons), residuals, time, ``notes``."""
    from statistics import median

    from rich.table import Table

    from kronc_ns.solution import ViewStatus

    views = report["views"]
    solved = sum(view["status"] == ViewStatus.SOLVED.value for view in views)
    failed = [view for view in views if view["status"] == ViewStatus.FAILED.value]
    completed = sum(view["status"] == ViewStatus.COMPLETED.value for view in views)
    swapped = sum(view.get("swapped", False) for view in views)
    table = Table(title=f"KRONC: {report['status']}", title_justify="left", show_header=False)
    table.add_row("views solved", f"{solved} of {len(views)}")
    if report["solver"] == "none":
        table.add_row("views as given", f"{completed}, not solved")
    elif completed:
        table.add_row(
            "views completed",
            f"{completed}: hardly known, or placed between their neighbours (--min-status solved omits them)",
        )
    if swapped:
        table.add_row("left and right", f"confused in {swapped} views, put right")
    for view in failed[:_LISTED]:
        table.add_row("  left out", f"{view['file_path']}: {view['reason']}")
    if len(failed) > _LISTED:
        table.add_row("  left out", f"... and {len(failed) - _LISTED} more (kronc.json lists all)")
    rmse, middle = report["rmse_px"], report["median_px"]
    if rmse is not None and middle is not None:
        table.add_row("reprojection", f"RMSE {rmse:.2f} px of the inliers, median {middle:.2f} px of all")
    images = report.get("images")
    sigmas = [[view[key] for view in views if view.get(key) is not None] for key in ("sigma_rot_deg", "sigma_trans_m")]
    if all(sigmas):
        rotation, centre = (median(values) for values in sigmas)
        among = ", of the cameras among each other" if images is not None and images["accepted"] else ""
        table.add_row("standard deviation", f"{rotation:.2f} deg, {100 * centre:.2g} cm (median view{among})")
    if images is not None:
        taken = "taken" if images["accepted"] else "not taken"
        table.add_row("image features", f"{taken} ({images['seconds']:.1f} s): {images['reason']}")
        if images["background_still"]:
            table.add_row("background", "stands still while the car turns: features on the vehicle alone")
    table.add_row("solver", f"{report['solver']} from {report['init']} poses, {report['iterations']} steps")
    table.add_row("time", f"{report['seconds']:.3f} s")
    for note in notes:
        table.add_row("note", note)
    return table


def metrics_table(result: Mapping[str, Any]) -> "Table":
    """The content of `kronc eval --nvs --json`: full frame and vehicle, a line for each test view, means last."""
    from rich.table import Table

    title = f"{result['method']}, step {result['step']}: {result['views']} test views"
    table = Table(title=title, title_justify="left")
    table.add_column("view", no_wrap=True)
    columns = [(part, metric, digits) for part in ("full", "masked") for metric, digits in _METRICS.items()]
    for part, metric, _ in columns:
        table.add_column(f"{'vehicle' if part == 'masked' else 'frame'}\n{metric.upper()}", justify="right")
    rows = [(PurePosixPath(image["file_path"]).name, image) for image in result["images"]]
    for name, row in [*rows, ("mean", result)]:
        values = ((row[part] or {}).get(metric) for part, metric, _ in columns)
        cells = (
            "-" if value is None else f"{value:.{column[2]}f}" for value, column in zip(values, columns, strict=True)
        )
        table.add_row(name, *cells, end_section=row is rows[-1][1])
    return table
