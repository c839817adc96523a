"""Looking again with what geometry knows: once the car is solved, where each point should be is no longer a guess."""

from collections.abc import Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from kronc_ns.capture.detection.detector import CarDetection, CarImage
from kronc_ns.capture.progress import Count
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.camera import Camera, reproject
from kronc_ns.geometry.poses import posed
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewStatus

_RANK = {Status.FAILED: 0, Status.WEAK: 1, Status.CONVERGED: 2}


@runtime_checkable
class GuidedDetector(Protocol):
    """A detector that can be told where to look."""

    def look_again(
        self, images: Sequence[CarImage], expected: Float[np.ndarray, "n j 2"]
    ) -> Generator[CarDetection | None, None, None]:
        """The car of each image with its points near ``expected`` (stored pixels; NaN: unknown), as soon as each is
        done; points that the image does not show there are not given."""
        ...


def second_look(
    detector: GuidedDetector,
    folder: Path,
    scene: Scene,
    solution: Solution,
    config: KroncConfig,
    progress: Count | None = None,
) -> tuple[Scene, Solution, str]:
    """What is better: the solution, or that of points looked for where it expects them; and a note that says by how
    much."""
    looked = look_again(detector, folder, scene, solution, progress)
    second = solve_scene(looked, config)
    points, now = (of.visibility.sum(1).mean() for of in (scene, looked))
    change = (
        f"points a view {points:.1f} -> {now:.1f}, views solved {_solved(solution)} -> {_solved(second)}, "
        f"camera centre ± {_sigma_m(solution):.3f} -> {_sigma_m(second):.3f} m"
    )
    if is_better(second, solution):
        return looked, second, f"kept: {change}"
    return scene, solution, f"no better, left: {change}"


def look_again(
    detector: GuidedDetector, folder: Path, scene: Scene, solution: Solution, progress: Count | None = None
) -> Scene:
    """The scene with the points of views that have a pose detected anew near where the solved ones project."""
    located = np.flatnonzero(posed(solution.c2w)).tolist()
    images = [CarImage(folder / scene.names[view]) for view in located]
    keypoints = scene.with_sides_swapped(solution.swapped).keypoints.copy()
    sigma = np.ones(keypoints.shape[:2]) if scene.sigma_px is None else scene.sigma_px.copy()
    answers = detector.look_again(images, expected_places(solution)[located])
    for count, (view, car) in enumerate(zip(located, answers, strict=True), start=1):
        if progress is not None:
            progress(count, len(images), None)
        if car is None or car.sigma_px is None:
            continue
        size = scene.camera_of(view).width, scene.camera_of(view).height
        seen = (car.confidence > 0) & (car.uv >= 0).all(1) & (car.uv < size).all(1)
        keypoints[view] = np.where(seen[:, None], np.column_stack([car.uv, car.confidence]), 0.0)
        sigma[view] = np.where(seen, car.sigma_px, 0.0)
    return replace(scene, keypoints=keypoints, sigma_px=sigma)


def expected_places(solution: Solution) -> Float[np.ndarray, "n j 2"]:
    """Pixels (distorted, as detected) of the solved points in every view; NaN behind a camera or without a pose."""
    if solution.lenses is None:
        return _as_detected(solution.points, solution.c2w, solution.camera)
    uv = np.empty((len(solution.c2w), len(solution.points), 2))
    for lens, camera in enumerate(solution.lenses.cameras):
        own = solution.lenses.of_view == lens
        uv[own] = _as_detected(solution.points, solution.c2w[own], camera)
    return uv


def _as_detected(
    points: Float[np.ndarray, "j 3"], c2w: Float[np.ndarray, "n 3 4"], camera: Camera
) -> Float[np.ndarray, "n j 2"]:
    uv = reproject(points, c2w, camera)
    return camera.distort(np.where(np.isfinite(uv), uv, np.nan))


def is_better(second: Solution, first: Solution) -> bool:
    """Whether a solution of points that were looked for again is to be kept: no view lost, and surer of the cameras."""
    now, before = (_RANK[second.status], _solved(second)), (_RANK[first.status], _solved(first))
    if now[0] < before[0] or now[1] < before[1]:
        return False
    return now > before or _sigma_m(second) < _sigma_m(first)


def _solved(solution: Solution) -> int:
    return int(solution.views_that_are(ViewStatus.SOLVED).sum())


def _sigma_m(solution: Solution) -> float:
    """Median standard deviation of the camera centres, in metres."""
    known = [view.sigma_trans_m for view in solution.views if view.sigma_trans_m is not None]
    return float(np.median(known)) if known else np.inf
