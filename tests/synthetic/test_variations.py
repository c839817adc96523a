"""Captures of bare points and what may happen to captures."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import reproject
from kronc_ns.geometry.poses import compose, invert
from kronc_ns.geometry.rotations import so3_log
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.synthetic.car import CarShape, build_car
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.hull import hull_visibility
from kronc_ns.synthetic.render import keypoint_visibility
from kronc_ns.synthetic.scenes import Capture, default_camera, make_capture, observe, walk_poses
from kronc_ns.synthetic.variations import (
    empty_views,
    limit_points,
    noisy_poses,
    on_wheels,
    reorder,
    reverse,
    shuffle,
    swap_sides,
)

FLIP = list(APOLLOCAR3D_66.flip)


@pytest.fixture(scope="module")
def capture() -> Capture:
    return make_capture("walk", views=20, seed=3, noise_px=1.0, outliers=0.2)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_wild_detections_are_those_that_lie_about_their_point(capture):
    exact = reproject(capture.points, capture.c2w, capture.camera)
    error = np.linalg.norm(capture.keypoints[..., :2] - exact, axis=-1)
    seen = capture.keypoints[..., 2] > 0
    assert error[seen & ~capture.wild].max() < 5
    assert np.median(error[capture.wild]) > 20
    assert not (capture.wild & ~seen).any()
    assert 0.15 < capture.wild.sum() / seen.sum() < 0.25


def test_a_cube_shows_the_corners_of_the_sides_that_face_the_camera():
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    seen = hull_visibility(corners, np.array([[5.0, 0, 0], [4, 4, 4]]))
    assert_array_equal(seen[0], corners[:, 0] > 0)
    assert_array_equal(seen[1], corners.sum(1) > -3)


def test_the_hull_sees_about_what_rays_see():
    car = build_car(CarShape())
    centres = walk_poses(60, rng())[..., 3]
    by_hull, by_rays = hull_visibility(car.keypoints, centres), keypoint_visibility(car.mesh, car.keypoints, centres)
    assert (by_hull == by_rays).mean() > 0.9
    assert by_hull.sum(1).mean() == pytest.approx(by_rays.sum(1).mean(), rel=0.05)


def test_bare_points_can_be_captured_but_not_drawn(tmp_path):
    true = build_car(CarShape()).keypoints
    points = on_wheels(true + np.array([1.0, 2.0, 3.0]))
    assert_allclose(points, true, atol=0.05, rtol=0)
    capture = observe(points, walk_poses(6, rng()), default_camera("walk"), rng())
    exact = reproject(points, capture.c2w, capture.camera)
    seen = capture.keypoints[..., 2] > 0
    assert (seen.sum(1) > 10).all()
    assert_allclose(capture.keypoints[..., :2][seen], exact[seen])
    with pytest.raises(KroncError, match="without images"):
        write_capture(tmp_path / "drawn", capture, render=True)
    write_capture(tmp_path / "written", capture)


def test_views_keep_their_detections_in_another_order(capture):
    assert_array_equal(reverse(reverse(capture)).c2w, capture.c2w)
    assert_array_equal(reverse(capture).keypoints[0], capture.keypoints[-1])
    mixed = shuffle(capture, rng())
    order = (mixed.c2w[:, None] == capture.c2w).all((-2, -1)).argmax(1)
    assert sorted(order.tolist()) == list(range(20))
    assert order.tolist() != list(range(20))
    again = reorder(mixed, order.argsort())
    assert_array_equal(again.keypoints, capture.keypoints)
    assert_array_equal(again.wild, capture.wild)


def test_sides_are_swapped_in_the_views_that_are_named(capture):
    swapped, chosen = swap_sides(capture, 0.1, rng())
    assert chosen.sum() == 2
    assert_array_equal(swapped.keypoints[~chosen], capture.keypoints[~chosen])
    assert_array_equal(swapped.keypoints[chosen], capture.keypoints[chosen][:, FLIP])
    back = swap_sides(swapped, 0.1, rng())[0]
    assert_array_equal(back.keypoints, capture.keypoints)
    assert_array_equal(back.wild, capture.wild)


def test_detections_are_taken_out(capture):
    emptied, chosen = empty_views(capture, 0.2, rng())
    assert chosen.sum() == 4
    assert (emptied.keypoints[chosen] == 0).all()
    assert_array_equal(emptied.keypoints[~chosen], capture.keypoints[~chosen])
    few = limit_points(capture, 12, rng())
    seen, left = capture.keypoints[..., 2] > 0, few.keypoints[..., 2] > 0
    assert_array_equal(left.sum(1), np.minimum(seen.sum(1), 12))
    assert_array_equal(few.keypoints[left], capture.keypoints[left])
    assert not (few.wild & ~left).any()


def test_walks_have_a_length_and_a_sense():
    def turned(**options) -> float:
        centres = walk_poses(200, rng(), **options)[..., 3]
        angle = np.unwrap(np.arctan2(centres[:, 1], centres[:, 0]))
        return float(angle[-1] - angle[0]) / (2 * np.pi)

    assert turned() == pytest.approx(1.0, abs=0.1)
    assert turned(clockwise=True) == pytest.approx(-1.0, abs=0.1)
    assert turned(laps=0.5) == pytest.approx(0.5, abs=0.1)
    assert turned(laps=1.5) == pytest.approx(1.5, abs=0.1)


def test_a_view_from_which_nothing_can_be_seen_is_empty(recwarn):
    c2w = walk_poses(3, rng())
    c2w[1, :, [0, 2]] *= -1  # turned away from the car
    capture = observe(build_car(CarShape()), c2w, default_camera("walk"), rng(), noise_px=1.0, outliers=0.2)
    assert_array_equal((capture.keypoints[..., 2] > 0).any(1), [True, False, True])
    assert (capture.keypoints[1] == 0).all()
    assert not capture.wild[1].any()
    assert not recwarn.list


def test_noise_moves_cameras_about_themselves():
    c2w = walk_poses(4000, rng())
    moved = compose(invert(c2w), noisy_poses(c2w, 4.0, 0.5, rng()))
    turn_deg, step_m = np.rad2deg(so3_log(moved[..., :3])), moved[..., 3]
    assert_allclose(turn_deg.std(0), 4.0, rtol=0.05)
    assert_allclose(step_m.std(0), 0.5, rtol=0.05)
    assert_allclose([turn_deg.mean(0), step_m.mean(0)], 0.0, atol=0.2)
    assert_allclose(noisy_poses(c2w, 0.0, 0.0, rng()), c2w, atol=1e-12)
    assert_array_equal(noisy_poses(c2w, 4.0, 0.5, rng()), noisy_poses(c2w, 4.0, 0.5, rng()))
