"""Poses from image features, whole: better where photos allow it, untouched where they do not."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from kronc_ns.files.photos import photos
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.refine.options import RefineConfig
from kronc_ns.refine.pipeline import refine_scene
from kronc_ns.solution import Status, ViewStatus
from tests.refine.conftest import altered, still_background, without_masks


@pytest.fixture(scope="module")
def refined(walk, solved):
    scene, solution = solved
    steps = []
    found = refine_scene(scene, solution, photos(walk[0], scene), progress=lambda *step: steps.append(step))
    return found, steps


def error(solution, capture):
    return tuple(of.mean() for of in pose_errors(solution.c2w, capture.c2w))


def test_poses_are_several_times_better(walk, solved, refined):
    before, after = error(solved[1], walk[1]), error(refined[0], walk[1])
    assert refined[0].images.accepted
    assert after[0] < before[0] / 5
    assert after[1] < before[1] / 4


def test_what_is_said_of_it(solved, refined):
    found, steps = refined
    said = found.images
    assert said.region == "frame"
    assert not said.background_still
    assert said.held_out_after_px < said.held_out_before_px
    assert said.held_out_z > 2
    assert sum(said.tracks_by_length) == len(found.cloud.points)
    assert sum(n * count for n, count in enumerate(said.tracks_by_length)) == sum(said.observations)
    assert [done for done, _, _ in steps] == list(range(1, len(steps) + 1))
    assert steps[-1][0] == steps[-1][1]
    assert found.status is solved[1].status
    assert all(view.sigma_rot_deg < old.sigma_rot_deg for view, old in zip(found.views, solved[1].views, strict=True))


@pytest.mark.slow
def test_features_leave_a_weak_solution_weak(walk, solved):
    """They tell nothing of where the car is."""
    scene, solution = solved
    weak = replace(solution, status=Status.WEAK, reason="known to 2.0 deg only")
    found = refine_scene(scene, weak, photos(walk[0], scene))
    assert found.images is not None
    assert found.images.accepted
    assert found.status is Status.WEAK
    assert found.reason.startswith(f"image features place {len(scene)} views among each other, but not the car")
    assert found.reason.endswith("known to 2.0 deg only")


def test_the_world_and_its_scale_stay(solved, refined):
    known = np.isfinite(solved[1].points).all(-1)
    off = np.linalg.norm(refined[0].points[known] - solved[1].points[known], axis=-1)
    assert np.median(off) < 0.05


def test_the_cloud_is_seen_where_it_is_said(refined):
    found = refined[0]
    cloud, camera = found.cloud, found.camera
    point = np.repeat(np.arange(len(cloud.points)), np.diff(cloud.first))
    pose = found.c2w[cloud.view]
    seen = np.einsum("kji,kj->ki", pose[:, :, :3], cloud.points[point] - pose[:, :, 3])
    pixel = seen[:, :2] / seen[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    assert np.median(np.linalg.norm(pixel - cloud.pixel, axis=1)) < 0.2
    assert 0 < cloud.on_vehicle.mean() < 1
    assert cloud.colours.std() > 10


@pytest.mark.slow
def test_the_same_photos_give_the_same_poses(walk, solved, refined):
    again = refine_scene(solved[0], solved[1], photos(walk[0], solved[0]))
    np.testing.assert_array_equal(again.c2w, refined[0].c2w)


@pytest.mark.slow
@pytest.mark.parametrize("masked", [True, False])
def test_a_background_that_stands_still_is_found_and_left_out(walk, solved, masked):
    scene, solution = solved
    found = refine_scene(scene, solution, still_background(walk[0], scene, masked))
    assert found.images.background_still
    assert found.images.region == "vehicle"
    assert error(found, walk[1])[0] <= error(solution, walk[1])[0]


@pytest.mark.slow
def test_it_needs_no_masks(walk, solved):
    scene, solution = solved
    found = refine_scene(scene, solution, altered(walk[0], scene, without_masks))
    assert found.images.accepted
    assert error(found, walk[1])[0] < error(solution, walk[1])[0] / 5


def test_without_texture_the_keypoints_poses_stay(walk, solved):
    scene, solution = solved
    grey = altered(walk[0], scene, lambda _, picture: replace(picture, rgb=np.full_like(picture.rgb, 128)))
    found = refine_scene(scene, solution, grey)
    assert not found.images.accepted
    assert "too few features" in found.images.reason
    assert found.c2w is solution.c2w
    assert found.cloud is None


@pytest.mark.slow
def test_photos_of_something_else_change_nothing(walk, solved):
    """Every photo from another place: features that agree with each other but not with the keypoints."""
    scene, solution = solved
    read = photos(walk[0], scene)
    found = refine_scene(scene, solution, lambda view: read((5 * view + 3) % len(scene)))
    assert not found.images.accepted
    assert found.images.reason
    np.testing.assert_array_equal(found.c2w, solution.c2w)


@pytest.mark.slow
def test_photos_out_of_focus_do_no_harm(walk, solved):
    scene, solution = solved
    blurred = altered(
        walk[0], scene, lambda _, picture: replace(picture, rgb=cv2.GaussianBlur(picture.rgb, (0, 0), 5.0))
    )
    found = refine_scene(scene, solution, blurred)
    assert error(found, walk[1])[0] <= error(solution, walk[1])[0]


@pytest.mark.slow
def test_a_wrong_focal_length_is_found_or_the_poses_stay(walk, solved):
    scene, _ = solved
    camera = scene.camera
    wrong = replace(scene, camera=replace(camera, fx=1.2 * camera.fx, fy=1.2 * camera.fy))
    held = solve_scene(wrong, KroncConfig())
    kept = refine_scene(wrong, held, photos(walk[0], wrong))
    assert not kept.images.accepted or error(kept, walk[1])[0] < error(held, walk[1])[0]
    unknown = solve_scene(wrong, KroncConfig(refine_focal=True))
    found = refine_scene(wrong, unknown, photos(walk[0], wrong), RefineConfig(refine_focal=True))
    assert found.images.accepted
    assert abs(found.camera.fx / camera.fx - 1) < 0.002
    assert abs(found.camera.fx - camera.fx) < abs(unknown.camera.fx - camera.fx)


@pytest.mark.slow
def test_a_view_without_keypoints_is_solved_by_its_features(walk):
    from kronc_ns.files.scene_folder import load_scene

    scene = load_scene(walk[0])
    keypoints = scene.keypoints.copy()
    keypoints[5, :, 2] = 0.0
    scene = replace(scene, keypoints=keypoints)
    solution = solve_scene(scene, KroncConfig())
    assert solution.views[5].status is ViewStatus.COMPLETED
    found = refine_scene(scene, solution, photos(walk[0], scene))
    assert found.views[5].status is ViewStatus.SOLVED
    rotation, _ = pose_errors(found.c2w, walk[1].c2w)
    assert rotation[5] < 0.1


def test_a_failed_solution_is_left_alone(walk, solved):
    scene, solution = solved
    failed = replace(solution, status=Status.FAILED)
    found = refine_scene(scene, failed, photos(walk[0], scene))
    assert not found.images.accepted
    assert "failed" in found.images.reason
