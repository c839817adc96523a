"""From the poses of keypoints to those of image features: gather, match, adjust, judge."""

import math
import time
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.fit.car_frame import standing, template_frame
from kronc_ns.fit.verdict import inliers
from kronc_ns.geometry.alignment import Similarity
from kronc_ns.geometry.camera import Lenses
from kronc_ns.geometry.poses import camera_z
from kronc_ns.keypoints.template import car_template
from kronc_ns.refine.adjustment import Adjusted, adjust
from kronc_ns.refine.gathering import Gathered, Progress, gather
from kronc_ns.refine.keypoints import KeypointTracks, keypoint_tracks
from kronc_ns.refine.options import RefineConfig
from kronc_ns.refine.pairs import choose_pairs, view_angles
from kronc_ns.refine.patches import align, grow
from kronc_ns.refine.pictures import Pictures
from kronc_ns.refine.region import background_is_still, vehicle_features
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.search import Search, find_tracks, standing_features
from kronc_ns.refine.tracks import Tracks, confirmed, enough, place
from kronc_ns.refine.uncertainty import pose_sigmas
from kronc_ns.refine.verdict import Evidence, weigh
from kronc_ns.scene import Scene
from kronc_ns.solution import Cloud, ImageEvidence, Solution, Status, ViewReport, ViewStatus

_HELD_OUT = 0.2  # share of the tracks that no fit sees
_TRACKS_OF_VIEW = 400  # that are enough, once their places are those of patches
_PAIRED = 20  # sightings of a view in tracks of three, below which its tracks of two count
_ROUNDS = 2  # of matching by the poses of features, at the most ...
_MATCHED_WELL = 0.75  # ... for one is enough where its matches met the poses that made them nearly as well as its own
_LEAST_VIEWS = 3
_SOLVED_BY = 20  # features of three views that make a view's pose known
_SURE_DEG, _SURE_SHARE = 2.0, 0.03  # and its standard deviations, at the most, as in the verdict on keypoints


@dataclass(frozen=True)
class _Found:
    """The poses that features lead to, and what speaks for them."""

    adjusted: Adjusted
    evidence: Evidence


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
    if solution.status is Status.FAILED or len(views) < _LEAST_VIEWS:
        reason = f"{len(views)} views have a pose: expected {_LEAST_VIEWS} or more of a solution that has not failed"
        return replace(solution, images=replace(untouched, reason=reason))
    scene = replace(scene, camera=solution.camera, lenses=solution.lenses)
    frame, has_ground = _frame(scene, solution)
    lenses = (scene.camera,) if scene.lenses is None else scene.lenses.cameras
    lens = np.zeros(len(views), np.int64) if scene.lenses is None else scene.lenses.of_view[views]
    start = Rig.of(solution.c2w[views], lenses, lens, solution.points).moved(frame)
    keypoints = keypoint_tracks(scene, solution, views)
    angles = view_angles(start.cameras.centre, np.nanmean(start.keypoints, axis=0))
    pairs = choose_pairs(angles)
    counter = _Counter(progress, len(views) + (1 + _ROUNDS) * len(pairs))
    cameras = [scene.camera_of(view) for view in views.tolist()]
    gathered = gather(pictures, views, cameras, start.rotation[:, :, 2], angles, counter.advance)
    uv = start.ideal(gathered.pixel, gathered.view)
    stands = standing_features(gathered, uv, pairs, angles)
    vehicle = vehicle_features(gathered, uv, start)
    turntable = background_is_still(stands, vehicle)
    on_vehicle_only = config.region == "vehicle" or (config.region == "auto" and turntable)
    used = ~stands & vehicle if on_vehicle_only else ~stands
    search = Search(pairs, used, has_ground, counter.advance)
    said = replace(untouched, region="vehicle" if on_vehicle_only else "frame", background_still=turntable)
    found = _found(start, keypoints, gathered, search, config)
    if found is None:
        reason = "the photos have too few features in common"
        return replace(solution, images=replace(said, reason=reason, seconds=time.perf_counter() - begin))
    evidence, tracks = found.evidence, found.adjusted.tracks
    said = replace(
        said,
        accepted=not evidence.objection,
        reason=evidence.objection or _praise(evidence),
        tracks_by_length=tuple(np.bincount(tracks.lengths).tolist()),
        observations=tuple(_per_view(tracks, found.adjusted.gathered, views, len(scene)).tolist()),
        held_out=evidence.held,
        held_out_before_px=_known(evidence.held_before_px),
        held_out_after_px=_known(evidence.held_after_px),
        held_out_z=evidence.held_z,
        keypoints_z=evidence.keypoints_z,
        noise_px=found.adjusted.sigma_px,
    )
    if evidence.objection:
        return replace(solution, images=replace(said, seconds=time.perf_counter() - begin))
    return _taken(scene, solution, found, keypoints, views, frame, vehicle, said, config, begin)


def _found(
    start: Rig, keypoints: KeypointTracks, gathered: Gathered, search: Search, config: RefineConfig
) -> _Found | None:
    """Features matched by the keypoints' poses, then by those that they lead to; None without tracks."""
    rng = np.random.default_rng(config.seed)
    tracks = find_tracks(gathered, search, start, keypoints, None)
    reserved = tracks.chosen(rng.random(len(tracks)) < _HELD_OUT)
    held = np.zeros(len(gathered.view), bool)
    held[reserved.feature] = True
    fitted = confirmed(_without(tracks, held), gathered.view, _PAIRED)
    fitted = enough(fitted, gathered.view, _TRACKS_OF_VIEW, rng)
    if not len(fitted):
        return None
    latest = adjust(keypoints, fitted, gathered, start, None)
    for done in range(1, _ROUNDS + 1):
        tracks = find_tracks(gathered, search, latest.rig, keypoints, latest)
        tracks = enough(tracks, gathered.view, _TRACKS_OF_VIEW, rng)
        aligned = align(tracks, gathered, latest.rig)
        tracks = _placed(tracks, aligned, latest)
        tracks, aligned = grow(tracks, aligned, latest.rig)
        tracks = confirmed(tracks, aligned.view, _PAIRED)
        known = _without(tracks, np.pad(held, (0, len(aligned.view) - len(held))))
        if not len(known):
            return None
        latest = adjust(keypoints, known, aligned, latest.rig, config)
        if latest.after_px > _MATCHED_WELL * latest.before_px:
            for _ in range((_ROUNDS - done) * len(search.pairs)):
                search.advance()  # over what need not be searched again
            break
    evidence = weigh(reserved, aligned, keypoints, start, latest.rig, latest.sigma_px)
    final = adjust(keypoints, _placed(tracks, aligned, latest), aligned, latest.rig, config, latest.sigma_px)
    return _Found(final, evidence)


def _placed(tracks: Tracks, gathered: Gathered, adjusted: Adjusted) -> Tracks:
    """Tracks with their points where adjusted cameras see them."""
    rig = adjusted.rig
    return place(tracks, rig.ideal(gathered.pixel, gathered.view), gathered.view, rig.cameras, adjusted.sigma_px)[0]


def _without(tracks: Tracks, held: Bool[np.ndarray, "f"]) -> Tracks:
    """The tracks that have no feature that is held out."""
    out = np.zeros(len(tracks), bool)
    out[tracks.of_track[held[tracks.feature]]] = True
    return tracks.chosen(~out)


def _taken(
    scene: Scene,
    solution: Solution,
    found: _Found,
    keypoints: KeypointTracks,
    views: Int[np.ndarray, "n"],
    frame: Similarity,
    vehicle: Bool[np.ndarray, "f"],
    said: ImageEvidence,
    config: RefineConfig,
    begin: float,
) -> Solution:
    """The solution with the refined poses, in its own world."""
    adjusted, gathered = found.adjusted, found.adjusted.gathered
    sigma_rot, sigma_centre = pose_sigmas(keypoints, adjusted.tracks, gathered, adjusted.rig, adjusted.sigma_px, config)
    back = frame.inverse
    rig = adjusted.rig.moved(back)
    c2w = np.full_like(solution.c2w, math.nan)
    c2w[views] = rig.c2w
    usual = int(np.bincount(rig.lens).argmax())
    lenses = None if scene.lenses is None else Lenses(rig.lenses, scene.lenses.of_view)
    camera = rig.lenses[usual] if lenses is None else lenses.usual
    points = np.where(np.isfinite(solution.points), rig.keypoints, math.nan)
    refined = replace(solution, c2w=c2w, camera=camera, lenses=lenses, points=points)
    seen = replace(scene, camera=camera, lenses=lenses)
    error, inlier = inliers(seen, refined)
    long = adjusted.tracks.lengths >= 3
    sure = _per_view(adjusted.tracks.chosen(long), gathered, views, len(scene))
    reports = list(solution.views)
    distance = np.linalg.norm(adjusted.rig.cameras.centre - np.nanmean(adjusted.rig.keypoints, axis=0), axis=1)
    for k, view in enumerate(views.tolist()):
        well = sigma_rot[k] <= _SURE_DEG and sigma_centre[k] <= _SURE_SHARE * distance[k]
        reports[view] = _report(
            solution.views[view],
            error[view][inlier[view]] * seen.enlargement[view],
            bool(well) and int(sure[view]) >= _SOLVED_BY,
            float(sigma_rot[k]),
            float(sigma_centre[k]) * back.scale,
        )
    kept = inlier & np.array([report.status is ViewStatus.SOLVED for report in reports])[:, None]
    of_solved = error[kept.any(1)]
    return replace(
        refined,
        views=tuple(reports),
        depths=np.where(scene.seen & kept.any(1)[:, None], camera_z(c2w, points), math.nan),
        rmse_px=float(np.sqrt(np.square(error[kept]).mean())) if kept.any() else solution.rmse_px,
        median_px=float(np.nanmedian(of_solved)) if np.isfinite(of_solved).any() else solution.median_px,
        images=replace(said, focal_after_px=camera.fx, seconds=time.perf_counter() - begin),
        cloud=_cloud(adjusted.tracks, gathered, views, vehicle, back),
    )


def _report(
    before: ViewReport, inlier_px: Float[np.ndarray, "k"], placed: bool, sigma_rot_deg: float, sigma_trans: float
) -> ViewReport:
    """A view's report with its refined pose; a completed view that features place well is solved."""
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


def _frame(scene: Scene, solution: Solution) -> tuple[Similarity, bool]:
    """What carries the solution into a world of about metres, z up; and whether the ground is at z = 0 there."""
    template = car_template(scene.schema)
    if template is not None and int(np.isfinite(solution.points).all(-1).sum()) >= 4:
        return template_frame(solution.points, template), True
    return standing(scene.schema, solution.points, solution.c2w[solution.posed], 4.0), False


class _Counter:
    """Counts the steps of all stages for one bar."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def advance(self) -> None:
        """One more is done."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._total, None)
