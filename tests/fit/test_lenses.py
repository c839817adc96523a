"""A capture by several cameras: poses as good as of one, focal lengths of each found."""

from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.fit.attempts import problem_of
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.starts import start_from_poses
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.camera import Camera, Lenses, reproject
from kronc_ns.scene import Scene
from kronc_ns.solution import Status
from kronc_ns.synthetic.car import CarShape, build_car
from kronc_ns.synthetic.scenes import default_camera, observe, walk_poses
from tests.conftest import scene_of

VIEWS = 40
WIDE, TALL = default_camera("walk"), Camera(900.0, 900.0, 300.0, 400.0, 600, 800, k1=0.03)
IS_TALL = np.arange(VIEWS) % 2 == 1
C2W = walk_poses(VIEWS, np.random.default_rng(5))


def observed(camera: Camera, noise_px: float):
    return observe(build_car(CarShape()), C2W, camera, np.random.default_rng(6), noise_px)


def taken_by_two(noise_px: float = 1.0, wide: Camera = WIDE, tall: Camera = TALL) -> Scene:
    """Every other view by another phone held upright; the cameras as they are said to be."""
    of_wide, of_tall = observed(WIDE, noise_px), observed(TALL, noise_px)
    keypoints = np.where(IS_TALL[:, None, None], of_tall.keypoints, of_wide.keypoints)
    lenses = Lenses.of([tall if is_tall else wide for is_tall in IS_TALL])
    assert lenses is not None
    return replace(scene_of(of_wide), keypoints=keypoints, camera=lenses.usual, lenses=lenses)


def longer(camera: Camera, factor: float) -> Camera:
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def test_cameras_that_are_all_alike_are_one():
    assert Lenses.of([WIDE] * 3) is None
    lenses = Lenses.of([WIDE, TALL, TALL])
    assert lenses is not None
    assert lenses.cameras == (WIDE, TALL)
    assert lenses.usual == TALL
    assert lenses.each == (WIDE, TALL, TALL)
    assert lenses.chosen(np.array([True, False, True])).each == (WIDE, TALL)


def test_all_views_are_as_the_usual_camera_would_see_them():
    scene = taken_by_two(noise_px=0.0)
    expected = reproject(observed(WIDE, 0.0).points, C2W, scene.camera)
    np.testing.assert_allclose(scene.uv[scene.seen], expected[scene.seen], atol=1e-6)


def test_a_pixel_of_a_longer_lens_says_more():
    scene = taken_by_two()
    assert scene.enlargement[IS_TALL] == pytest.approx(900 / 400)
    weight = problem_of(start_from_poses("given", "given", scene, C2W)).weight
    assert np.median(weight[IS_TALL & scene.seen.any(1)].max(1)) == pytest.approx(
        (900 / 400) ** 2 * np.median(weight[~IS_TALL].max(1))
    )


def test_two_known_cameras_are_as_good_as_one():
    alone = solve_scene(scene_of(observed(WIDE, 1.0)))
    both = solve_scene(taken_by_two())
    assert both.status is Status.CONVERGED
    assert both.posed.all()
    rotation, centre = (of.mean() for of in pose_errors(both.c2w, C2W))
    one_rotation, one_centre = (of.mean() for of in pose_errors(alone.c2w, C2W))
    assert rotation < one_rotation, "the other one has more pixels a metre"
    assert centre < one_centre


def test_two_unknown_focal_lengths_are_found():
    wrong = taken_by_two(wide=longer(WIDE, 1.2), tall=longer(TALL, 0.85))
    solution = solve_scene(wrong, KroncConfig(refine_focal=True))
    assert solution.status is Status.CONVERGED
    assert solution.lenses is not None
    wide, tall = solution.lenses.cameras
    assert wide.fx == pytest.approx(WIDE.fx, rel=0.01)
    assert tall.fx == pytest.approx(TALL.fx, rel=0.01)
    assert solution.camera == wide
    assert solution.camera_of(3) == tall
    assert pose_errors(solution.c2w, C2W)[0].mean() < 0.6


def test_errors_of_a_view_are_in_its_own_pixels():
    views = solve_scene(taken_by_two()).views
    for chosen in (IS_TALL, ~IS_TALL):
        errors = [view.rmse_px for view, take in zip(views, chosen, strict=True) if take and view.rmse_px is not None]
        # 1 px along each axis, of which the fit takes up some; in the usual camera's pixels it would be 0.6
        assert 1.05 < np.median(errors) < 1.5
