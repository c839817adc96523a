"""Statuses and their reasons."""

import math
from dataclasses import replace

import pytest
import torch

from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.verdict import Evidence, inliers, residuals_px, verify
from kronc_ns.geometry.camera import project
from kronc_ns.geometry.poses import invert, transform
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewStatus
from kronc_ns.synthetic.scenes import make_capture
from tests.conftest import scene_of


@pytest.fixture(scope="module")
def scene(lap) -> Scene:
    return scene_of(lap)


@pytest.fixture(scope="module")
def true(scene, lap) -> Solution:
    """A solution with the true poses and points."""
    solution = solve_scene(scene, KroncConfig(init="template"))
    return replace(solution, c2w=lap.c2w, points=lap.points)


def evidence(views: int = 20, **changes) -> Evidence:
    known = {
        "sigma_rot_deg": torch.full((views,), 0.2, dtype=torch.float64),
        "sigma_trans_m": torch.full((views,), 0.02, dtype=torch.float64),
        "swapped": torch.zeros(views, dtype=torch.bool),
        "shape_weight": 1.0,
        "converged": True,
    }
    return Evidence(**{**known, **changes})


def test_the_truth_converged(scene, true):
    reports, status, reason, rmse_px, median_px = verify(scene, true, evidence())
    assert status is Status.CONVERGED
    assert "20 of 20 views solved" in reason
    assert rmse_px == pytest.approx(0.7 * math.sqrt(2), rel=0.05)
    assert median_px == pytest.approx(0.7 * 1.177, rel=0.1)
    for i, report in enumerate(reports):
        assert report.status is ViewStatus.SOLVED
        assert report.visible == int(scene.visibility[i].sum())
        assert report.inliers >= 0.95 * report.visible
        assert report.rmse_px == pytest.approx(0.99, abs=0.35)
        assert (report.sigma_rot_deg, report.sigma_trans_m) == (pytest.approx(0.2), pytest.approx(0.02))
        assert report.reason == ""


def test_residuals_are_those_of_the_noise(scene, true):
    error, inlier = inliers(scene, true)
    torch.testing.assert_close(error, residuals_px(scene, true), rtol=0, atol=0, equal_nan=True)
    assert error.isnan().equal(scene.visibility == 0)
    assert not inlier[error.isnan()].any()
    assert float(inlier[scene.visibility > 0].double().mean()) > 0.99


def test_swapped_views_are_said_to_be(scene, true):
    swapped = torch.arange(20) == 4
    reports, *_ = verify(scene, true, evidence(swapped=swapped))
    assert [report.swapped for report in reports] == swapped.tolist()


def test_sigmas_that_are_not_known_are_none(scene, true):
    sigma = torch.full((20,), 0.2, dtype=torch.float64)
    sigma[3] = math.nan
    reports, *_ = verify(scene, true, evidence(sigma_rot_deg=sigma))
    assert reports[3].sigma_rot_deg is None
    assert reports[4].sigma_rot_deg == pytest.approx(0.2)


def blurred(scene: Scene, noise_px: float) -> Scene:
    noise = noise_px * torch.randn(scene.uv.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    keypoints = scene.keypoints.clone()
    keypoints[..., :2] += noise * scene.visibility[..., None]
    return replace(scene, keypoints=keypoints)


def view_of_another_car(scene: Scene, views: list[int]) -> Scene:
    keypoints = scene.keypoints.clone()
    for view in views:
        seen = torch.nonzero(keypoints[view, :, 2])[:, 0]
        keypoints[view, seen, :2] = keypoints[view, seen.roll(len(seen) // 2), :2]
    return replace(scene, keypoints=keypoints)


@pytest.mark.parametrize(
    ("change", "known", "status", "reason"),
    [
        ({}, {"shape_weight": 0.1}, Status.WEAK, "hardly look like a car"),
        ({}, {"shape_weight": None}, Status.CONVERGED, "20 of 20 views solved"),
        ({}, {"sigma_rot_deg": torch.full((20,), 8.0, dtype=torch.float64)}, Status.WEAK, "8.0 deg): take more views"),
        ({}, {"sigma_rot_deg": torch.full((20,), math.nan, dtype=torch.float64)}, Status.WEAK, "barely determined"),
        ({}, {"converged": False}, Status.WEAK, "still moving after"),
        ({"blur": 3.5}, {}, Status.WEAK, "fit poorly"),
        ({"blur": 12.0}, {}, Status.FAILED, "do not fit together"),
        ({"odd": list(range(3))}, {}, Status.CONVERGED, "17 of 20 views solved"),
        ({"odd": list(range(9, 20))}, {}, Status.WEAK, "only 9 of 20 views are solved"),
    ],
)
def test_every_doubt_has_its_status_and_its_reason(scene, true, change, known, status, reason):
    if "blur" in change:
        scene = blurred(scene, change["blur"])
    if "odd" in change:
        scene = view_of_another_car(scene, change["odd"])
        seen = torch.ones(20, dtype=torch.bool)
        seen[change["odd"]] = False
        true = replace(true, c2w=torch.where(seen[:, None, None], true.c2w, math.nan))
    _, found, told, _, _ = verify(scene, true, evidence(**known))
    assert found is status
    assert reason in told
    assert "px" in told


@pytest.mark.parametrize(
    ("count", "shape_weight", "status"),
    [(0, 1.0, Status.FAILED), (2, None, Status.FAILED), (1, 1.0, Status.WEAK), (2, 1.0, Status.WEAK)],
)
def test_fewer_than_three_views_are_held_by_the_template_or_by_nothing(scene, true, count, shape_weight, status):
    kept = torch.arange(20) < count
    partial = replace(true, c2w=torch.where(kept[:, None, None], true.c2w, math.nan))
    reports, found, reason, _, _ = verify(scene, partial, evidence(shape_weight=shape_weight))
    assert found is status
    assert f"{count} of 20 views" in reason
    assert [report.status is ViewStatus.SOLVED for report in reports] == kept.tolist()


def test_views_without_enough_agreement_say_so(scene, true):
    keypoints = view_of_another_car(scene, [5]).keypoints
    keypoints[7, torch.nonzero(keypoints[7, :, 2])[3:, 0]] = 0
    reports, *_ = verify(replace(scene, keypoints=keypoints), true, evidence())
    assert reports[5].status is reports[7].status is ViewStatus.FAILED
    assert reports[5].reason.startswith("only ")
    assert "agree with the other views" in reports[5].reason
    assert reports[7].reason == "3 keypoints, at least 4 are needed"
    assert reports[5].rmse_px is reports[7].rmse_px is None
    assert reports[5].sigma_rot_deg is None
    assert [report.status is ViewStatus.SOLVED for report in reports].count(True) == 18


def test_points_behind_a_camera_are_no_inliers(scene, true):
    turned = true.c2w.clone()
    turned[2, :, [0, 2]] *= -1
    reports, *_ = verify(scene, replace(true, c2w=turned), evidence())
    assert reports[2].status is ViewStatus.FAILED
    assert reports[2].inliers == 0
    assert reports[2].visible == int(scene.visibility[2].sum())


def test_poses_that_nothing_checks_are_weak():
    """Three views of which each pair shares three points: 36 numbers were measured, 38 are sought."""
    capture = make_capture("walk", views=3, seed=3, missing=0.0)
    car = torch.arange(9)
    keypoints = torch.zeros_like(capture.keypoints)
    in_camera = transform(invert(capture.c2w), capture.points.expand(3, -1, -1))
    for view, points in enumerate((car[:6], car[3:], car[[0, 1, 2, 6, 7, 8]])):
        keypoints[view, points, :2] = project(in_camera, capture.camera)[view, points]
        keypoints[view, points, 2] = 1.0
    solution = solve_scene(scene_of(replace(capture, keypoints=keypoints)), KroncConfig(init="circular"))
    assert solution.status is not Status.CONVERGED
    given = replace(scene_of(replace(capture, keypoints=keypoints)), given_c2w=capture.c2w)
    solution = solve_scene(given, KroncConfig(init="given"))
    assert solution.median_px < 0.05
    assert solution.status is Status.WEAK
    assert "share so few keypoints" in solution.reason
