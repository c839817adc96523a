"""What the suites solve: car shapes, captures of them, and a solution's errors beside the best that the data allow."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from kronc_ns.benchmark.figures import pose_figures
from kronc_ns.benchmark.paper import START
from kronc_ns.benchmark.peers.ceres import bundle_adjustment
from kronc_ns.benchmark.subjects import capture_scene
from kronc_ns.errors import KroncError
from kronc_ns.files.output import read_json
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.poses import posed
from kronc_ns.solution import Solution, Status
from kronc_ns.synthetic.car import CarShape, build_car
from kronc_ns.synthetic.scenes import (
    HEMISPHERE_RADIUS_M,
    Capture,
    Preset,
    default_camera,
    hemisphere_poses,
    observe,
    walk_poses,
)
from kronc_ns.synthetic.variations import noisy_poses, on_wheels

REPORT_SEEDS = 100
"""Seeds below are for reports; what is tuned is tuned on seeds from here on."""
DEFAULT = KroncConfig()
"""What a user gets: poses that come with a scene are tried first."""
_TUNING_SHAPES = 40  # the first shapes of a file were looked at while building, the others are held out


@dataclass(frozen=True)
class Shapes:
    """Car shapes by seed: from a file, or random procedural cars."""

    report: tuple[Float[np.ndarray, "66 3"], ...] = ()
    tuning: tuple[Float[np.ndarray, "66 3"], ...] = ()

    def __call__(self, seed: int) -> Float[np.ndarray, "66 3"]:
        """Keypoints of the seed's car: report seeds only ever meet held-out shapes."""
        shapes = self.report if seed < REPORT_SEEDS else self.tuning
        return shapes[seed % len(shapes)] if shapes else random_car(seed)

    def __str__(self) -> str:
        return f"{len(self.report)} held-out car shapes" if self.report else "random procedural cars"


@dataclass(frozen=True)
class Options:
    """What can be chosen about the rows."""

    shapes: Shapes = Shapes()
    first_seed: int = 0
    adam_seeds: int = 0
    """On so many seeds the paper's 10,000 Adam steps run beside."""
    scenes: int = 1000
    """Scenes of the row of throughput."""

    def with_adam(self, seed: int) -> bool:
        """Whether Adam runs beside on this seed."""
        return seed - self.first_seed < self.adam_seeds


def load_shapes(path: Path) -> Shapes:
    """Read {"cars": [{"keypoints": [66 x [x, y, z]]}, ...]} (metres, x forward, y left, z up); 41 or more cars."""
    content = read_json(path)
    try:
        cars = [np.array(car["keypoints"], dtype=np.float64) for car in content["cars"]]
    except (KeyError, TypeError, ValueError):
        cars = []
    if len(cars) <= _TUNING_SHAPES or any(car.shape != (66, 3) or not np.isfinite(car).all() for car in cars):
        raise KroncError(
            f"{path}: expected more than {_TUNING_SHAPES} cars with 66 finite keypoints each, as "
            '{"cars": [{"keypoints": [[x, y, z], ...]}, ...]}'
        )
    grounded = tuple(on_wheels(car) for car in cars)
    return Shapes(report=grounded[_TUNING_SHAPES:], tuning=grounded[:_TUNING_SHAPES])


@lru_cache(maxsize=256)
def random_car(seed: int) -> Float[np.ndarray, "66 3"]:
    """Keypoints of a procedural car in any proportions."""
    return build_car(CarShape.random(np.random.default_rng(seed))).keypoints


def capture_shape(
    points: Float[np.ndarray, "66 3"],
    preset: Preset,
    seed: int,
    views: int = 100,
    noise_px: float = 1.0,
    outliers: float = 0.0,
    laps: float = 1.0,
    clockwise: bool = False,
) -> tuple[Capture, np.random.Generator]:
    """A capture of a shape, visibility by its hull; and the generator, for whatever else is to happen to it."""
    rng = np.random.default_rng(seed)
    if preset == "walk":
        c2w = walk_poses(views, rng, laps=laps, clockwise=clockwise)
    else:
        c2w = hemisphere_poses(views, HEMISPHERE_RADIUS_M, rng)
    return observe(points, c2w, default_camera(preset), rng, noise_px, outliers=outliers), rng


def noisy_start(capture: Capture, seed: int, pose_noise: tuple[float, float] = START) -> Float[np.ndarray, "n 3 4"]:
    """The true poses with (degrees, metres) of noise."""
    return noisy_poses(capture.c2w, *pose_noise, np.random.default_rng((seed, 1)))  # not the capture's own draws again


def best_poses(capture: Capture) -> Float[np.ndarray, "n 3 4"]:
    """The yardstick: maximum likelihood from the truth, on true inliers alone where there are outliers.

    An oracle: no solver knows which detections are wild, so none can be expected below it on average, unless it
    knows something of cars (as a shape prior does: with few views that is worth more than some of the data).
    """
    return bundle_adjustment(capture_scene(capture), capture.c2w, capture.points, ~capture.wild).c2w


def solve_capture(
    capture: Capture,
    config: KroncConfig,
    start: Float[np.ndarray, "n 3 4"] | None = None,
    best: Float[np.ndarray, "n 3 4"] | None = None,
) -> tuple[Solution, dict[str, float]]:
    """Solve a capture, and the figures of the solution (see `solution_figures`)."""
    solution = solve_scene(capture_scene(capture, start), config)
    return solution, solution_figures(solution, capture.c2w, best)


def solution_figures(
    solution: Solution, truth: Float[np.ndarray, "n 3 4"], best: Float[np.ndarray, "n 3 4"] | None = None
) -> dict[str, float]:
    """Errors over the views with a pose, their share, time; with ``best`` its errors and the ratio to them.

    Ratios compare the views that have a pose in both.
    """
    figures = {
        **_errors(solution.c2w, truth),
        "converged": float(solution.status is Status.CONVERGED),
        "seconds": solution.seconds,
    }
    if best is not None:
        both = posed(solution.c2w) & posed(best)
        ours, limit = _errors(solution.c2w[both], truth[both]), _errors(best[both], truth[both])
        for name in ("rotation_deg", "centre_cm"):
            figures[f"best_{name}"] = limit[name]
            figures[f"{name.split('_')[0]}_ratio"] = ours[name] / limit[name]
    return figures


def _errors(c2w: Float[np.ndarray, "n 3 4"], truth: Float[np.ndarray, "n 3 4"]) -> dict[str, float]:
    count = int(posed(c2w).sum())
    if count < 3:
        raise KroncError(f"{count} of {len(c2w)} views have a pose: no errors can be given")
    return pose_figures(c2w, truth)
