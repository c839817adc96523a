"""Solutions kept between runs, keyed by the content of what was solved; the user's own folder is never written."""

from pathlib import Path
from typing import Any

from kronc_ns.errors import KroncError
from kronc_ns.export import claim_output, write_solution
from kronc_ns.files import cache_folder
from kronc_ns.keypoints.io import read_json
from kronc_ns.pipeline import KroncConfig, Progress, fingerprint, solve_scene
from kronc_ns.scene import Scene


def read_report(folder: Path) -> dict[str, Any] | None:
    """kronc.json of a finished output folder, or None."""
    return read_json(folder / "kronc.json") if (folder / "kronc.json").exists() else None


def solve_cached(data: Path, scene: Scene, config: KroncConfig, progress: Progress | None) -> Path:
    """Folder with transforms.json and kronc.json for a scene: the cached one, else solved now.

    A cache that cannot be written is an error.
    """
    inputs = fingerprint(scene, config)
    folder = cache_folder() / inputs[:32]
    report = _intact_report(folder)
    if report is not None and report.get("inputs") == inputs:
        return folder
    solution = solve_scene(scene, config, progress)
    claim_output(folder)
    write_solution(folder, scene, solution, data, inputs)
    return folder


def _intact_report(folder: Path) -> dict[str, Any] | None:
    """A cached report; one that cannot be read counts as absent, since it can be made anew."""
    try:
        return read_report(folder)
    except KroncError:
        return None
