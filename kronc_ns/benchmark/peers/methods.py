"""Ways from a scene to its poses, side by side: ours, the paper's, bundle adjustment, and COLMAP's mappers."""

import multiprocessing
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from typing_extensions import assert_never

from kronc_ns.benchmark.figures import pose_figures
from kronc_ns.benchmark.memory import with_peak
from kronc_ns.benchmark.peers.adam import PAPERS, one_step
from kronc_ns.benchmark.peers.ceres import bundle_adjustment, load_pycolmap
from kronc_ns.benchmark.peers.colmap import map_images, map_keypoints
from kronc_ns.benchmark.subjects import Subject
from kronc_ns.errors import KroncError
from kronc_ns.files.photos import photos
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.starts import circular_poses
from kronc_ns.refine.pipeline import refine_scene
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution

Method = Literal[
    "kronc",
    "kronc-images",
    "adam",
    "ceres",
    "colmap-incremental",
    "colmap-global",
    "colmap-incremental-masked",
    "colmap-global-masked",
    "keypoints-incremental",
    "keypoints-global",
]
"""kronc: the default solver; kronc-images: the same, refined by image features; adam: the paper's; ceres: bundle
adjustment of the same keypoints by pycolmap with a Cauchy loss; colmap-...: COLMAP's mappers on SIFT features (all of
them, or the vehicle's); keypoints-...: the same mappers on the keypoints."""

_NO_IMAGES = "{} needs images: give scene folders with --captures"


@dataclass(frozen=True)
class Placed:
    """What a method made of a scene."""

    c2w: Float[np.ndarray, "n 3 4"]
    """NaN where a view has no pose."""
    seconds: float
    """From keypoints or images to poses, initialisation included, with everything loaded and compiled before."""
    megabytes: float
    """Peak memory above what the process had before, libraries loaded; NaN where the system does not tell."""

    def figures(self, truth: Float[np.ndarray, "n 3 4"]) -> dict[str, float]:
        """Errors against the truth (`pose_figures`), time and memory."""
        return {**pose_figures(self.c2w, truth), "seconds": self.seconds, "megabytes": self.megabytes}


def place(
    method: Method, subject: Subject, start: Float[np.ndarray, "n 3 4"] | None = None, config: KroncConfig | None = None
) -> Placed:
    """Poses of a subject, computed in a process of its own. Methods that need poses to start from get ``start``.

    Without it kronc finds its own and the others that need one begin on the paper's circle. ``config`` replaces the
    settings of kronc and adam.
    """
    scene = replace(subject.scene, given_c2w=start)
    warm_up = partial(_warm_up, method, scene, subject.folder, config)
    run = partial(_poses, method, scene, subject.folder, config)
    # spawned: forks of a process whose threads hold locks may never begin
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(_measured, warm_up, run).result()
        except BrokenProcessPool:
            raise KroncError(f"{method} on {subject.name} ended its process: is there memory enough?") from None


def _warm_up(method: Method, scene: Scene, folder: Path | None, config: KroncConfig | None) -> None:
    """What a method does once in a process only: compile itself, load libraries."""
    if method in ("kronc", "kronc-images", "ceres"):
        _poses(method, scene, folder, config)
    elif method == "adam":
        _poses(method, scene, folder, one_step(config or PAPERS))
    else:
        load_pycolmap()


def _measured(warm_up: Callable[[], None], run: Callable[[], np.ndarray]) -> Placed:
    """In the other process: poses, time and memory."""
    warm_up()

    def timed() -> tuple[np.ndarray, float]:
        begin = time.perf_counter()
        return run(), time.perf_counter() - begin

    (c2w, seconds), megabytes = with_peak(timed)
    return Placed(c2w, seconds, megabytes)


def _solved(scene: Scene, config: KroncConfig | None) -> Solution:
    return solve_scene(scene, replace(config or KroncConfig(), solver="lm", min_status="solved"))


def _poses(method: Method, scene: Scene, folder: Path | None, config: KroncConfig | None) -> Float[np.ndarray, "n 3 4"]:
    match method:
        case "kronc":
            return _solved(scene, config).c2w
        case "kronc-images":
            if folder is None:
                raise KroncError(_NO_IMAGES.format(method))
            solution = _solved(scene, config)
            right = scene.with_sides_swapped(solution.swapped)
            return refine_scene(right, solution, photos(folder, scene)).c2w
        case "adam":
            return solve_scene(scene, replace(config or PAPERS, solver="adam", min_status="solved")).c2w
        case "ceres":
            circle = KroncConfig()
            start = scene.given_c2w
            if start is None:
                start = circular_poses(len(scene), circle.radius_m, circle.direction, circle.laps)
            return bundle_adjustment(scene, start, loss="cauchy").c2w
        case "colmap-incremental" | "colmap-global" | "colmap-incremental-masked" | "colmap-global-masked":
            if folder is None:
                raise KroncError(_NO_IMAGES.format(method))
            return map_images(scene, folder, "global" if "global" in method else "incremental", "masked" in method)
        case "keypoints-incremental":
            return map_keypoints(scene, "incremental")
        case "keypoints-global":
            return map_keypoints(scene, "global")
        case _:
            assert_never(method)
