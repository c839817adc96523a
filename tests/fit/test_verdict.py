"""Statuses and their reasons."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from kronc_ns.fit.attempts import measured
from kronc_ns.fit.noise import Noise
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.two_cars import TwoCars
from kronc_ns.fit.verdict import POOR_FIT, Evidence, inliers, judge, residuals_px
from kronc_ns.geometry.camera import reproject
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewStatus
from kronc_ns.solve.robust import INLIER_SIGMAS, noise_px
from kronc_ns.synthetic.scenes import make_capture
from tests.conftest import scene_of

VIEWS = 20


@pytest.fixture(scope="module")
def evidence(lap) -> Evidence:
    """The true poses and points, and a solver that is content."""
    return Evidence(
        camera=lap.camera,
        c2w=lap.c2w,
        points=lap.points,
        sigma_rot_deg=np.full(VIEWS, 0.2),
        sigma_trans_m=np.full(VIEWS, 0.02),
        swapped=np.zeros(VIEWS, dtype=bool),
        shape_weight=1.0,
        converged=True,
        iterations=12,
        lead=np.full(VIEWS, math.inf),
        noise=Noise(0.7, 1.0, 500),
        two_cars=TwoCars(0.0, 1.0, np.zeros(VIEWS, dtype=bool)),
    )


@pytest.fixture(scope="module")
def true(solution, lap) -> Solution:
    """A solution with the true poses and points."""
    return replace(solution, c2w=lap.c2w, points=lap.points)


def without_poses(evidence: Evidence, views: list[int]) -> Evidence:
    return replace(evidence, c2w=np.where(np.isin(np.arange(VIEWS), views)[:, None, None], math.nan, evidence.c2w))


def test_the_truth_converged(scene, evidence):
    verdict = judge(scene, evidence)
    assert verdict.status is Status.CONVERGED
    assert "20 of 20 views solved" in verdict.reason
    assert verdict.rmse_px == pytest.approx(0.7 * math.sqrt(2), rel=0.05)
    assert verdict.median_px == pytest.approx(0.7 * 1.177, rel=0.1)
    assert verdict.solved.all()
    for name, seen, report in zip(scene.names, scene.seen, verdict.views, strict=True):
        assert report.name == name
        assert report.status is ViewStatus.SOLVED
        assert report.visible == seen.sum()
        assert report.inliers >= 0.95 * report.visible
        assert report.rmse_px == pytest.approx(0.99, abs=0.35)
        assert (report.sigma_rot_deg, report.sigma_trans_m) == (pytest.approx(0.2), pytest.approx(0.02))
        assert report.reason == ""


# ---- what is an inlier


def test_residuals_are_those_of_the_noise(scene, true):
    error, inlier = inliers(scene, true)
    assert_array_equal(error, residuals_px(scene, true.camera, true.c2w, true.points))
    assert_array_equal(np.isnan(error), ~scene.seen)
    assert not inlier[np.isnan(error)].any()
    assert inlier[scene.seen].mean() > 0.99


def test_residuals_are_infinite_behind_a_camera(scene, true):
    behind = true.c2w.copy()
    behind[0, :, [0, 2]] *= -1  # turned away from the car
    error = residuals_px(scene, true.camera, behind, true.points)
    seen = scene.seen[0]
    assert np.isinf(error[0, seen]).all()
    assert np.isnan(error[0, ~seen]).all()
    assert np.median(error[1][np.isfinite(error[1])]) < 1.0


def off_by(scene: Scene, true: Solution, sigmas: float) -> Scene:
    """Detections in a random direction from their points: all by the median of a noise of 1 px, but some by sigmas."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * math.pi, scene.seen.shape)
    length = np.where(rng.random(scene.seen.shape) < 0.1, sigmas, 1.1774)
    off = length[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    uv = reproject(true.points, true.c2w, scene.camera) + off
    return replace(scene, keypoints=np.concatenate([uv, scene.visibility[..., None]], axis=-1))


@pytest.mark.parametrize(("share", "met"), [(0.99, True), (1.01, False)])
def test_one_threshold_parts_inliers_from_outliers(scene, true, evidence, attempt, share, met):
    """So many times the noise, which the median tells: for solutions, for verdicts and for what solvers found."""
    wild = off_by(scene, true, share * INLIER_SIGMAS)
    error, inlier = inliers(wild, true)
    assert noise_px(error[wild.seen]) == pytest.approx(1.0, abs=1e-6)
    assert_array_equal(inlier, wild.seen if met else wild.seen & (error < 2))
    assert [report.inliers for report in judge(wild, evidence).views] == inlier.sum(1).tolist()
    found = replace(attempt.found, scene=wild, c2w=true.c2w, points=true.points)
    assert_array_equal(measured(attempt.start, found, 1, {}, attempt.path).inlier, inlier)


def test_a_few_pixels_are_no_inliers_however_large_the_noise(scene, true):
    far = replace(scene, keypoints=scene.keypoints + [40.0, 0.0, 0.0] * scene.visibility[..., None])
    error, inlier = inliers(far, true)
    assert INLIER_SIGMAS * noise_px(error[far.seen]) > 40 > 3 * POOR_FIT * math.hypot(480, 270)
    assert not inlier.any()


def test_points_behind_a_camera_are_no_inliers(scene, evidence):
    turned = evidence.c2w.copy()
    turned[2, :, [0, 2]] *= -1
    report = judge(scene, replace(evidence, c2w=turned)).views[2]
    assert report.status is ViewStatus.FAILED
    assert report.inliers == 0
    assert report.visible == scene.seen[2].sum()


# ---- what is said of a view


def test_swapped_views_are_said_to_be(scene, evidence):
    swapped = np.arange(VIEWS) == 4
    verdict = judge(scene, replace(evidence, swapped=swapped))
    assert [report.swapped for report in verdict.views] == swapped.tolist()


@pytest.mark.parametrize(
    ("sigma_deg", "sigma_m", "said"),
    [(3.0, 0.02, "3.0 deg, 0.02 m"), (0.2, 0.5, "0.2 deg, 0.5 m"), (math.nan, 0.02, "unknown")],
)
def test_a_view_that_is_not_placed_well_is_vague(scene, evidence, sigma_deg, sigma_m, said):
    rotation, centre = evidence.sigma_rot_deg.copy(), evidence.sigma_trans_m.copy()
    rotation[3], centre[3] = sigma_deg, sigma_m
    verdict = judge(scene, replace(evidence, sigma_rot_deg=rotation, sigma_trans_m=centre))
    assert verdict.views[3].status is ViewStatus.FAILED
    assert said in verdict.views[3].reason
    assert_array_equal(verdict.vague, np.arange(VIEWS) == 3)
    assert_array_equal(verdict.solved, ~verdict.vague)
    assert verdict.status is Status.CONVERGED


def test_a_view_that_fits_another_pose_as_well_is_not_solved(scene, evidence):
    lead = np.where(np.arange(VIEWS) == 3, 1.0, math.inf)
    verdict = judge(scene, replace(evidence, lead=lead))
    assert verdict.views[3].status is ViewStatus.FAILED
    assert "fit another pose nearly as well" in verdict.views[3].reason
    assert not verdict.vague.any(), "where it stands nobody knows"
    assert verdict.solved.sum() == VIEWS - 1


def test_a_view_that_may_agree_by_accident_is_not_solved(scene, evidence):
    keypoints = scene.keypoints.copy()
    seen = np.flatnonzero(scene.seen[3])
    keypoints[3, seen[9:], 2] = 0
    uv = reproject(evidence.points[seen[:9]], evidence.c2w[3:4], scene.camera)[0]
    rng = np.random.default_rng(0)
    keypoints[3, seen[:9], :2] = uv + rng.normal(size=uv.shape)
    assert judge(replace(scene, keypoints=keypoints), evidence).solved.all()
    keypoints[3, seen[5:9], :2] += rng.choice([-1, 1], (4, 2)) * rng.uniform(20, 40, (4, 2))
    verdict = judge(replace(scene, keypoints=keypoints), evidence)
    assert verdict.views[3].status is ViewStatus.FAILED
    assert verdict.views[3].reason == "5 of its 9 keypoints might agree by accident"
    assert not verdict.vague.any(), "it may stand elsewhere"
    assert verdict.solved.sum() == VIEWS - 1


def test_a_view_whose_points_hardly_any_other_sees_is_not_solved(scene, evidence):
    """Eleven points that one other view sees, too: 22 measurements, of which the pose takes 6 and the points 16.5."""
    keypoints = scene.keypoints.copy()
    seen = np.flatnonzero(scene.seen[3] & scene.seen[4])[:11]
    keypoints[3, ~np.isin(np.arange(keypoints.shape[1]), seen), 2] = 0
    others = ~np.isin(np.arange(VIEWS), (3, 4))
    keypoints[np.ix_(others, seen, [2])] = 0
    verdict = judge(replace(scene, keypoints=keypoints), evidence)
    assert verdict.views[3].status is ViewStatus.FAILED
    assert verdict.views[3].reason == "the 11 keypoints that agree are seen by too few other views to check its pose"
    assert verdict.views[4].status is ViewStatus.SOLVED
    assert_array_equal(verdict.vague, np.arange(VIEWS) == 3)


@pytest.mark.parametrize(("share", "status"), [(0.025, Status.CONVERGED), (0.029, Status.WEAK)])
def test_centres_must_be_known_as_well(scene, evidence, share, status):
    middle = evidence.points[np.isfinite(evidence.points).all(-1)].mean(0)
    distance = np.linalg.norm(evidence.c2w[..., 3] - middle, axis=-1)
    verdict = judge(scene, replace(evidence, sigma_trans_m=share * distance))
    assert verdict.solved.all()
    assert verdict.status is status
    assert ("2.9 % of the distance only" in verdict.reason) == (status is Status.WEAK)


@pytest.mark.parametrize(("views", "status"), [(3, Status.WEAK), (20, Status.CONVERGED)])
def test_few_views_must_be_known_better(evidence, scene, views, status):
    every = slice(None, None, VIEWS // views)
    chosen = replace(scene, names=scene.names[every][:views], keypoints=scene.keypoints[every][:views])
    known = {name: getattr(evidence, name)[every][:views] for name in ("c2w", "sigma_trans_m", "swapped", "lead")}
    alone = TwoCars(0.0, 1.0, np.zeros(views, dtype=bool))
    few = replace(evidence, **known, sigma_rot_deg=np.full(views, 1.4), two_cars=alone)
    assert judge(chosen, few).status is status


def blurred(scene: Scene, noise_px: float) -> Scene:
    noise = noise_px * np.random.default_rng(0).normal(size=scene.uv.shape)
    keypoints = scene.keypoints.copy()
    keypoints[..., :2] += noise * scene.visibility[..., None]
    return replace(scene, keypoints=keypoints)


def views_of_another_car(scene: Scene, views: list[int]) -> Scene:
    keypoints = scene.keypoints.copy()
    for view in views:
        seen = np.flatnonzero(scene.seen[view])
        keypoints[view, seen, :2] = keypoints[view, np.roll(seen, len(seen) // 2), :2]
    return replace(scene, keypoints=keypoints)


def test_views_without_enough_agreement_say_so(scene, evidence):
    keypoints = views_of_another_car(scene, [5]).keypoints
    keypoints[7, np.flatnonzero(keypoints[7, :, 2])[3:]] = 0
    verdict = judge(replace(scene, keypoints=keypoints), evidence)
    other_car, three_points = verdict.views[5], verdict.views[7]
    assert other_car.status is three_points.status is ViewStatus.FAILED
    assert other_car.reason.startswith("only ")
    assert "agree with the other views" in other_car.reason
    assert three_points.reason == "3 keypoints, at least 4 are needed"
    assert other_car.rmse_px is three_points.rmse_px is None
    assert other_car.sigma_rot_deg is None
    assert verdict.solved.tolist() == [i not in (5, 7) for i in range(VIEWS)]


# ---- what is said of the whole

OTHER = np.arange(VIEWS) < 8


@pytest.mark.parametrize(
    ("change", "known", "status", "reason"),
    [
        ({}, {"shape_weight": 0.45}, Status.WEAK, "hardly look like a car"),
        ({}, {"shape_weight": 0.55}, Status.CONVERGED, "20 of 20 views solved"),
        (
            {},
            {"two_cars": TwoCars(0.4, 0.5, OTHER)},
            Status.WEAK,
            "about 8 of 20 views, images/frame_00001.png the first",
        ),
        ({}, {"two_cars": TwoCars(0.4, 0.9, OTHER)}, Status.CONVERGED, "20 of 20 views solved"),
        ({}, {"two_cars": TwoCars(0.5, 0.9, OTHER)}, Status.WEAK, "two shapes explain 50 % of what one misses"),
        ({}, {"two_cars": TwoCars(0.3, 0.5, OTHER)}, Status.CONVERGED, "20 of 20 views solved"),
        ({}, {"shape_weight": None}, Status.CONVERGED, "20 of 20 views solved"),
        ({}, {"sigma_rot_deg": np.full(VIEWS, 8.0)}, Status.WEAK, "0 of 20 views are well determined"),
        ({}, {"sigma_rot_deg": np.full(VIEWS, 8.0)}, Status.WEAK, "8.0 deg): take more views"),
        ({}, {"sigma_rot_deg": np.full(VIEWS, math.nan)}, Status.WEAK, "well determined"),
        (
            {},
            {"sigma_rot_deg": np.full(VIEWS, 1.9)},
            Status.WEAK,
            "known to 1.9 deg and 0.4 % of the distance only: take more views",
        ),
        ({}, {"sigma_rot_deg": np.array([0.3] * 12 + [1.9] * 8)}, Status.CONVERGED, "20 of 20 views solved"),
        ({}, {"converged": False}, Status.WEAK, "still moving after 12 steps"),
        ({}, {"sigma_rot_deg": np.array([0.2] * 9 + [8.0] * 11)}, Status.CONVERGED, "9 of 20 views solved"),
        (
            {},
            {"sigma_rot_deg": np.array([0.2] * 9 + [8.0] * 11), "noise": Noise(3.0, 1.0, 500)},
            Status.WEAK,
            "only 9 of 20 views are well determined",
        ),
        (
            {"odd": [19]},
            {"sigma_rot_deg": np.array([0.2] * 9 + [8.0] * 11)},
            Status.WEAK,
            "only 9 of 20 views are well determined",
        ),
        (
            {},
            {"sigma_rot_deg": np.array([0.2] * 2 + [8.0] * 18)},
            Status.WEAK,
            "only 2 of 20 views are well determined",
        ),
        (
            {},
            {"noise": Noise(4.0, 1.0, 500), "sigma_rot_deg": np.array([0.2] * 15 + [8.0] * 5)},
            Status.WEAK,
            "fit poorly (noise 4.0 px)",
        ),
        ({}, {"noise": Noise(4.0, 1.0, 500)}, Status.CONVERGED, "20 of 20 views solved"),
        ({}, {"noise": Noise(0.7, 1.1, 19)}, Status.WEAK, "share so few keypoints"),
        ({"blur": 12.0}, {}, Status.FAILED, "do not fit together"),
        ({"odd": list(range(3))}, {}, Status.CONVERGED, "17 of 20 views solved"),
        ({"odd": list(range(9, 20))}, {}, Status.WEAK, "only 9 of 20 views are solved"),
    ],
)
def test_every_doubt_has_its_status_and_its_reason(scene, evidence, change, known, status, reason):
    odd = change.get("odd", [])
    scene = views_of_another_car(blurred(scene, change.get("blur", 0.0)), odd)
    verdict = judge(scene, replace(without_poses(evidence, odd), **known))
    assert verdict.status is status
    assert reason in verdict.reason
    assert "px" in verdict.reason


@pytest.mark.parametrize(
    ("count", "shape_weight", "status"),
    [(0, 1.0, Status.FAILED), (2, None, Status.FAILED), (1, 1.0, Status.WEAK), (2, 1.0, Status.WEAK)],
)
def test_fewer_than_three_views_are_held_by_the_template_or_by_nothing(scene, evidence, count, shape_weight, status):
    partial = without_poses(evidence, list(range(count, VIEWS)))
    verdict = judge(scene, replace(partial, shape_weight=shape_weight))
    assert verdict.status is status
    assert f"{count} of 20 views" in verdict.reason
    assert verdict.solved.tolist() == [i < count for i in range(VIEWS)]


def test_poses_that_nothing_checks_are_weak():
    """Three views of which each pair shares three points: 36 numbers were measured, 38 are sought."""
    capture = make_capture("walk", views=3, seed=3, missing=0.0)
    car = np.arange(9)
    keypoints = np.zeros_like(capture.keypoints)
    uv = reproject(capture.points, capture.c2w, capture.camera)
    for view, points in enumerate((car[:6], car[3:], car[[0, 1, 2, 6, 7, 8]])):
        keypoints[view, points, :2] = uv[view, points]
        keypoints[view, points, 2] = 1.0
    scene = scene_of(replace(capture, keypoints=keypoints), capture.c2w)
    assert solve_scene(scene, KroncConfig(init="circular")).status is not Status.CONVERGED
    solution = solve_scene(scene, KroncConfig(init="given"))
    assert "median reprojection error 0.0" in solution.reason
    assert solution.status is Status.WEAK
    assert "share so few keypoints" in solution.reason
