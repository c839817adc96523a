"""A solution that is known exactly, in memory and on disk."""

from pathlib import Path

import numpy as np
import pytest

from kronc_ns.files.output import claim_output
from kronc_ns.files.record import write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.geometry.poses import camera_z
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewReport, ViewStatus
from kronc_ns.synthetic.scenes import Capture

FAILED_VIEW = 5
KEPT = [i for i in range(16) if i != FAILED_VIEW]


@pytest.fixture
def scene(walk_folder: Path) -> Scene:
    return load_scene(walk_folder)


@pytest.fixture
def solution(scene: Scene, walk_capture: Capture) -> Solution:
    """The true poses as a solution in which one view failed and one keypoint is unknown."""
    points = walk_capture.car.keypoints.copy()
    points[3] = np.nan
    c2w = walk_capture.c2w.copy()
    c2w[FAILED_VIEW] = np.nan
    views = [ViewReport(name, ViewStatus.SOLVED, 20, 18, 0.7) for name in scene.names]
    views[FAILED_VIEW] = ViewReport(scene.names[FAILED_VIEW], ViewStatus.FAILED, 3, 0, None, reason="3 keypoints")
    return Solution(
        status=Status.CONVERGED,
        reason="all is well",
        names=scene.names,
        camera=scene.camera,
        c2w=c2w,
        points=points,
        depths=camera_z(c2w, points),
        views=tuple(views),
        initial_c2w=walk_capture.c2w,
        solver="adam",
        init="circular",
        iterations=10,
        seconds=1.0,
        rmse_px=0.7,
        median_px=0.6,
        history={"step": [1.0], "loss": [2.0]},
    )


@pytest.fixture
def solved(tmp_path: Path, walk_folder: Path, scene: Scene, solution: Solution) -> Path:
    """The solution written to a folder."""
    folder = tmp_path / "out"
    claim_output(folder)
    write_solution(folder, scene, solution, walk_folder, "abc")
    return folder


def listing(folder: Path) -> dict[Path, bytes]:
    """Content of every file by its path in the folder."""
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
