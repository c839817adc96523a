"""Are the poses good enough to train on? The same training on solved, exact and unoptimised poses."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from kronc_ns.benchmark.commands import Commands
from kronc_ns.files.output import claim_output
from kronc_ns.files.record import write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import read_poses
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.poses import posed
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewReport, ViewStatus

Poses = Literal["exact", "solved", "given"]


def write_variant(
    folder: Path,
    data: Path,
    which: Poses,
    config: KroncConfig,
    points: Float[np.ndarray, "j 3"],
    keypoints: Path | None = None,
) -> None:
    """A data set of the rendered capture ``data`` with one kind of poses, ready for `kronc-dataparser`.

    ``points`` are the true keypoints in the world of reference.json. ``keypoints`` is a file to solve from instead of
    the capture's. Given poses are those of transforms.json, not optimised.
    """
    found = keypoints or data / "keypoints.json"
    scene = load_scene(data, found)
    if which == "solved":
        claim_output(folder)
        write_solution(folder, scene, solve_scene(scene, config), data, inputs=which)
        return
    reference = read_poses(data / "reference.json")
    c2w = np.stack([reference[name] for name in scene.names])
    if which == "given":
        assert scene.given_c2w is not None
        c2w = scene.given_c2w
    write_poses(folder, data, scene, c2w, points)


def write_poses(
    folder: Path, data: Path, scene: Scene, c2w: Float[np.ndarray, "n 3 4"], points: Float[np.ndarray, "j 3"]
) -> None:
    """A data set of the capture ``data`` with poses that came from elsewhere; NaN where a view has none.

    ``points`` are the keypoints in the world of the poses: they say where the car is.
    """
    claim_output(folder)
    views = tuple(
        ViewReport(name, ViewStatus.SOLVED if ok else ViewStatus.FAILED, 0, 0, None)
        for name, ok in zip(scene.names, posed(c2w), strict=True)
    )
    solution = Solution(
        status=Status.CONVERGED,
        reason="poses that were not solved, for comparison",
        names=scene.names,
        camera=scene.camera,
        c2w=c2w,
        points=points,
        depths=np.full(scene.visibility.shape, math.nan),
        views=views,
        initial_c2w=c2w,
        solver="none",
        init="given",
        iterations=0,
        seconds=0.0,
        rmse_px=math.nan,
        median_px=math.nan,
    )
    write_solution(folder, scene, solution, data, inputs="poses from elsewhere")


def train(
    data: Path,
    method: str,
    out: Path,
    options: Sequence[str] = (),
    parser: Sequence[str] = (),
    commands: Commands | None = None,
) -> Path:
    """`ns-train METHOD OPTIONS kronc-dataparser PARSER` on a solved data set; the path of the run's config.yml."""
    arguments = ["--data", str(data), "--output-dir", str(out), "--experiment-name", data.name, "--timestamp", "run"]
    (commands or Commands()).run("ns-train", method, *arguments, *options, "kronc-dataparser", *parser)
    return out / data.name / method / "run" / "config.yml"
