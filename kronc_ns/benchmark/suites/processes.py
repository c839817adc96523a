"""What the rows of whole processes measure: `kronc` as a shell starts it, import of its libraries included."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from kronc_ns.benchmark.commands import Commands
from kronc_ns.benchmark.figures import Figures
from kronc_ns.benchmark.suites.captures import noisy_start
from kronc_ns.benchmark.suites.timing import in_turns, processor_seconds, timed
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import make_capture


def help_over_torch(seed: int) -> Figures:
    """`kronc --help` over the import of torch."""
    return _over_torch("--help")


def solve_over_torch(seed: int) -> Figures:
    """`kronc solve` of 100 views from given poses over the import of torch."""
    with _solve_arguments(seed) as arguments:
        return _over_torch(*arguments)


def first_call(seed: int) -> Figures:
    """Processor time of `kronc solve` on a new machine, where nothing is compiled yet, beyond that of another call."""
    with (
        _solve_arguments(seed) as arguments,
        TemporaryDirectory(prefix="kronc_numba_") as cache,
        Commands({"NUMBA_CACHE_DIR": cache}) as commands,
    ):
        first, again = (processor_seconds(lambda: commands.run("kronc", *arguments)) for _ in range(2))
    return {"processor_s_more": first - again, "first_processor_s": first, "again_processor_s": again}


def _over_torch(*arguments: str) -> Figures:
    with Commands() as commands:
        kronc, torch = in_turns(
            timed(lambda: commands.run("kronc", *arguments)),
            timed(lambda: commands.run("python", "-c", "import torch")),
        )
    return {"over_import_torch": kronc / torch, "milliseconds": 1e3 * kronc, "import_torch_milliseconds": 1e3 * torch}


@contextmanager
def _solve_arguments(seed: int) -> Iterator[tuple[str, ...]]:
    """Of `kronc solve`, on a scene folder of 100 views from noisy poses."""
    capture = make_capture("carpatch", 100, seed, noise_px=1.0)
    with TemporaryDirectory(prefix="kronc_scene_") as folder:
        scene, out = Path(folder) / "scene", Path(folder) / "out"
        write_capture(scene, capture, noisy_start(capture, seed))
        yield "solve", "--data", str(scene), "--output-dir", str(out)
