"""From a scene to a solution: start, solve, repair, stand the car upright, check and complete the views."""

import hashlib
import json
import math
import os
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from pathlib import PurePosixPath
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from typing_extensions import assert_never

from kronc_ns.adjustment import Attempt, adjust_starts, measured, misfit, on_the_way
from kronc_ns.completion import complete
from kronc_ns.errors import KroncError
from kronc_ns.frame import standing, template_frame
from kronc_ns.geometry.alignment import Similarity, umeyama
from kronc_ns.geometry.camera import rays
from kronc_ns.init import circular_poses, prior_depths, random_depths
from kronc_ns.keypoints.io import describe_schema
from kronc_ns.keypoints.template import car_template
from kronc_ns.options import KroncConfig as KroncConfig
from kronc_ns.repair import repair
from kronc_ns.scene import Scene
from kronc_ns.solve.adam import AdamResult, minimise
from kronc_ns.solve.solution import Solution, Status, ViewStatus
from kronc_ns.solve.threads import one_thread, turn
from kronc_ns.starts import Start, circles, start_from_poses, start_from_template, usable_views
from kronc_ns.verify import Evidence, verify

_FORMAT = 5  # raised whenever the same input and options give another solution
_TOGETHER = 4  # scenes that go through the stages together
_CONTRADICTED = 0.5  # of the mean distance from their middle: given centres that are off by more are no use
_PROMISING = 2  # of the circles, those whose odd views are located anew
_GOOD_SHARE = 0.9  # views that agree, from which on no other start is tried
_GOOD_SIGMA = 0.004  # of the image diagonal: noise of a fit that is believed at once

Progress = Callable[[int, int, float], None]
"""Called with (step, steps, loss)."""


def solve_scene(scene: Scene, config: KroncConfig | None = None, progress: Progress | None = None) -> Solution:
    """Poses of all views that can be solved. No I/O; raises `KroncError` for options the scene cannot meet.

    Whatever the keypoints are worth is told by the solution's status and reason and is never raised.
    """
    (solution,) = solve_scenes([scene], config, progress)
    if isinstance(solution, KroncError):
        raise solution
    return solution


def solve_scenes(
    scenes: Sequence[Scene], config: KroncConfig | None = None, progress: Progress | None = None
) -> list[Solution | KroncError]:
    """`solve_scene` of many scenes, in batches; an error takes the place of the solution of its scene only.

    ``progress`` is told the solver's steps of a single scene, else how many scenes are done.
    """
    config = config or KroncConfig()
    if len(scenes) == 1:
        with one_thread():
            return _solve_some(scenes, config, progress)
    groups = [scenes[first : first + _TOGETHER] for first in range(0, len(scenes), _TOGETHER)]
    outcome: list[Solution | KroncError] = []
    lock = threading.Lock()

    def solve(group: Sequence[Scene]) -> list[Solution | KroncError]:
        with turn(lock):
            return _solve_some(group, config, None)

    with one_thread(), ThreadPoolExecutor(os.cpu_count()) as pool:
        for solutions in pool.map(solve, groups):
            outcome += solutions
            if progress is not None:
                progress(len(outcome), len(scenes), math.nan)
    return outcome


def _solve_some(scenes: Sequence[Scene], config: KroncConfig, progress: Progress | None) -> list[Solution | KroncError]:
    """Scenes that share batches, on one thread of the processor."""
    start = time.perf_counter()
    outcome: list[Solution | KroncError | None] = [None] * len(scenes)
    possible: list[int] = []
    for i, scene in enumerate(scenes):
        try:
            _check(scene, config)
            possible.append(i)
        except KroncError as error:
            outcome[i] = error
    if config.solver == "lm":
        attempts: Iterable[Attempt | KroncError] = _lm([scenes[i] for i in possible], config, _steps(progress, config))
    else:
        attempts = (_adam(scenes[i], config, progress) for i in possible)
    for i, attempt in zip(possible, attempts, strict=True):
        outcome[i] = attempt if isinstance(attempt, KroncError) else _finish(scenes[i], attempt, config)
    seconds = (time.perf_counter() - start) / max(1, len(scenes))
    return [replace(x, seconds=seconds) if isinstance(x, Solution) else x for x in outcome if x is not None]


def fingerprint(scene: Scene, config: KroncConfig) -> str:
    """Hash of everything the solution of a scene depends on: contents, options and version, but no paths."""
    settings = {**asdict(config), "device": None}
    given = scene.given_c2w if config.init in ("auto", "given") else None
    depths = scene.given_depths if config.depth_init != "random" else None
    names = [PurePosixPath(name).name for name in scene.names]
    header = json.dumps([_FORMAT, names, asdict(scene.camera), describe_schema(scene.schema), settings], sort_keys=True)
    digest = hashlib.sha256(header.encode())
    for array in (scene.keypoints, given, depths):
        digest.update(b"-" if array is None else array.double().numpy().tobytes())
    return digest.hexdigest()


def _check(scene: Scene, config: KroncConfig) -> None:
    """Raise for options that this scene or machine cannot meet."""
    if config.device == "cuda" and not torch.cuda.is_available():
        raise KroncError('device "cuda" was asked for, but torch finds no CUDA GPU: use "cpu" or "auto"')
    if config.init == "given" and scene.given_c2w is None:
        raise KroncError(
            'init="given" needs a transform_matrix in every frame of transforms.json (and no solution beside it): '
            'give poses, or use init="auto"'
        )
    if car_template(scene.schema) is None:
        wanted = "init template" if config.init == "template" else "car_length_m" if config.car_length_m else ""
        if wanted:
            raise KroncError(
                f"{wanted} needs the keypoints of a car template, and {scene.schema.name!r} has none: "
                "use the apollocar3d-66 schema, or leave the option out"
            )
    if config.solver == "adam":
        if config.init == "template":
            raise KroncError('init "template" needs solver "lm": adam starts from given poses or the circle')
        if config.depth_init != "random" and scene.given_depths is None:
            raise KroncError(
                f"depth_init {config.depth_init!r} needs depths: give a depth_file_path in every frame of "
                'transforms.json, let `kronc solve` estimate them from the images, or use depth_init "random"'
            )


def _steps(progress: Progress | None, config: KroncConfig) -> Callable[[int, float], None] | None:
    return None if progress is None else lambda step, value: progress(step, config.lm.iterations, value)


def _lm(scenes: Sequence[Scene], config: KroncConfig, progress: Callable[[int, float], None] | None) -> list[Attempt]:
    """The best attempt at every scene: starts are tried in turn until one is good, odd views repaired."""
    tried: list[list[Attempt]] = [[] for _ in scenes]
    tiers = [_tiers(scene, config) for scene in scenes]
    for rank in range(max(map(len, tiers), default=0)):
        starts = [
            (i, start)
            for i, tier in enumerate(tiers)
            if rank < len(tier) and not any(_good(attempt, scenes[i]) for attempt in tried[i])
            for start in tier[rank]()
        ]
        attempts = adjust_starts([start for _, start in starts], config, progress)
        fresh: dict[int, list[Attempt]] = defaultdict(list)
        for (i, _), attempt in zip(starts, attempts, strict=True):
            fresh[i].append(attempt)
        promising = [(i, attempt) for i, new in fresh.items() for attempt in _promising(new)]
        repaired = repair([attempt for _, attempt in promising], config)
        for (i, _), attempt in zip(promising, repaired, strict=True):
            tried[i].append(attempt)
    return [_best(attempts) for attempts in tried]


def _promising(attempts: Sequence[Attempt]) -> Sequence[Attempt]:
    return attempts if len(attempts) <= _PROMISING else sorted(attempts, key=misfit)[:_PROMISING]


def _best(attempts: Sequence[Attempt]) -> Attempt:
    """The attempt that leaves least unexplained, and why it was chosen."""
    if len(attempts) == 1:
        return replace(attempts[0], choice=f"start: {attempts[0].start.name}")
    ranked = sorted(((misfit(attempt), i) for i, attempt in enumerate(attempts)))
    names = [f"{attempts[i].start.name} ({100 * (1 - lost):.0f} %)" for lost, i in ranked[:3]]
    choice = f"start: {names[0]} explains more of the detections than {', '.join(names[1:])}"
    return replace(attempts[ranked[0][1]], choice=choice)


def _tiers(scene: Scene, config: KroncConfig) -> list[Callable[[], list[Start]]]:
    """Groups of starts in the order in which they are tried."""
    match config.init:
        case "given":
            return [lambda: [start_from_poses("given", scene, _given(scene))]]
        case "circular":
            return [lambda: circles(scene, config)]
        case "template":
            return [lambda: [start_from_template(scene)]]
        case "auto":
            tiers: list[Callable[[], list[Start]]] = []
            if scene.given_c2w is not None:
                tiers.append(lambda: [start_from_poses("given", scene, _given(scene))])
            if car_template(scene.schema) is not None:
                tiers.append(lambda: [start_from_template(scene)])
            tiers.append(lambda: circles(scene, config))
            return tiers
        case _:
            assert_never(config.init)


def _given(scene: Scene) -> Float[Tensor, "n 3 4"]:
    assert scene.given_c2w is not None
    return scene.given_c2w


def _good(attempt: Attempt, scene: Scene) -> bool:
    """Whether an attempt is so convincing that no other start need be tried."""
    usable = usable_views(scene)
    diagonal = math.hypot(scene.camera.width, scene.camera.height)
    agreeing = int((attempt.agreeing & usable).sum())
    return agreeing >= max(1, _GOOD_SHARE * int(usable.sum())) and attempt.sigma_px < _GOOD_SIGMA * diagonal


def _adam(scene: Scene, config: KroncConfig, progress: Progress | None) -> Attempt | KroncError:
    """Algorithm 1 on the usable views, in float32."""
    given = scene.given_c2w is not None and config.init in ("auto", "given")
    name: Literal["given", "circular"] = "given" if given else "circular"
    initial = _given(scene) if given else circular_poses(len(scene), config.radius_m, config.direction, config.laps)
    usable = usable_views(scene)
    c2w = torch.full_like(initial, math.nan)
    if not usable.any():
        points = torch.full((len(scene.schema), 3), math.nan, dtype=torch.float64)
        start = Start(name, scene, c2w, points, usable, torch.zeros_like(usable))
        return measured(start, initial, 0, {}, c2w.new_empty(0, *c2w.shape))
    device = torch.device("cuda" if config.device != "cpu" and torch.cuda.is_available() else "cpu")
    result = _minimise(scene, config, initial, usable, device, progress)
    c2w[usable] = result.c2w.double().cpu()
    seen = (scene.visibility * usable[:, None]).sum(0) >= 2
    points = torch.where(seen[:, None], result.points.double().cpu(), math.nan)
    if not (c2w[usable].isfinite().all() and points[seen].isfinite().all()):
        return KroncError(
            "the optimisation diverged to values that are not finite: lower adam.learning_rate or mend the start"
        )
    start = Start(name, scene, c2w, points, usable, torch.zeros_like(usable))
    path = c2w.repeat(len(result.path), 1, 1, 1)
    path[:, usable] = result.path.double().cpu()
    return measured(start, initial, result.steps, result.history, on_the_way(path, usable))


def _minimise(
    scene: Scene,
    config: KroncConfig,
    initial: Float[Tensor, "n 3 4"],
    usable: Bool[Tensor, "n"],
    device: torch.device,
    progress: Progress | None,
) -> AdamResult:
    generator = torch.Generator().manual_seed(config.seed)
    depths = random_depths(initial, len(scene.schema), generator)
    if config.depth_init != "random":
        assert scene.given_depths is not None
        depths = prior_depths(scene.given_depths, initial, rays(scene.uv, scene.camera), scene.visibility, depths)
    settings = replace(config.adam, optimise_depths=config.adam.optimise_depths and config.depth_init != "prior-fixed")
    camera = scene.camera
    initial, depths, uv, m = (
        x[usable].to(device, torch.float32) for x in (initial, depths, scene.uv, scene.visibility)
    )
    report = None if progress is None else lambda step, value: progress(step, settings.steps, value)
    return minimise(initial, depths, uv, m, (camera.fx, camera.fy), (camera.cx, camera.cy), settings, report)


def _finish(scene: Scene, attempt: Attempt, config: KroncConfig) -> Solution:
    """Place the world, verify every view and complete the walk."""
    start = attempt.start
    posed = start.used & start.c2w.isfinite().all(-1).all(-1)
    enough = 2 if int(posed.sum()) >= 2 else 1
    points = torch.where((attempt.inlier.sum(0) >= enough)[:, None], start.points, math.nan)
    placement = _placement(scene, attempt, points, posed, config)
    c2w = torch.where(posed[:, None, None], placement.apply_to_poses(start.c2w), math.nan)
    points = placement.apply(points)
    depths = ((points - c2w[:, None, :, 3]) * c2w[:, None, :, 2]).sum(-1)
    solution = Solution(
        status=Status.FAILED,
        reason="",
        names=scene.names,
        camera=start.scene.camera,
        c2w=c2w,
        points=points,
        depths=torch.where(start.scene.visibility > 0, depths, math.nan),
        views=(),
        initial_c2w=attempt.initial_c2w,
        solver=config.solver,
        init=start.name,
        iterations=attempt.iterations,
        seconds=0.0,
        rmse_px=math.nan,
        median_px=math.nan,
        history=attempt.history,
        path=attempt.path,
    )
    variance = attempt.covariance.diagonal(dim1=-2, dim2=-1)
    evidence = Evidence(
        sigma_rot_deg=variance[:, :3].sum(1).sqrt().rad2deg(),
        sigma_trans_m=variance[:, 3:].sum(1).sqrt() * placement.scale,
        swapped=start.swapped,
        converged=attempt.converged,
        shape_weight=attempt.shape_weight if config.solver == "lm" and car_template(scene.schema) else None,
    )
    views, status, reason, rmse_px, median_px = verify(start.scene, solution, evidence)
    if status is not Status.CONVERGED and start.name == "circular":
        reason += "; was the lap walked the other way (direction cw), or not whole (laps)? init auto finds out"
    if attempt.choice:
        reason += f"; {attempt.choice}"
    solved = torch.tensor([view.status is ViewStatus.SOLVED for view in views])
    solution = replace(
        solution,
        status=status,
        reason=reason,
        c2w=torch.where(solved[:, None, None], c2w, math.nan),
        depths=torch.where(solved[:, None], solution.depths, math.nan),
        views=tuple(views),
        rmse_px=rmse_px,
        median_px=median_px,
    )
    return complete(start.scene, solution) if config.min_status == "completed" and not solved.all() else solution


def _placement(
    scene: Scene, attempt: Attempt, points: Float[Tensor, "j 3"], posed: Bool[Tensor, "n"], config: KroncConfig
) -> Similarity:
    """The gauge. Given poses that fit keep their frame; else a car stands in its own axes and metres (see `frame`).

    A known length of the car sets the scale in either case.
    """
    c2w, template = attempt.start.c2w[posed], car_template(scene.schema)
    known = int(points.isfinite().all(-1).sum())
    identity = Similarity(torch.ones((), dtype=points.dtype), torch.eye(3, dtype=points.dtype), points.new_zeros(3))
    if not posed.any() or known < 3:
        return identity
    in_car_frame = identity
    if template is not None and config.solver == "adam":
        in_car_frame = template_frame(points, template)
    placement = in_car_frame if template is not None else standing(scene.schema, points, c2w, config.radius_m)
    if attempt.start.name == "given":
        given = _given(scene)[posed][..., 3]
        kept = umeyama(c2w[..., 3], given)
        off = (kept.apply(c2w[..., 3]) - given).norm(dim=-1).median()
        # poses that the solution contradicts have no frame to keep
        if off <= _CONTRADICTED * (given - given.mean(0)).norm(dim=-1).mean():
            placement = kept
    if config.car_length_m is None or template is None:
        return placement
    length = template.length_m(in_car_frame.apply(points)) * placement.scale / in_car_frame.scale
    growth = config.car_length_m / length
    return Similarity(growth * placement.scale, placement.rotation, growth * placement.translation)
