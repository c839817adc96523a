"""Many scene folders solved in one go."""

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path

from kronc_ns.capture.depth import with_depths
from kronc_ns.commands.console import solving
from kronc_ns.errors import KroncError
from kronc_ns.files.cache import fingerprint
from kronc_ns.files.output import claim_output
from kronc_ns.files.record import write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scenes
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status

_TOGETHER = 64  # scenes in memory at a time


@dataclass(frozen=True)
class Outcome:
    """What became of one scene folder."""

    folder: Path
    status: str
    """converged, weak, failed, or error where there is no solution."""
    reason: str


def expand(patterns: Sequence[Path]) -> list[Path]:
    """Folders, and those that match where a path does not exist but is a pattern."""
    folders: list[Path] = []
    for pattern in patterns:
        if not pattern.exists() and any(sign in str(pattern) for sign in "*?["):
            matches = sorted(Path(name) for name in glob(str(pattern)) if Path(name).is_dir())
            if not matches:
                raise KroncError(f"--data {pattern} matches no folder: expected scene folders")
            folders += matches
        else:
            folders.append(pattern)
    if not folders:
        raise KroncError("--data is empty: expected at least one scene folder")
    return folders


def solve_folders(
    folders: Sequence[Path], output_dir: Path, config: KroncConfig, depth_weights: Path | None = None
) -> int:
    """Solve every folder into ``output_dir`` / its name; one that fails does not stop the others.

    Prints a table; returns 2 where a scene could not be read or written, else 3 for a doubtful solution, else 0.
    """
    from rich.console import Console
    from rich.table import Table

    names = [folder.resolve().name for folder in folders]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise KroncError(f"two scenes are named {twice[0]}: their results would overwrite each other; solve them apart")
    inside = [f for f in folders if (output_dir / f.resolve().name).resolve() == f.resolve()]
    if inside:
        raise KroncError(f"--output-dir {output_dir} holds the scene {inside[0]} itself: choose another folder")
    outcomes: list[Outcome] = []
    with solving("scenes") as progress:
        for first in range(0, len(folders), _TOGETHER):
            outcomes += _solve_some(folders[first : first + _TOGETHER], output_dir, config, depth_weights)
            progress(len(outcomes), len(folders), None)
    table = Table("scene", "status", "reason")
    for outcome in outcomes:
        table.add_row(outcome.folder.name, outcome.status, outcome.reason)
    Console().print(table)
    print(output_dir)
    for outcome in outcomes:
        if outcome.status != Status.CONVERGED.value:
            print(f"{outcome.status}: {outcome.folder}: {outcome.reason}", file=sys.stderr)
    if any(outcome.status == "error" for outcome in outcomes):
        return 2
    return 0 if all(outcome.status == Status.CONVERGED.value for outcome in outcomes) else 3


def _solve_some(
    folders: Sequence[Path], output_dir: Path, config: KroncConfig, depth_weights: Path | None
) -> list[Outcome]:
    outcomes: dict[Path, Outcome] = {}
    scenes: dict[Path, Scene] = {}
    for folder in folders:
        try:
            scenes[folder] = with_depths(load_scene(folder), folder, config, depth_weights)
        except (KroncError, OSError) as error:
            outcomes[folder] = Outcome(folder, "error", str(error))
    solutions = solve_scenes(list(scenes.values()), config)
    for (folder, scene), solution in zip(scenes.items(), solutions, strict=True):
        outcomes[folder] = _written(folder, scene, solution, output_dir, config)
    return [outcomes[folder] for folder in folders]


def _written(
    folder: Path, scene: Scene, solution: Solution | KroncError, output_dir: Path, config: KroncConfig
) -> Outcome:
    if isinstance(solution, KroncError):
        return Outcome(folder, "error", str(solution))
    target = output_dir / folder.resolve().name
    try:
        claim_output(target)
        write_solution(target, scene, solution, folder, fingerprint(scene, config))
    except KroncError as error:
        return Outcome(folder, "error", str(error))
    return Outcome(folder, solution.status.value, solution.reason)
