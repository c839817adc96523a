"""What the rows of the suite of speed measure on one seed: ratios of times that were taken in turns."""

import math
import multiprocessing
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from threading import Barrier
from unittest.mock import patch

import numpy as np
from jaxtyping import Float

from kronc_ns.benchmark.commands import Commands
from kronc_ns.benchmark.figures import Figures, pose_figures
from kronc_ns.benchmark.memory import with_peak
from kronc_ns.benchmark.peers.adam import FROM_POSES, one_step
from kronc_ns.benchmark.peers.ceres import LinearSolver, bundle_adjustment
from kronc_ns.benchmark.subjects import capture_scene
from kronc_ns.benchmark.suites.captures import DEFAULT, Shapes, capture_shape, noisy_start, solution_figures
from kronc_ns.benchmark.suites.timing import Timed, in_turns, timed
from kronc_ns.errors import KroncError
from kronc_ns.fit.attempts import adjust_starts
from kronc_ns.fit.pipeline import solve_scene, solve_scenes
from kronc_ns.fit.starts import start_from_poses
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution
from kronc_ns.solve.threads import side_by_side
from kronc_ns.synthetic.scenes import Capture, make_capture

SIZES = (100, 400, 1600)
CERES: dict[str, tuple[LinearSolver, float]] = {
    "colmap_default": ("auto", 0.0),
    "ceres_default_tolerance": ("auto", 1e-6),
    "dense_schur": ("DENSE_SCHUR", 1e-6),
    "normal_cholesky": ("SPARSE_NORMAL_CHOLESKY", 1e-6),
    "iterative_schur": ("ITERATIVE_SCHUR", 1e-6),
}
"""Linear solver and function tolerance of the settings tried: COLMAP's own choice is not Ceres' fastest here."""


def _posed(seed: int, views: int = 100) -> tuple[Capture, Scene]:
    """A capture from a hemisphere, 1 px, with noisy poses."""
    capture = make_capture("carpatch", views, seed, noise_px=1.0)
    return capture, capture_scene(capture, noisy_start(capture, seed))


def _solving(scene: Scene) -> Timed:
    """The default solver, the whole of it."""
    return timed(lambda: solve_scene(scene, DEFAULT))


def _adjusting(scene: Scene) -> Timed:
    """Its adjustment alone, from the triangulated points on."""
    assert scene.given_c2w is not None
    start = start_from_poses("given", "given", scene, scene.given_c2w)
    return timed(lambda: adjust_starts([start], DEFAULT))


def _figures(scene: Scene, truth: Float[np.ndarray, "n 3 4"], seconds: float) -> dict[str, float]:
    """Of the default solver."""
    solution = solve_scene(scene, DEFAULT)
    return {
        **solution_figures(solution, truth),
        "milliseconds": 1e3 * seconds,
        "iterations": float(solution.iterations),
    }


def against_ceres(seed: int) -> Figures:
    """The default solver, whole and its adjustment alone, and pycolmap's adjustment alone from the same start."""
    capture, scene = _posed(seed)
    start = scene.given_c2w
    assert start is not None

    def ceres(linear_solver: LinearSolver, tolerance: float) -> Timed:
        return lambda: (
            bundle_adjustment(scene, start, linear_solver=linear_solver, function_tolerance=tolerance).seconds
        )

    peers = {name: ceres(*setting) for name, setting in CERES.items()}
    peers["iterative_schur_cauchy"] = lambda: (
        bundle_adjustment(scene, start, loss="cauchy", linear_solver="ITERATIVE_SCHUR", function_tolerance=1e-6).seconds
    )
    whole, adjustment, *others = in_turns(_solving(scene), _adjusting(scene), *peers.values())
    taken = dict(zip(peers, others, strict=True))
    best = bundle_adjustment(scene, start, linear_solver="ITERATIVE_SCHUR", function_tolerance=1e-6)
    return {
        **_figures(scene, capture.c2w, whole),
        "solve_over_iterative_schur": whole / taken["iterative_schur"],
        "adjustment_over_fastest": adjustment / min(taken[name] for name in CERES),
        "adjustment_milliseconds": 1e3 * adjustment,
        **{f"{name}_milliseconds": 1e3 * seconds for name, seconds in taken.items()},
        "iterative_schur_rotation_deg": pose_figures(best.c2w, capture.c2w)["rotation_deg"],
    }


def _over_plain(seed: int, capture: Capture, scene: Scene) -> Figures:
    """A scene in turns with the plain one: a hemisphere from given poses."""
    taken, plain = in_turns(_solving(scene), _solving(_posed(seed)[1]))
    return {**_figures(scene, capture.c2w, taken), "over_plain": taken / plain, "plain_milliseconds": 1e3 * plain}


def without_pose(seed: int, shapes: Shapes) -> Figures:
    """A walk of 100 views with 10 % outliers and no initial pose."""
    capture, _ = capture_shape(shapes(seed), "walk", seed, outliers=0.1)
    return _over_plain(seed, capture, capture_scene(capture))


def seen_through(seed: int, shapes: Shapes) -> Figures:
    """Keypoints are hidden by their hull alone, not by the car: many views of real shapes look through it."""
    capture, _ = capture_shape(shapes(seed), "carpatch", seed)
    return _over_plain(seed, capture, capture_scene(capture, noisy_start(capture, seed)))


def against_adam(seed: int) -> Figures:
    """The default solver and the paper's 10,000 steps on the same scene from the same start."""
    capture, scene = _posed(seed)
    solve_scene(scene, one_step(FROM_POSES))
    (before,) = in_turns(_solving(scene))
    start = time.perf_counter()
    solution = solve_scene(scene, FROM_POSES)
    seconds = time.perf_counter() - start
    (after,) = in_turns(_solving(scene))  # a machine whose speed changes is met twice
    ours, adam = _figures(scene, capture.c2w, (before + after) / 2), solution_figures(solution, capture.c2w)
    errors = ("rotation_deg", "centre_cm")
    return {
        **ours,
        **{f"adam_{name}": adam[name] for name in errors},
        "adam_seconds": seconds,
        "times_faster": 2 * seconds / (before + after),
        "seeds_less_accurate": float(any(ours[name] > adam[name] for name in errors)),
    }


def growth(seed: int) -> Figures:
    """Times of each size in this process, memory in fresh ones."""
    times = in_turns(*(_solving(_posed(seed, views)[1]) for views in SIZES))
    with Commands() as commands:
        peaks = [_peak_megabytes(commands, seed, views) for views in SIZES]
    # megabytes of a further view, among many and among few
    late, early = ((peaks[i + 1] - peaks[i]) / (SIZES[i + 1] - SIZES[i]) for i in (1, 0))
    return {
        "times_longer": times[2] / times[0],
        "memory_slope_ratio": late / early if early > 0 else math.nan,
        **{f"milliseconds_{views}": 1e3 * seconds for views, seconds in zip(SIZES, times, strict=True)},
        **{f"megabytes_{views}": peak for views, peak in zip(SIZES, peaks, strict=True)},
    }


def measure_peak(seed: int, views: int) -> float:
    """Megabytes by which solving a capture raises this process' resident memory at its peak (Linux only, else NaN)."""
    solve_scene(_posed(seed, 12)[1], DEFAULT)  # what is loaded once is no cost of a view
    scene = _posed(seed, views)[1]
    return with_peak(lambda: solve_scene(scene, DEFAULT))[1]


def _peak_megabytes(commands: Commands, seed: int, views: int) -> float:
    return float(
        commands.run("python", "-c", f"from {__name__} import measure_peak; print(measure_peak({seed}, {views}))")
    )


def throughput(seed: int, count: int) -> Figures:
    """Many scenes on all cores over the same on one: the rates, and the largest difference of their poses.

    Processes that share nothing tell what of it the hardware allows.
    """
    captures, scenes = zip(*(_posed(seed + i) for i in range(count)), strict=True)
    half = count // 2
    solve_scenes(scenes[:2], DEFAULT)
    alone: list[Solution | KroncError] = []
    one_core = timed(lambda: alone.extend(_on_one_core(scenes[:half])))()
    together: list[Solution | KroncError] = []
    all_cores = timed(lambda: together.extend(solve_scenes(scenes, DEFAULT)))()
    apart_s = _in_processes(scenes)
    one_core += timed(lambda: alone.extend(_on_one_core(scenes[half:])))()  # before and after, as the machine changes
    errors, apart = [], []
    for capture, ours, reference in zip(captures, together, alone, strict=True):
        if isinstance(ours, Solution) and isinstance(reference, Solution):
            errors.append(pose_figures(ours.c2w, capture.c2w)["rotation_deg"])
            apart.append(float(np.abs(np.nan_to_num(ours.c2w) - np.nan_to_num(reference.c2w)).max()))
    return {
        "over_one_core": one_core / all_cores,
        "processes_over_one_core": one_core / apart_s,
        "scenes_per_s": count / all_cores,
        "scenes_per_s_on_one_core": count / one_core,
        "apart": max(apart, default=math.inf),
        "failed_scenes": float(count - len(errors)),
        "rotation_deg": max(errors, default=math.inf),
    }


def _in_processes(scenes: Sequence[Scene]) -> float:
    """Seconds of one process for each core, all of them warm, each with its share of the scenes.

    Each has one thread: those of their linear algebra would fight for the cores.
    """
    cores = os.cpu_count() or 1
    context = multiprocessing.get_context("spawn")
    with (
        patch.dict(os.environ, {"OPENBLAS_NUM_THREADS": "1"}),
        ProcessPoolExecutor(cores, context, _meet_at, (context.Barrier(cores),)) as pool,
    ):
        return max(pool.map(_seconds_from_the_barrier, [scenes[core::cores] for core in range(cores)]))


def _meet_at(barrier: Barrier) -> None:
    """Where this process waits for the others."""
    global _barrier
    _barrier = barrier


def _seconds_from_the_barrier(scenes: Sequence[Scene]) -> float:
    _on_one_core(scenes[:2])
    _barrier.wait()
    return timed(lambda: _on_one_core(scenes))()


def _on_one_core(scenes: Sequence[Scene]) -> list[Solution | KroncError]:
    """One scene after the other, none of them in parts."""
    (solutions,) = side_by_side(lambda some: [solve_scenes([scene], DEFAULT)[0] for scene in some], [scenes])
    return solutions
