"""From a scene to a solution: initialise, optimise, stand the car upright, check every view."""

import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import PurePosixPath
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from typing_extensions import assert_never

from kronc_ns import objective
from kronc_ns.errors import KroncError
from kronc_ns.geometry.alignment import Similarity, umeyama
from kronc_ns.init import Direction, circular_poses, prior_depths, random_depths
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.scene import Scene
from kronc_ns.solve.adam import AdamConfig, AdamResult, minimise
from kronc_ns.solve.solution import Solution, Status, ViewReport, ViewStatus

MIN_POINTS = 4
"""A view with fewer keypoints cannot be placed (three points have up to four poses)."""
MIN_VIEWS = 3
INLIER_SIGMAS = 5.0
"""A detection counts as inlier up to this many robust standard deviations of all residuals."""
POOR_FIT = 0.01
"""A median residual above this share of the image diagonal is no fit (a detector's noise is 0.1 to 0.4 %)."""


_FORMAT = 1  # raised whenever the same input and options give another solution


@dataclass(frozen=True)
class KroncConfig:
    """How a scene is solved; the presets in ``configs/`` are values of this."""

    solver: Literal["adam"] = "adam"
    """adam: Algorithm 1 of the paper."""
    init: Literal["auto", "circular", "given"] = "auto"
    """Initial poses: the paper's circle, those given in transforms.json, or (auto) given ones if there are any."""
    radius_m: float = 4.0
    """Radius of the circle."""
    direction: Direction = "ccw"
    """Sense of the circle, seen from above."""
    laps: float = 1.0
    """How much of the circle was walked: 0.5 is half a lap."""
    depth_init: Literal["random", "prior", "prior-fixed"] = "random"
    """Initial depths: random in [omega/2, omega], or from depth maps (then optimised, or kept as they are)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes a GPU when there is one."""
    seed: int = 0
    """Seed of the random depths."""
    adam: AdamConfig = field(default_factory=AdamConfig)
    """Parameters of Algorithm 1."""

    def __post_init__(self) -> None:
        positive = {
            "radius_m": self.radius_m,
            "laps": self.laps,
            "adam.steps": self.adam.steps,
            "adam.learning_rate": self.adam.learning_rate,
        }
        for name, value in positive.items():
            if not 0 < value < math.inf:
                raise KroncError(f"{name} is {value}: expected a finite number above 0")
        if min(self.adam.weight_2d, self.adam.weight_3d) < 0 or self.adam.weight_2d + self.adam.weight_3d <= 0:
            raise KroncError("adam.weight_2d and adam.weight_3d must not be negative, and not both be 0")


Progress = Callable[[int, int, float], None]
"""Called with (step, steps, loss)."""


def resolve_init(scene: Scene, config: KroncConfig) -> Literal["circular", "given"]:
    """Which initial poses `solve_scene` will take for this scene."""
    if config.init == "auto":
        return "circular" if scene.given_c2w is None else "given"
    if config.init == "given" and scene.given_c2w is None:
        raise KroncError(
            'init="given" needs a transform_matrix in every frame of transforms.json (and no solution beside it): '
            'give poses, or use init="circular"'
        )
    return config.init


def initial_poses(scene: Scene, config: KroncConfig) -> Float[Tensor, "n 3 4"]:
    """Initial poses of all views (OpenCV c2w, float64)."""
    how = resolve_init(scene, config)
    match how:
        case "given":
            assert scene.given_c2w is not None
            return scene.given_c2w
        case "circular":
            return circular_poses(len(scene), config.radius_m, config.direction, config.laps)
        case _:
            assert_never(how)


def solve_scene(scene: Scene, config: KroncConfig | None = None, progress: Progress | None = None) -> Solution:
    """Poses of all views that can be solved. No I/O; raises `KroncError` where the input cannot be solved at all.

    Views with fewer than `MIN_POINTS` keypoints take no part and come out as failed. A solution of doubtful
    quality is returned with its status and reason, not raised.
    """
    config = config or KroncConfig()
    start = time.perf_counter()
    visible = scene.visibility.sum(1)
    usable = visible >= MIN_POINTS
    if int(usable.sum()) < MIN_VIEWS:
        raise KroncError(
            f"{int(usable.sum())} of {len(scene)} views have {MIN_POINTS} or more keypoints: "
            f"expected at least {MIN_VIEWS}; check the detections or lower the detector's threshold"
        )
    m = scene.visibility * usable[:, None]
    if int((m.sum(0) >= 2).sum()) < MIN_POINTS:
        raise KroncError(
            f"fewer than {MIN_POINTS} keypoints are seen by two or more views: "
            "the views do not overlap; add views between"
        )
    device = torch.device("cuda" if config.device == "auto" and torch.cuda.is_available() else _device(config))
    initial = initial_poses(scene, config)
    result = _optimise(scene, config, initial, usable, device, progress)

    c2w = torch.full_like(initial, math.nan)
    c2w[usable] = result.c2w.double().cpu()
    points = torch.where((m.sum(0) >= 2)[:, None], result.points.double().cpu(), math.nan)
    depths = torch.full_like(m, math.nan)
    depths[usable] = result.depths.double().cpu()
    if not (c2w[usable].isfinite().all() and points[m.sum(0) >= 2].isfinite().all()):
        raise KroncError(
            "the optimisation diverged to values that are not finite: lower adam.learning_rate or mend the start"
        )

    placement = _placement(scene, config, initial[usable], c2w[usable], points)
    c2w[usable] = placement.apply_to_poses(c2w[usable])
    points, depths = placement.apply(points), torch.where(m > 0, depths * placement.scale, math.nan)
    solution = Solution(
        status=Status.CONVERGED,
        reason="",
        names=scene.names,
        camera=scene.camera,
        c2w=c2w,
        points=points,
        depths=depths,
        views=(),
        initial_c2w=initial,
        solver=config.solver,
        init=resolve_init(scene, config),
        iterations=result.steps,
        seconds=0.0,
        rmse_px=math.nan,
        median_px=math.nan,
        history=result.history,
    )
    return replace(verify(scene, solution), seconds=time.perf_counter() - start)


def fingerprint(scene: Scene, config: KroncConfig) -> str:
    """Hash of everything the solution of a scene depends on: contents, options and version, but no paths."""
    settings = {**asdict(config), "init": resolve_init(scene, config), "device": None}
    given = scene.given_c2w if settings["init"] == "given" else None
    depths = scene.given_depths if config.depth_init != "random" else None
    names = [PurePosixPath(name).name for name in scene.names]
    header = json.dumps([_FORMAT, names, asdict(scene.camera), scene.schema.name, settings], sort_keys=True)
    digest = hashlib.sha256(header.encode())
    for array in (scene.keypoints, given, depths):
        digest.update(b"-" if array is None else array.double().numpy().tobytes())
    return digest.hexdigest()


def _device(config: KroncConfig) -> str:
    if config.device == "cuda" and not torch.cuda.is_available():
        raise KroncError('device "cuda" was asked for, but torch finds no CUDA GPU: use "cpu" or "auto"')
    return "cuda" if config.device == "cuda" else "cpu"


def _optimise(
    scene: Scene,
    config: KroncConfig,
    initial: Float[Tensor, "n 3 4"],
    usable: Bool[Tensor, "n"],
    device: torch.device,
    progress: Progress | None,
) -> AdamResult:
    """Algorithm 1 on the usable views, in float32 on ``device``."""
    generator = torch.Generator().manual_seed(config.seed)
    depths = random_depths(initial, len(scene.schema), generator)
    if config.depth_init != "random":
        if scene.given_depths is None:
            raise KroncError(
                f"depth_init {config.depth_init!r} needs a depth_file_path in every frame of transforms.json: "
                'give depth maps, or use depth_init "random"'
            )
        metric = resolve_init(scene, config) == "given"
        depths = prior_depths(scene.given_depths, initial, depths, metric)
    settings = replace(config.adam, optimise_depths=config.adam.optimise_depths and config.depth_init != "prior-fixed")
    camera = scene.camera
    initial, depths, uv, m = (
        x[usable].to(device, torch.float32) for x in (initial, depths, scene.uv, scene.visibility)
    )
    report = None if progress is None else lambda step, value: progress(step, settings.steps, value)
    return minimise(initial, depths, uv, m, (camera.fx, camera.fy), (camera.cx, camera.cy), settings, report)


def _placement(
    scene: Scene,
    config: KroncConfig,
    initial: Float[Tensor, "u 3 4"],
    c2w: Float[Tensor, "u 3 4"],
    points: Float[Tensor, "j 3"],
) -> Similarity:
    """The gauge: given poses keep their frame; otherwise the car stands upright on the origin.

    Keypoints alone know neither position nor scale. Without given poses the world is x forward, y left, z up
    about the car's centre, scaled so that the cameras' mean distance is the circle's radius.
    """
    if resolve_init(scene, config) == "given":
        return umeyama(c2w[..., 3], initial[..., 3])
    rotation = car_axes(scene.schema, points, -c2w[..., 1].mean(0))
    known = points[points.isfinite().all(-1)]
    turned = known @ rotation.T
    centre = rotation.T @ ((turned.amin(0) + turned.amax(0)) / 2)
    distance = (c2w[..., 3] - centre).norm(dim=-1).mean()
    scale = config.radius_m / distance
    return Similarity(scale, rotation, -scale * rotation @ centre)


def car_axes(
    schema: KeypointSchema, points: Float[Tensor, "j 3"], camera_up: Float[Tensor, "3"]
) -> Float[Tensor, "3 3"]:
    """Rotation whose rows are the car's forward, left and up directions in the solver's world.

    Left comes from the mirror pairs, forward from the wheel bases; with an unknown schema up is the cameras' mean
    up and the heading is arbitrary. NaN points are ignored.
    """
    up = torch.nn.functional.normalize(camera_up, dim=0)
    pairs = torch.tensor(schema.mirror_pairs, dtype=torch.long).reshape(-1, 2)
    across = points[pairs[:, 0]] - points[pairs[:, 1]]
    across = across[across.isfinite().all(-1)]
    if len(across):
        left = torch.nn.functional.normalize(torch.nn.functional.normalize(across, dim=-1).mean(0), dim=0)
    else:
        helper = torch.eye(3, dtype=points.dtype)[int(up.abs().argmin())]
        left = torch.nn.functional.normalize(torch.linalg.cross(up, helper), dim=0)
    forward = torch.linalg.cross(left, up)
    if schema.wheels:
        left_front, right_front, left_rear, right_rear = points[list(schema.wheels)]
        bases = torch.stack([left_front - left_rear, right_front - right_rear])
        bases = bases[bases.isfinite().all(-1)]
        if len(bases):
            forward = bases.mean(0)
    forward = torch.nn.functional.normalize(forward - (forward @ left) * left, dim=0)
    return torch.stack([forward, left, torch.linalg.cross(forward, left)])


def residuals_px(scene: Scene, solution: Solution) -> Float[Tensor, "n j"]:
    """Reprojection error of every detection against the solved points; NaN where there is none, inf behind a camera."""
    c2w, points = solution.c2w, solution.points
    uv = objective.reproject(points, c2w, solution.camera)
    error = (uv - scene.uv).norm(dim=-1)
    z = ((points - c2w[:, None, :, 3]) * c2w[:, None, :, 2]).sum(-1)
    error = torch.where(z > 0, error, torch.inf)
    known = (scene.visibility > 0) & c2w.isfinite().all(-1).all(-1)[:, None] & points.isfinite().all(-1)
    return torch.where(known, error, math.nan)


def verify(scene: Scene, solution: Solution) -> Solution:
    """The solution with a report on every view, failed views taken out, and an overall status with its reason."""
    error = residuals_px(scene, solution)
    measured = error[error.isfinite()]
    diagonal = math.hypot(scene.camera.width, scene.camera.height)
    # the norm of 2D normal noise has its median at 1.177 sigma; never below a tenth of a pixel
    sigma = max(float(measured.median()) / 1.177, 0.1) if len(measured) else math.inf
    inlier = error <= min(INLIER_SIGMAS * sigma, POOR_FIT * 3 * diagonal)
    seen, inliers = (~error.isnan()).sum(1), inlier.sum(1)
    squared = torch.where(inlier, error.square(), 0.0)
    rmse = (squared.sum(1) / inliers).sqrt()

    reports = []
    for i, name in enumerate(scene.names):
        found, good = int(scene.visibility[i].sum()), int(inliers[i])
        if found < MIN_POINTS:
            reason = f"{found} keypoints, at least {MIN_POINTS} are needed"
        elif good < MIN_POINTS or 2 * good < int(seen[i]):
            reason = f"only {good} of {int(seen[i])} keypoints agree with the other views"
        else:
            reason = ""
        status = ViewStatus.FAILED if reason else ViewStatus.SOLVED
        reports.append(ViewReport(name, status, found, good, None if reason else float(rmse[i]), reason=reason))
    solved = torch.tensor([report.status is ViewStatus.SOLVED for report in reports])
    kept = inlier & solved[:, None]
    median = float(error[solved].nanmedian()) if solved.any() else math.nan
    total = float((torch.where(kept, error.square(), 0.0).sum() / kept.sum().clamp_min(1)).sqrt())
    status, reason = _judge(
        len(scene), int(solved.sum()), float(measured.median()) if len(measured) else math.inf, diagonal
    )
    if status is not Status.CONVERGED and solution.init == "circular":
        reason += "; was the lap walked the other way (direction cw), or not whole (laps)?"
    return replace(
        solution,
        status=status,
        reason=reason,
        c2w=torch.where(solved[:, None, None], solution.c2w, math.nan),
        depths=torch.where(solved[:, None], solution.depths, math.nan),
        views=tuple(reports),
        rmse_px=total,
        median_px=median,
    )


def _judge(views: int, solved: int, median_px: float, diagonal: float) -> tuple[Status, str]:
    share = median_px / diagonal
    fit = f"median reprojection error {median_px:.2f} px ({100 * share:.2f} % of the image diagonal)"
    if solved < MIN_VIEWS:
        return Status.FAILED, f"{solved} of {views} views agree with each other; {fit}"
    if share > POOR_FIT:
        return Status.FAILED, f"the keypoints do not fit together: {fit}, expected below {100 * POOR_FIT:g} %"
    if share > POOR_FIT / 2:
        return Status.WEAK, f"the keypoints fit poorly: {fit}"
    if 2 * solved < views:
        return Status.WEAK, f"only {solved} of {views} views are solved; {fit}"
    return Status.CONVERGED, f"{solved} of {views} views solved; {fit}"
