"""Small problems for the solver's tests."""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.alignment import Similarity, pose_errors
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.solve import records, schur
from kronc_ns.solve.problem import OrbitPrior, Problem, ShapePrior, State
from kronc_ns.synthetic.variations import noisy_poses

FOCAL = (400.0, 390.0)
SIMILARITY = Similarity(1.7, so3_exp(np.array([0.4, -1.1, 0.7])), np.array([0.5, -2.0, 3.0]))
HALF_TURN = np.array([-1.0, 1.0, -1.0])
"""About the camera's y axis."""
VARIANTS = {
    "plain": (),
    "focal": ("focal",),
    "k1": ("k1",),
    "focal and k1": ("focal", "k1"),
    "shape": ("shape",),
    "orbit": ("orbit",),
    "points known": ("known",),
    "points known, focal": ("known", "focal", "orbit"),
    "everything": ("k1", "focal", "shape", "orbit"),
}
SEVERAL_LENSES = {
    "two lenses": ("focal", "k1", "lenses"),
    "two lenses, everything": ("k1", "focal", "shape", "orbit", "lenses"),
}
"""What the solver for a GPU does not know."""
BELIEF, VARIANCE = 0.7, 2.3
"""Weights of the shape prior and of expected centres."""


def randn(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def scene(
    views: int = 8,
    joints: int = 12,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    seen: float = 0.8,
    seed: int = 0,
    draw: int = 0,
    **options,
) -> tuple[Problem, State]:
    """Cameras in a lap around a cloud of points 1 m wide, what they see of it, and the truth.

    ``seed`` chooses cameras and points, ``draw`` what is seen of them and the noise.
    """
    c2w = noisy_poses(circular_poses(views), 6.0, 0.3, np.random.default_rng(seed + 1))
    truth = State.of(c2w, 0.7 * randn(joints, 3, seed=seed))
    rng = np.random.default_rng([seed, draw])
    uv = projections(truth) + noise_px * rng.normal(size=(views, joints, 2))
    uv = np.where(rng.random((views, joints, 1)) < outliers, rng.uniform(-150.0, 150.0, uv.shape), uv)
    weight = np.where(rng.random((views, joints)) < seen, rng.uniform(0.5, 1.5, (views, joints)), 0.0)
    return Problem(uv, weight, FOCAL, **options), truth


def projections(state: State) -> Float[np.ndarray, "n j 2"]:
    """Where points are seen through a lens without distortion, in pixels less the principal point."""
    camera = state.points @ state.rotation.swapaxes(1, 2) + state.translation[:, None]
    return camera[..., :2] / camera[..., 2:] * FOCAL


def started(truth: State, rotation_deg: float = 4.0, metres: float = 0.3, seed: int = 9) -> State:
    """Off from the truth: every camera by so much, every point by 0.2 m."""
    c2w = noisy_poses(truth.c2w, rotation_deg, metres, np.random.default_rng(seed))
    return State.of(c2w, truth.points + 0.2 * randn(*truth.points.shape, seed=seed))


def moved(state: State, world: Similarity) -> State:
    """The same scene in another world."""
    return State.of(world.apply_to_poses(state.c2w), world.apply(state.points))


def errors(found: State, truth: State) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Degrees and metres of each view."""
    return pose_errors(found.c2w, truth.c2w)


def evaluated(problem: Problem, state: State) -> records.Estimate:
    """A state with all that follows from it, as the compiled loops have it."""
    data = records.measured(problem)
    now = records.estimate(data, state)
    schur.evaluate(data, now)
    return now


def lengths(problem: Problem, state: State) -> Float[np.ndarray, "n j"]:
    """Weighted residuals in pixels; 0 where nothing is seen."""
    length = np.zeros(problem.weight.shape)
    length[problem.weight > 0] = evaluated(problem, state).length
    return length


def shape_prior(joints: int) -> ShapePrior:
    root = randn(3 * joints, 3 * joints, seed=20)
    return ShapePrior.of(0.5 * randn(joints, 3, seed=21), root @ root.T / joints)


def orbit_prior(truth: State) -> OrbitPrior:
    centre = truth.c2w[..., 3] + 0.1 * randn(*truth.translation.shape, seed=22)
    sigma = np.full(len(centre), 0.2)
    sigma[1] = math.inf  # nothing is expected of this view
    return OrbitPrior(centre, sigma)


def posed(variant: str, views: int = 4, joints: int = 6) -> tuple[Problem, State, np.ndarray]:
    """A problem, a state off the solution with a bent lens, and weights of all detections."""
    options = {**VARIANTS, **SEVERAL_LENSES}[variant]
    problem, truth = scene(views, joints, noise_px=2.0)
    problem = replace(
        problem,
        refine=tuple(name for name in options if name in ("focal", "k1")),
        shape=shape_prior(joints) if "shape" in options else None,
        orbit=orbit_prior(truth) if "orbit" in options else None,
        points_known="known" in options,
        lens=np.arange(views) % 2 if "lenses" in options else None,
    )
    of_lens = {"log_growth": np.array([0.1, -0.05]), "k1": np.array([-0.07, 0.02])}
    state = replace(started(truth), **(of_lens if "lenses" in options else {"log_growth": 0.1, "k1": -0.07}))
    return problem, state, problem.weight * np.random.default_rng(5).random(problem.weight.shape)
