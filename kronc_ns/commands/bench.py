"""`kronc bench`."""

import json
import os
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from typing_extensions import assert_never

from kronc_ns.errors import KroncError

if TYPE_CHECKING:
    from kronc_ns.benchmark.suites.trainings import Trainings

_MOST_TRAININGS = 4  # at a time, of one thread and about 1.5 GB each


@dataclass(kw_only=True)
class Bench:
    """Measure accuracy, speed or view synthesis on synthetic captures, beside what is asked of each row."""

    suite: Literal["poses", "speed", "nvs", "detector", "trust", "fleet", "refine"] = "poses"
    """poses: errors beside those of the best that the data allow; speed: time and memory beside other solvers'; nvs:
    radiance fields trained on exact, solved and unsolved poses (CPU, half an hour on two cores); detector: points and
    poses from bare photos of --photos; trust: whether what is said of a solution is so, over captures with every kind
    of trouble (trials from 100,000 on are those that the verdict was tuned on); fleet: `kronc fleet` on Ray nodes of
    this machine; refine: poses from image features, on the rendered captures of --captures and spin_suv of --photos."""
    seeds: int | None = None
    """Number of seeds of every row (default: what the row asks for)."""
    first_seed: int = 0
    """First seed; from 100 on they are those the solver was tuned on."""
    rows: str = ""
    """Only rows whose name holds this text."""
    shapes: Path | None = None
    """JSON file of 66 keypoints of real cars for the rows without initial pose and those that look through cars; those
    after the 40th are measured. Default: random procedural cars."""
    adam_seeds: int | None = None
    """On so many seeds 10,000 steps of Adam run beside (default: none in poses, 1 in speed); half a minute each."""
    scenes: int = 1000
    """Scenes of the throughput row; of fleet the most captures of a row (at 2,000 all are as asked)."""
    photos: Path | None = None
    """Of detector and refine: folder with spin_suv, captures, car_parts and cars; what it lacks is left out."""
    captures: Path | None = None
    """Of refine: folder with rendered captures walk_*, hemi_* and large_*, as `kronc synth --render` makes them."""
    detector_weights: Path | None = None
    """Of detector: other weights than the builtin ones."""
    keep: Path | None = None
    """Of nvs: new folder for the captures, trained runs and pictures of the test views (default: they are deleted)."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Measure and print; status 0 also where a row misses what is asked."""
        self._check()
        from rich.console import Console

        from kronc_ns.benchmark.machine import hardware
        from kronc_ns.benchmark.suites.captures import Options, Shapes, load_shapes
        from kronc_ns.benchmark.suites.overview import in_a_line, overview
        from kronc_ns.benchmark.suites.rows import measure_rows
        from kronc_ns.commands.console import progress_bar

        shapes = Shapes() if self.shapes is None else load_shapes(self.shapes)
        options = Options(shapes, self.first_seed, self.adam_seeds or 0, self.scenes)
        workers = 1
        with ExitStack() as stack:
            match self.suite:
                case "poses":
                    from kronc_ns.benchmark.suites.poses import pose_rows

                    rows = pose_rows(options)
                case "speed":
                    from kronc_ns.benchmark.suites.speed import speed_rows

                    rows = speed_rows(options)
                case "nvs":
                    from kronc_ns.benchmark.suites.nvs import nvs_rows

                    rows = nvs_rows(self._trainings(stack))
                    workers = min(len(os.sched_getaffinity(0)), _MOST_TRAININGS)
                case "detector":
                    from kronc_ns.benchmark.suites.detector import detector_rows

                    rows, missing = detector_rows(self.photos or Path(), self.detector_weights)
                    print("\n".join(missing), file=sys.stderr)
                case "trust":
                    from kronc_ns.benchmark.suites.trust import trust_rows

                    rows = trust_rows(shapes)
                case "fleet":
                    from kronc_ns.benchmark.suites.fleet import fleet_rows

                    rows = fleet_rows(self.scenes)
                case "refine":
                    from kronc_ns.benchmark.suites.refine import refine_rows

                    rows, missing = refine_rows(self.captures, self.photos)
                    print("\n".join(missing), file=sys.stderr)
                case _:
                    assert_never(self.suite)
            chosen = [row for row in rows if self.rows.lower() in row.name.lower()]
            if not chosen:
                names = "; ".join(row.name for row in rows)
                raise KroncError(f"--rows {self.rows!r}: expected part of one of {names}")
            before = hardware()
            measured = []
            with progress_bar(self.suite) as progress:
                report = lambda _, i, n: progress(i, n, None)  # noqa: E731
                for row in measure_rows(chosen, self.first_seed, self.seeds, report, workers):
                    measured.append(row)
                    print(in_a_line(row), file=sys.stderr)
        machine = {**hardware(), **before}  # busy as it was, with the libraries that came since
        if self.json:
            content = {"suite": self.suite, "hardware": machine, "rows": [row.as_dict() for row in measured]}
            print(json.dumps(content, allow_nan=False))
            return 0
        Console().print(overview(self.suite, measured).on_terminal())
        print(", ".join(f"{name} {value}" for name, value in machine.items()))
        return 0

    def _trainings(self, stack: ExitStack) -> "Trainings":
        """What the rows of nvs are made of; ``stack`` ends its commands and deletes what is not to be kept."""
        from tempfile import TemporaryDirectory

        from kronc_ns.benchmark.commands import Commands
        from kronc_ns.benchmark.suites.trainings import Trainings

        folder = self.keep
        if folder is None:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="kronc_nvs_", ignore_cleanup_errors=True)))
        elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise KroncError(f"--keep {folder} exists already: expected a new or empty folder")
        # as many trainings side by side as there are cores, of one thread each
        environment = {"OMP_NUM_THREADS": "1", "KRONC_NS_CACHE": str(folder.resolve() / "cache")}
        return Trainings(folder.resolve(), stack.enter_context(Commands(environment)))

    def _check(self) -> None:
        least = {"--seeds": (self.seeds, 1), "--first-seed": (self.first_seed, 0), "--scenes": (self.scenes, 2)}
        least["--adam-seeds"] = (self.adam_seeds, 0)
        for name, (value, minimum) in least.items():
            if value is not None and value < minimum:
                raise KroncError(f"{name} is {value}: expected {minimum} or more")
