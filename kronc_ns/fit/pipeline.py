"""From a scene to a solution: start, solve, repair, stand the car upright, judge and complete the views."""

import math
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from typing_extensions import assert_never

from kronc_ns.errors import KroncError
from kronc_ns.fit.attempts import Attempt, adjust_starts, kept_steps, measured, misfit
from kronc_ns.fit.car_frame import standing, template_frame
from kronc_ns.fit.completion import complete
from kronc_ns.fit.depths import prior_depths, random_depths
from kronc_ns.fit.doubt import lead
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.repair import repair
from kronc_ns.fit.starts import (
    Hypothesis,
    Kind,
    circles,
    circular_poses,
    start_from_poses,
    start_from_template,
    usable_views,
)
from kronc_ns.fit.two_cars import two_cars
from kronc_ns.fit.unsolved import unsolved
from kronc_ns.fit.verdict import Evidence, judge
from kronc_ns.geometry.alignment import Similarity, umeyama
from kronc_ns.geometry.camera import rays
from kronc_ns.geometry.poses import camera_z, posed
from kronc_ns.keypoints.template import car_template
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status
from kronc_ns.solve.threads import side_by_side

_TOGETHER = 256  # scenes in a batch on a GPU
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
    (solution,) = _solve_some([scene], config or KroncConfig(), progress)
    if isinstance(solution, KroncError):
        raise solution
    return solution


def solve_scenes(
    scenes: Sequence[Scene], config: KroncConfig | None = None, progress: Progress | None = None
) -> list[Solution | KroncError]:
    """`solve_scene` of many scenes on all cores; an error takes the place of the solution of its scene only.

    ``progress`` is told the solver's steps of a single scene, else how many scenes are done.
    """
    config = config or KroncConfig()
    if len(scenes) == 1:
        return _solve_some(scenes, config, progress)
    size = _TOGETHER if config.device == "cuda" else 1
    groups = [scenes[first : first + size] for first in range(0, len(scenes), size)]
    run = map if config.device == "cuda" else side_by_side
    outcome: list[Solution | KroncError] = []
    for solutions in run(lambda group: _solve_some(group, config, None), groups):
        outcome += solutions
        if progress is not None:
            progress(len(outcome), len(scenes), math.nan)
    return outcome


def _solve_some(scenes: Sequence[Scene], config: KroncConfig, progress: Progress | None) -> list[Solution | KroncError]:
    """Scenes that go through the stages together."""
    start = time.perf_counter()
    outcome: dict[int, Solution | KroncError] = {}
    for i, scene in enumerate(scenes):
        try:
            _check(scene, config)
        except KroncError as error:
            outcome[i] = error
    if config.solver == "none":
        return [outcome[i] if i in outcome else unsolved(scene) for i, scene in enumerate(scenes)]
    possible = [i for i in range(len(scenes)) if i not in outcome]
    attempts: Sequence[Attempt | KroncError] = (
        _lm([scenes[i] for i in possible], config, progress)
        if config.solver == "lm"
        else [_adam(scenes[i], config, progress) for i in possible]
    )
    for i, attempt in zip(possible, attempts, strict=True):
        seconds = (time.perf_counter() - start) / len(scenes)
        outcome[i] = attempt if isinstance(attempt, KroncError) else _finish(scenes[i], attempt, config, seconds)
    return [outcome[i] for i in range(len(scenes))]


def _check(scene: Scene, config: KroncConfig) -> None:
    """Raise for options that this scene or machine cannot meet."""
    if config.device == "cuda":
        from kronc_ns.solve.batched import gpu_is_there  # seconds of torch's import

        if not gpu_is_there():
            raise KroncError('device "cuda" was asked for, but torch finds no CUDA GPU: use "cpu" or "auto"')
    if config.solver == "none" and scene.given_c2w is None:
        raise KroncError(
            'solver "none" takes poses as they are: expected a transform_matrix in every frame of transforms.json '
            "(and no solution beside it)"
        )
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


def _lm(scenes: Sequence[Scene], config: KroncConfig, progress: Progress | None) -> list[Attempt]:
    """The best attempt at every scene: starts are tried in turn until one is good, odd views repaired."""
    report = None if progress is None else lambda step, loss: progress(step, config.lm.iterations, loss)
    tried: list[list[Attempt]] = [[] for _ in scenes]
    tiers = [_tiers(scene, config) for scene in scenes]
    for rank in range(max(map(len, tiers), default=0)):
        starts = [
            (i, start)
            for i, tier in enumerate(tiers)
            if rank < len(tier) and not any(_good(attempt) for attempt in tried[i])
            for start in tier[rank]()
        ]
        fresh: dict[int, list[Attempt]] = defaultdict(list)
        for (i, _), attempt in zip(starts, adjust_starts([start for _, start in starts], config, report), strict=True):
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
    ranked = sorted((misfit(attempt), i) for i, attempt in enumerate(attempts))
    names = [f"{attempts[i].start.name} ({100 * (1 - lost):.0f} %)" for lost, i in ranked[:3]]
    choice = f"start: {names[0]} explains more of the detections than {', '.join(names[1:])}"
    return replace(attempts[ranked[0][1]], choice=choice)


def _tiers(scene: Scene, config: KroncConfig) -> list[Callable[[], list[Hypothesis]]]:
    """Groups of starts in the order in which they are tried."""
    match config.init:
        case "given":
            return [lambda: [start_from_poses("given", "given", scene, _given(scene))]]
        case "circular":
            return [lambda: circles(scene, config)]
        case "template":
            return [lambda: [start_from_template(scene)]]
        case "auto":
            tiers: list[Callable[[], list[Hypothesis]]] = []
            if scene.given_c2w is not None:
                tiers.append(lambda: [start_from_poses("given", "given", scene, _given(scene))])
            if car_template(scene.schema) is not None:
                tiers.append(lambda: [start_from_template(scene)])
            tiers.append(lambda: circles(scene, config))
            return tiers
        case _:
            assert_never(config.init)


def _given(scene: Scene) -> Float[np.ndarray, "n 3 4"]:
    assert scene.given_c2w is not None
    return scene.given_c2w


def _good(attempt: Attempt) -> bool:
    """Whether an attempt is so convincing that no other start need be tried."""
    scene = attempt.found.scene
    usable = usable_views(scene)
    diagonal = math.hypot(scene.camera.width, scene.camera.height)
    agreeing = int((attempt.agreeing & usable).sum())
    return agreeing >= max(1, _GOOD_SHARE * int(usable.sum())) and attempt.sigma_px < _GOOD_SIGMA * diagonal


def _adam(scene: Scene, config: KroncConfig, progress: Progress | None) -> Attempt | KroncError:
    """Algorithm 1 on the usable views, in float32."""
    from kronc_ns.solve.adam import minimise  # seconds of torch's import, which no other solver needs

    given = scene.given_c2w is not None and config.init in ("auto", "given")
    kind: Kind = "given" if given else "circular"
    initial = _given(scene) if given else circular_poses(len(scene), config.radius_m, config.direction, config.laps)
    usable = usable_views(scene)
    nowhere = np.full((len(scene.schema), 3), math.nan)
    start = Hypothesis(kind, kind, scene, initial, nowhere, usable, np.zeros_like(usable))
    c2w = np.full_like(initial, math.nan)
    if not usable.any():
        return measured(start, replace(start, c2w=c2w), 0, {}, np.empty((0, *c2w.shape)))
    depths = random_depths(initial, len(scene.schema), np.random.default_rng(config.seed))
    if config.depth_init != "random":
        assert scene.given_depths is not None
        depths = prior_depths(scene.given_depths, initial, rays(scene.uv, scene.camera), scene.visibility, depths)
    fixed = config.depth_init == "prior-fixed"
    settings = replace(config.adam, optimise_depths=config.adam.optimise_depths and not fixed)
    report = None if progress is None else lambda step, loss: progress(step, settings.steps, loss)
    result = minimise(
        initial[usable],
        depths[usable],
        scene.uv[usable],
        scene.visibility[usable],
        scene.camera,
        settings,
        config.device,
        report,
    )
    c2w[usable] = result.c2w
    seen = scene.seen[usable].sum(0) >= 2
    points = np.where(seen[:, None], result.points, math.nan)
    if not (np.isfinite(result.c2w).all() and np.isfinite(points[seen]).all()):
        return KroncError(
            "the optimisation diverged to values that are not finite: lower adam.learning_rate or mend the start"
        )
    path = np.full((len(result.path), *c2w.shape), math.nan)
    path[:, usable] = result.path
    path = path[kept_steps(len(path))]
    return measured(start, replace(start, c2w=c2w, points=points), result.steps, result.history, path)


def _finish(scene: Scene, attempt: Attempt, config: KroncConfig, seconds: float) -> Solution:
    """Place the world, judge every view and complete the walk."""
    start, found = attempt.start, attempt.found
    took_part = found.used & posed(found.c2w)
    enough = 2 if int(took_part.sum()) >= 2 else 1
    points = np.where((attempt.inlier.sum(0) >= enough)[:, None], found.points, math.nan)
    placement = _placement(scene, attempt, points, took_part, config)
    variance = np.diagonal(attempt.covariance(), axis1=-2, axis2=-1)
    evidence = Evidence(
        camera=found.scene.camera,
        c2w=np.where(took_part[:, None, None], placement.apply_to_poses(found.c2w), math.nan),
        points=placement.apply(points),
        sigma_rot_deg=np.rad2deg(np.sqrt(variance[:, :3].sum(1))),
        sigma_trans_m=np.sqrt(variance[:, 3:].sum(1)) * placement.scale,
        swapped=found.swapped,
        lead=lead(attempt),
        shape_weight=attempt.shape_weight if config.solver == "lm" and car_template(scene.schema) else None,
        converged=attempt.converged,
        iterations=attempt.iterations,
        noise=attempt.noise,
        two_cars=two_cars(attempt),
    )
    verdict = judge(found.scene, evidence)
    solved, views = verdict.solved, verdict.views
    c2w = np.where(solved[:, None, None], evidence.c2w, math.nan)
    if config.min_status == "completed":
        c2w, views = complete(found.scene, evidence, verdict)
    return Solution(
        status=verdict.status,
        reason="; ".join([verdict.reason, *_hints(start, attempt, verdict.status)]),
        names=scene.names,
        camera=found.scene.camera,
        c2w=c2w,
        points=evidence.points,
        depths=np.where(scene.seen & solved[:, None], camera_z(c2w, evidence.points), math.nan),
        views=views,
        initial_c2w=start.c2w,
        solver=config.solver,
        init=start.name,
        iterations=attempt.iterations,
        seconds=seconds,
        rmse_px=verdict.rmse_px,
        median_px=verdict.median_px,
        history=attempt.history,
        path=attempt.path,
        lenses=found.scene.lenses,
    )


def _hints(start: Hypothesis, attempt: Attempt, status: Status) -> list[str]:
    """What else the reason of a solution says."""
    hints = []
    if status is not Status.CONVERGED and start.name == "circular":
        hints.append("was the lap walked the other way (direction cw), or not whole (laps)? init auto finds out")
    if attempt.choice:
        hints.append(attempt.choice)
    return hints


def _placement(
    scene: Scene,
    attempt: Attempt,
    points: Float[np.ndarray, "j 3"],
    took_part: Bool[np.ndarray, "n"],
    config: KroncConfig,
) -> Similarity:
    """The gauge. Given poses that fit keep their frame; else a car stands in its own axes and metres.

    A known length of the car sets the scale in either case.
    """
    c2w, template = attempt.found.c2w[took_part], car_template(scene.schema)
    if not took_part.any() or int(np.isfinite(points).all(-1).sum()) < 3:
        return Similarity.identity()
    in_car_frame = Similarity.identity()
    if template is not None and config.solver == "adam":
        in_car_frame = template_frame(points, template)
    placement = in_car_frame if template is not None else standing(scene.schema, points, c2w, config.radius_m)
    if attempt.start.kind == "given":
        given = _given(scene)[took_part][..., 3]
        kept = umeyama(c2w[..., 3], given)
        off = np.median(np.linalg.norm(kept.apply(c2w[..., 3]) - given, axis=-1))
        # poses that the solution contradicts have no frame to keep
        if off <= _CONTRADICTED * np.linalg.norm(given - given.mean(0), axis=-1).mean():
            placement = kept
    if config.car_length_m is None or template is None:
        return placement
    length = template.length_m(in_car_frame.apply(points)) * placement.scale / in_car_frame.scale
    growth = config.car_length_m / length
    return Similarity(growth * placement.scale, placement.rotation, growth * placement.translation)
