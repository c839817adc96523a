"""From the poses of keypoints to those of image features: gather, match, adjust, judge."""

import math
import time
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.fit.car_frame import standing, template_frame
from kronc_ns.fit.verdict import MIN_VIEWS, SURE_DEG, SURE_SHARE, inliers
from kronc_ns.geometry.alignment import Similarity
from kronc_ns.geometry.camera import Camera, Lenses
from kronc_ns.geometry.poses import camera_z, unit
from kronc_ns.keypoints.template import car_template
from kronc_ns.refine.counter import Counter, Progress
from kronc_ns.refine.gathering import Gathered, gather
from kronc_ns.refine.keypoints import alike, keypoint_tracks
from kronc_ns.refine.options import RefineConfig
from kronc_ns.refine.pictures import Pictures
from kronc_ns.refine.placement import placed
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.rounds import Found, Prepared, find_poses, prepare
from kronc_ns.refine.tracks import Tracks, long_sightings
from kronc_ns.refine.uncertainty import pose_sigmas
from kronc_ns.refine.verdict import Evidence
from kronc_ns.scene import Scene
from kronc_ns.solution import Cloud, ImageEvidence, Solution, Status, ViewReport, ViewStatus

_SOLVED_BY = 20  # features of three views that make a view's pose known


def refine_scene(
    scene: Scene,
    solution: Solution,
    pictures: Pictures,
    config: RefineConfig | None = None,
    progress: Progress | None = None,
) -> Solution:
    """The solution with poses from image features where these are better, else as it was; `Solution.images` says why.

    ``scene`` is as the solver took it, left and right put right. No files are read but by ``pictures``.
    """
    config = config or RefineConfig()
    begin = time.perf_counter()
    views = np.flatnonzero(solution.posed)
    focal = solution.camera.fx
    untouched = ImageEvidence(
        False, "", "frame", False, (), (0,) * len(scene), 0, None, None, 0.0, 0.0, None, focal, focal, 0.0
    )
    if solution.status is Status.FAILED or len(views) < MIN_VIEWS:
        reason = f"{len(views)} views have a pose: expected {MIN_VIEWS} or more of a solution that has not failed"
        return replace(solution, images=replace(untouched, reason=reason))
    scene = replace(scene, camera=solution.camera, lenses=solution.lenses)
    counter = Counter(progress)
    prepared, frame = prepare_scene(scene, solution, pictures, config, counter)
    region = "vehicle" if prepared.vehicle_only else "frame"
    said = replace(untouched, region=region, background_still=prepared.background_still)
    found = find_poses(prepared, config, counter)
    if found is None:
        reason = "the photos have too few features in common"
        return replace(solution, images=replace(said, reason=reason, seconds=time.perf_counter() - begin))
    evidence = found.evidence
    if not evidence.objection:
        prepared, found = _with_newcomers(scene, solution, prepared, found, pictures, config, counter)
    tracks = found.adjusted.tracks
    said = replace(
        said,
        accepted=not evidence.objection,
        reason=evidence.objection or _praise(evidence),
        tracks_by_length=tuple(np.bincount(tracks.lengths).tolist()),
        observations=tuple(_per_view(tracks, found.adjusted.gathered, prepared.views, len(scene)).tolist()),
        held_out=evidence.held,
        held_out_before_px=_known(evidence.held_before_px),
        held_out_after_px=_known(evidence.held_after_px),
        held_out_z=evidence.held_z,
        keypoints_z=evidence.keypoints_z,
        noise_px=found.adjusted.sigma_px,
    )
    if evidence.objection:
        return replace(solution, images=replace(said, seconds=time.perf_counter() - begin))
    return _taken(scene, solution, found, prepared, frame, said, config, begin)


def prepare_scene(
    scene: Scene, solution: Solution, pictures: Pictures, config: RefineConfig, counter: Counter
) -> tuple[Prepared, Similarity]:
    """The views that have a pose, and their features; and what carries the solution's world to that of the features.

    The scene's cameras are those of the solution.
    """
    views = np.flatnonzero(solution.posed)
    frame, has_ground = _frame(scene, solution)
    lenses, of_view = _lenses(scene)
    start = Rig.of(solution.c2w[views], lenses, of_view[views], solution.points).moved(frame)
    keypoints = keypoint_tracks(scene, solution, views)
    return prepare(scene, views, start, keypoints, has_ground, pictures, config, counter), frame


def _with_newcomers(
    scene: Scene,
    solution: Solution,
    prepared: Prepared,
    found: Found,
    pictures: Pictures,
    config: RefineConfig,
    counter: Counter,
) -> tuple[Prepared, Found]:
    """Views that keypoints gave no pose and features do join, and all are matched and adjusted anew."""
    absent = np.setdiff1d(np.arange(len(scene)), prepared.views)
    if not len(absent):
        return prepared, found
    rig = found.adjusted.rig
    count = len(absent)
    nowhere = replace(
        rig,
        rotation=np.tile(np.eye(3), (count, 1, 1)),
        translation=np.zeros((count, 3)),
        lens=_lenses(scene)[1][absent],
    )
    up = np.tile(unit(rig.rotation[:, :, 2].mean(0)), (count, 1))
    counter.expect(count)
    cameras = [scene.camera_of(view) for view in absent.tolist()]
    features = gather(pictures, absent, cameras, up, np.full((count, count), math.inf), counter.advance)
    used = np.ones(len(features.view), bool)
    if prepared.vehicle_only and features.on_vehicle is not None:
        used = features.on_vehicle
    newcomers = placed(found.adjusted, prepared.gathered, features, used, nowhere)
    come = np.isfinite(newcomers.translation).all(1)
    if not come.any():
        return prepared, found
    views = np.concatenate([prepared.views, absent[come]])
    order = np.argsort(views)
    everyone = replace(
        rig,
        rotation=np.concatenate([rig.rotation, newcomers.rotation[come]])[order],
        translation=np.concatenate([rig.translation, newcomers.translation[come]])[order],
        lens=np.concatenate([rig.lens, newcomers.lens[come]])[order],
    )
    keypoints = keypoint_tracks(scene, solution, views[order])
    keypoints = keypoints.noisier(alike(prepared.keypoints, prepared.start, rig))
    joined = prepare(scene, views[order], everyone, keypoints, prepared.search.has_ground, pictures, config, counter)
    again = find_poses(joined, config, counter)
    return (prepared, found) if again is None else (joined, replace(again, evidence=found.evidence))


def _taken(
    scene: Scene,
    solution: Solution,
    found: Found,
    prepared: Prepared,
    frame: Similarity,
    said: ImageEvidence,
    config: RefineConfig,
    begin: float,
) -> Solution:
    """The solution with the refined poses, in its own world."""
    adjusted, gathered, views = found.adjusted, found.adjusted.gathered, prepared.views
    sigma_rot, sigma_centre = pose_sigmas(
        found.keypoints, adjusted.tracks, gathered, adjusted.rig, adjusted.sigma_px, config
    )
    back = frame.inverse
    rig = adjusted.rig.moved(back)
    sightings = long_sightings(adjusted.tracks, gathered.view, len(views))
    distance = np.linalg.norm(adjusted.rig.cameras.centre - np.nanmean(adjusted.rig.keypoints, axis=0), axis=1)
    sure = (sigma_rot <= SURE_DEG) & (sigma_centre <= SURE_SHARE * distance) & (sightings >= _SOLVED_BY)
    known = sure | solution.posed[views]
    c2w = np.full_like(solution.c2w, math.nan)
    c2w[views[known]] = rig.c2w[known]
    usual = int(np.bincount(rig.lens).argmax())
    lenses = None if scene.lenses is None else Lenses(rig.lenses, scene.lenses.of_view)
    camera = rig.lenses[usual] if lenses is None else lenses.usual
    points = np.where(np.isfinite(solution.points), rig.keypoints, math.nan)
    refined = replace(solution, c2w=c2w, camera=camera, lenses=lenses, points=points)
    seen = replace(scene, camera=camera, lenses=lenses)
    error, inlier = inliers(seen, refined)
    reports = list(solution.views)
    for k in np.flatnonzero(known).tolist():
        view = int(views[k])
        reports[view] = _report(
            solution.views[view],
            error[view][inlier[view]] * seen.enlargement[view],
            bool(sure[k]),
            float(sigma_rot[k]),
            float(sigma_centre[k]) * back.scale,
        )
    kept = inlier & np.array([report.status is ViewStatus.SOLVED for report in reports])[:, None]
    of_solved = error[kept.any(1)]
    solved = sum(report.status is ViewStatus.SOLVED for report in reports)
    if solution.status is Status.CONVERGED:
        reason = f"{solved} of {len(scene)} views solved by image features; by keypoints alone {solution.reason}"
    else:  # where the car is among the cameras keypoints alone tell
        placed = f"image features place {int(sure.sum())} views among each other, but not the car among them"
        reason = f"{placed}; by keypoints alone {solution.reason}"
    return replace(
        refined,
        reason=reason,
        views=tuple(reports),
        depths=np.where(scene.seen & kept.any(1)[:, None], camera_z(c2w, points), math.nan),
        rmse_px=float(np.sqrt(np.square(error[kept]).mean())) if kept.any() else solution.rmse_px,
        median_px=float(np.nanmedian(of_solved)) if np.isfinite(of_solved).any() else solution.median_px,
        images=replace(said, focal_after_px=camera.fx, seconds=time.perf_counter() - begin),
        cloud=_cloud(adjusted.tracks, gathered, views, prepared.vehicle, back),
    )


def _report(
    before: ViewReport, inlier_px: Float[np.ndarray, "k"], placed: bool, sigma_rot_deg: float, sigma_trans: float
) -> ViewReport:
    """A view's report with its refined pose; a view that was completed, or had none, is solved by features."""
    after = replace(
        before,
        inliers=len(inlier_px),
        rmse_px=float(np.sqrt(np.square(inlier_px).mean())) if len(inlier_px) else before.rmse_px,
    )
    if before.status is ViewStatus.COMPLETED and not placed:
        return after
    status = ViewStatus.SOLVED if placed else before.status
    return replace(after, status=status, reason="", sigma_rot_deg=sigma_rot_deg, sigma_trans_m=sigma_trans)


def _cloud(
    tracks: Tracks,
    gathered: Gathered,
    views: Int[np.ndarray, "n"],
    vehicle: Bool[np.ndarray, "f"],
    back: Similarity,
) -> Cloud:
    """The tracks' points in the solution's world, each in the colour of its first sighting."""
    first = tracks.feature[tracks.first[:-1]]
    known = np.pad(vehicle, (0, len(gathered.view) - len(vehicle)))[tracks.feature]
    share = np.bincount(tracks.of_track, weights=known, minlength=len(tracks))
    return Cloud(
        back.apply(tracks.points),
        gathered.colour[first],
        share > 0,
        tracks.first,
        views[gathered.view[tracks.feature]],
        gathered.pixel[tracks.feature],
    )


def _per_view(tracks: Tracks, gathered: Gathered, views: Int[np.ndarray, "n"], count: int) -> Int[np.ndarray, "v"]:
    """Sightings of each of the scene's views."""
    seen = np.zeros(count, int)
    seen[views] = np.bincount(gathered.view[tracks.feature], minlength=len(views))
    return seen


def _praise(evidence: Evidence) -> str:
    return (
        f"{evidence.held} tracks that were held out are met to {evidence.held_after_px:.2f} px, "
        f"{evidence.held_before_px:.2f} px by the keypoints' poses"
    )


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _lenses(scene: Scene) -> tuple[tuple[Camera, ...], Int[np.ndarray, "n"]]:
    """The scene's lenses, and which of them each view has."""
    if scene.lenses is None:
        return (scene.camera,), np.zeros(len(scene), np.int64)
    return tuple(scene.lenses.cameras), scene.lenses.of_view


def _frame(scene: Scene, solution: Solution) -> tuple[Similarity, bool]:
    """What carries the solution into a world of about metres, z up; and whether the ground is at z = 0 there."""
    template = car_template(scene.schema)
    if template is not None and int(np.isfinite(solution.points).all(-1).sum()) >= 4:
        return template_frame(solution.points, template), True
    return standing(scene.schema, solution.points, solution.c2w[solution.posed], 4.0), False
